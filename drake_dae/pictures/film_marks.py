"""Friction cones, moments and events in the pictures of a film."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import ConvexHull

from drake_dae.arrays import FloatArray
from drake_dae.pictures.friction import friction_cones
from drake_dae.pictures.moments import RunEvent
from drake_dae.pictures.run_motion import RunMotion
from drake_dae.robots import tangents

if TYPE_CHECKING:  # Loaded with the first film.
    from matplotlib.axes import Axes

CONE, MOMENT = "#e8b81a", "#8c33bf"
"""Colors of friction cones and of moments, as in the animation."""

NEGLIGIBLE = 1e-6
"""Moments are drawn if the largest is above this fraction of the largest force times the length of
the longest arrow."""

EVENT_DURATION = 1.0
"""The time for which an event's name is shown, in s."""

_RIM = 24  # The number of points on the rim of a drawn cone.


def told(events: Sequence[RunEvent]) -> str:
    """The last two different texts of events, with the contacts of one kind together.

    Several points touch together: "pad1, pad3: touch" and "pad2: touch" are "pad1, pad2, pad3:
    touch".
    """
    names: dict[str, set[str]] = {}
    for event in events:
        contacts, colon, what = event.text.rpartition(": ")
        known = names.pop(colon + what, set())  # Once more at the end: the latest is the last.
        names[colon + what] = known | set(filter(None, contacts.split(", ")))
    return "; ".join(", ".join(sorted(own)) + what for what, own in list(names.items())[-2:])


class FilmMarks:
    """Draws the friction cones, moments and events of a run into the pictures of a film.

    A friction cone is drawn while its contact has a force. A moment is an arrow with two heads
    along its axis, through the point of application. A time bar at the bottom has a mark for the
    beginning of each phase and for each event.

    Args:
        course: The motion of the robot.
        project: Points in the world, m, shape (k, 3) -> their pixels, shape (k, 2).
        length: The length of the longest arrow of a force, in m.
        events: The events of the run.
        phases: The times at which the phases of a task begin, in s.
    """

    def __init__(
        self,
        course: RunMotion,
        project: Callable[[FloatArray], FloatArray],
        length: float,
        events: Sequence[RunEvent] = (),
        phases: Sequence[float] = (),
    ) -> None:
        self._course, self._project, self._length = course, project, length
        self._events, self._phases, self._cones = events, phases, friction_cones(course)
        largest_force, largest_moment = (
            max(
                np.linalg.norm(getattr(wrench, kind), axis=1).max(initial=0.0)
                for wrench in course.wrenches
            )
            for kind in ("forces", "moments")
        )
        is_drawn = largest_moment > NEGLIGIBLE * length * largest_force
        self._largest_moment = float(largest_moment) if is_drawn else 0.0

    @property
    def scale(self) -> str:
        """The text about the scale of moments, and about the cones."""
        texts = [f"longest moment {self._largest_moment:.3g} N m"] if self._largest_moment else []
        numbers = sorted({f"{cone.coefficient:.3g}" for cone in self._cones})
        return ", ".join([*texts, *([f"cone {' and '.join(numbers)}"] if numbers else [])])

    def draw(self, axis: Axes, number: int, width: float, height: float) -> str:
        """Draws the marks of a frame, and returns a text with the events of the last second.

        Args:
            axis: The axes of the picture, in pixels.
            number: The index of the frame.
            width, height: The size of the picture, in pixels.
        """
        course, wrench = self._course, self._course.wrenches[number]
        for cone in self._cones:
            if wrench.forces[cone.row].any():
                corners = self.cone(wrench.points[cone.row], cone.normals[number], cone.coefficient)
                pixels = self._project(corners)
                hull = pixels[ConvexHull(pixels).vertices]
                axis.fill(*hull.T, facecolor=CONE, alpha=0.3, edgecolor=CONE, linewidth=0.8)
        shape: dict[str, Any] = {"color": MOMENT, "arrowstyle": "-|>", "linewidth": 2}
        for point, moment in zip(wrench.points, wrench.moments, strict=True):
            if self._largest_moment and np.linalg.norm(moment) > 0.02 * self._largest_moment:
                tail, second, head = self.moment(point, moment)
                for end in (second, head):
                    pixels = self._project(np.array([tail, end]))
                    axis.annotate("", pixels[1], pixels[0], arrowprops=shape)
        time = course.start_time + course.times[number]
        self._draw_time(axis, float(time), width, height)
        return told([e for e in self._events if 0.0 <= time - e.time < EVENT_DURATION])

    def cone(self, point: FloatArray, normal: FloatArray, coefficient: float) -> FloatArray:
        """Returns the tip and points on the rim of a cone that opens against the normal, (k, 3)."""
        angle, turn = np.arctan(coefficient), 2.0 * np.pi * np.arange(_RIM) / _RIM
        first, second = tangents(normal)
        radial = np.outer(np.cos(turn), first) + np.outer(np.sin(turn), second)
        rim = np.cos(angle) * normal + np.sin(angle) * radial
        return np.vstack([point, point - 0.5 * self._length * rim])

    def moment(
        self, point: FloatArray, moment: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Returns the tail and both heads of the arrow of a moment, m."""
        arrow = 0.6 * self._length * moment / max(self._largest_moment, 1e-300)
        return point - arrow, point - 0.2 * arrow, point

    def _draw_time(self, axis: Axes, time: float, width: float, height: float) -> None:
        """Draws the time bar with the elapsed time, the phases and the events."""
        start, duration = self._course.start_time, float(self._course.times[-1])
        if not (self._events or self._phases) or duration <= 0.0:
            return
        y, left, right = height - 10.0, 12.0, width - 12.0

        def x_of(time: float) -> float:
            return left + (right - left) * min(max((time - start) / duration, 0.0), 1.0)

        axis.plot([left, right], [y, y], color="0.8", linewidth=3.0, solid_capstyle="butt")
        axis.plot([left, x_of(time)], [y, y], color="0.45", linewidth=3.0, solid_capstyle="butt")
        for phase in self._phases:
            axis.plot([x_of(phase)] * 2, [y - 4.0, y + 4.0], color="0.3", linewidth=1.0)
        for event in self._events:
            axis.plot(x_of(event.time), y, marker="v", markersize=6, color=event.kind.color)
