"""Friction cones, moments and events in the pictures of a film."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import ConvexHull

from drake_dae.arrays import FloatArray
from drake_dae.pictures.moments import RunEvent
from drake_dae.pictures.scene.friction import friction_cones
from drake_dae.pictures.scene.run_motion import RunMotion
from drake_dae.robots.surfaces.surface import tangents

if TYPE_CHECKING:  # Loaded with the first film.
    from matplotlib.axes import Axes

CONE, MOMENT = "#e8b81a", "#8c33bf"
"""Colors of friction cones and of moments, as in the animation."""

NEGLIGIBLE = 1e-6
"""A moment is negligible below so much of the largest force at the length of the longest arrow."""

SAID = 1.0
"""So long an event is named, in s."""

_RIM = 24  # The corners of a drawn cone.


class FilmMarks:
    """What a film draws of a run besides links, paths and forces.

    A friction cone encloses the arrow of the force that it allows, as long as there is a force. A
    moment is an arrow with two heads along its axis, through the point of its force. Below stands
    the time of the whole run, with the beginning of each phase and a mark for each event.

    Args:
        course: The motion of the robot.
        project: Points in the world, m, shape (k, 3) -> their pixels, shape (k, 2).
        length: The length of the longest arrow of a force, in m.
        moments: What happens in the run.
        phases: When the phases of a task begin, in s.
    """

    def __init__(
        self,
        course: RunMotion,
        project: Callable[[FloatArray], FloatArray],
        length: float,
        moments: Sequence[RunEvent] = (),
        phases: Sequence[float] = (),
    ) -> None:
        self._course, self._project, self._length = course, project, length
        self._events, self._phases, self._cones = moments, phases, friction_cones(course)
        forces, turns = (
            max(
                np.linalg.norm(getattr(one, kind), axis=1).max(initial=0.0)
                for one in course.wrenches
            )
            for kind in ("forces", "moments")
        )
        self._largest = float(turns) if turns > NEGLIGIBLE * length * forces else 0.0

    @property
    def scale(self) -> str:
        """What the scale of the picture says of moments and cones."""
        said = [f"longest moment {self._largest:.3g} N m"] if self._largest else []
        numbers = sorted({f"{cone.coefficient:.3g}" for cone in self._cones})
        return ", ".join([*said, *([f"cone {' and '.join(numbers)}"] if numbers else [])])

    def draw(self, axis: Axes, number: int, width: float, height: float) -> str:
        """Draws what belongs to a moment of the run; returns what has just happened, in words.

        Args:
            axis: The axes of a picture, in pixels.
            number: Which of the moments of the course.
            width, height: The size of the picture.
        """
        course, wrench = self._course, self._course.wrenches[number]
        for cone in self._cones:
            if wrench.forces[cone.row].any():
                corners = self.cone(wrench.points[cone.row], cone.normals[number], cone.coefficient)
                pixels = self._project(corners)
                hull = pixels[ConvexHull(pixels).vertices]
                axis.fill(*hull.T, facecolor=CONE, alpha=0.3, edgecolor=CONE, linewidth=0.8)
        for row in range(len(wrench.points)) if self._largest else ():
            tail, second, head = self.moment(wrench.points[row], wrench.moments[row])
            if np.linalg.norm(wrench.moments[row]) > 0.02 * self._largest:
                for end in (second, head):
                    shape: dict[str, Any] = {"color": MOMENT, "arrowstyle": "-|>", "linewidth": 2}
                    pixels = self._project(np.array([tail, end]))
                    axis.annotate("", pixels[1], pixels[0], arrowprops=shape)
        time = course.start_time + course.times[number]
        self._draw_time(axis, float(time), width, height)
        recent = [one.text for one in self._events if 0.0 <= time - one.time < SAID]
        return ", ".join(recent[-2:])

    def cone(self, point: FloatArray, normal: FloatArray, coefficient: float) -> FloatArray:
        """The tip and the rim of a cone, which opens against the normal, m, shape (k, 3)."""
        angle, turn = np.arctan(coefficient), 2.0 * np.pi * np.arange(_RIM) / _RIM
        first, second = tangents(normal)
        around = np.outer(np.cos(turn), first) + np.outer(np.sin(turn), second)
        rim = np.cos(angle) * normal + np.sin(angle) * around
        return np.vstack([point, point - 0.5 * self._length * rim])

    def moment(
        self, point: FloatArray, moment: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The tail and both heads of the arrow of a moment, m."""
        arrow = 0.6 * self._length * moment / max(self._largest, 1e-300)
        return point - arrow, point - 0.2 * arrow, point

    def _draw_time(self, axis: Axes, time: float, width: float, height: float) -> None:
        """The run so far, over all of it, with its phases and events."""
        begin, passed = self._course.start_time, float(self._course.times[-1])
        if not (self._events or self._phases) or passed <= 0.0:
            return
        y, left, right = height - 10.0, 12.0, width - 12.0

        def at(moment: float) -> float:
            return left + (right - left) * min(max((moment - begin) / passed, 0.0), 1.0)

        axis.plot([left, right], [y, y], color="0.8", linewidth=3.0, solid_capstyle="butt")
        axis.plot([left, at(time)], [y, y], color="0.45", linewidth=3.0, solid_capstyle="butt")
        for moment in self._phases:
            axis.plot([at(moment)] * 2, [y - 4.0, y + 4.0], color="0.3", linewidth=1.0)
        for one in self._events:
            axis.plot(at(one.time), y, marker="v", markersize=6, color=one.kind.color)
