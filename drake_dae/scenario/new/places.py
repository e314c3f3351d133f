"""Places for a surface that the tip of a robot reaches well."""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.robots.constraints import PointOnSurface
from drake_dae.robots.constraints.constraint_set import ConstraintSet
from drake_dae.robots.links.links import Links
from drake_dae.robots.surfaces.surface import Vector
from drake_dae.robots.surfaces.surfaces import Plane
from drake_dae.scenario.completion.choice import first_independent
from drake_dae.scenario.completion.postures import Posture, Postures
from drake_dae.scenario.completion.search import near_posture
from drake_dae.scenario.completion.tool_axis import tool_axis
from drake_dae.trace.functions import TracedFunction

# A table, walls around, and a ceiling: axis of the normal, its sign, and the preference.
_NORMALS = (
    (2, 1.0, 1.0),
    (0, -1.0, 0.8),
    (1, -1.0, 0.7),
    (0, 1.0, 0.6),
    (1, 1.0, 0.6),
    (2, -1.0, 0.4),
)

_TRIES = 40
"""The number of postures that are tried for each normal."""

_PATIENCE = 8
"""The number of tries without a tool normal to the surface before the normal is given up."""

_SLANTED = 0.3
"""The weight of a posture with a tool that is not normal to the surface."""

_FRACTION = 0.3
"""The fraction of speed limits that a path may use; half of it for effort limits and a force."""


@dataclass(frozen=True, eq=False)
class TipPlace:
    """A place for a surface.

    Attributes:
        point: The contact point of the tip, m, shape (3,).
        axis: The axis of the world of the normal.
        sign: The sign of the normal along it.
        q: A posture there, shape (nq,).
        quality: The independence of the task's directions, from 0 to 1, reduced near limits.
        ways: The axes of the world along the surface in which it can move, one or two.
        directions: The number of directions: of the normal, two along the surface, and two angles.
        speed: The largest speed of the tip along the surface, m/s, within the joints' limits.
        force: The largest force, N, within the effort limits; infinite without limits.
        size: The size of the robot, m.
    """

    point: FloatArray
    axis: int
    sign: float
    q: FloatArray
    quality: float
    ways: tuple[int, ...]
    directions: int
    speed: float
    force: float
    size: float

    @property
    def normal(self) -> Vector:
        """The normal toward the robot."""
        x, y, z = (self.sign if k == self.axis else 0.0 for k in range(3))
        return (x, y, z)


def find_places(links: Links, tip: str, point: Vector) -> list[TipPlace]:
    """Finds the best place of a surface for each direction of its normal, the best place first.

    Each is the best of some postures, if possible with the tool normal to the surface. A posture is
    good if the task's directions are independent, joints are away from their limits, all bodies are
    on the free side, the base is beside the tip, and gravity takes less than half of the torques.

    Args:
        links: The robot.
        tip: The frame in contact.
        point: The point in it, m.
    """
    search = _PlaceSearch(links, tip, point)
    ranked = [
        (place, place.quality * place.directions * preference)
        for axis, sign, preference in _NORMALS
        if (place := search.best(axis, sign)) is not None
    ]
    return [place for place, _ in sorted(ranked, key=lambda pair: -pair[1])]


def _tilts(axis: int) -> list[int]:
    """The rows of the components of an axis of the world across the tool."""
    return [3 + 2 * axis, 4 + 2 * axis]


class _PlaceSearch:
    """Postures of a robot for surfaces that are not yet placed."""

    def __init__(self, links: Links, tip: str, point: Vector) -> None:
        self._links = links
        touch = PointOnSurface(tip, Plane((0, 0, 0), (0, 0, 1)), point).touch(links)
        axis = tool_axis(links, touch)
        rotation, place = links.rotation(tip), links.position(tip, point)
        # The tip's position, and of each axis of the world the two components across the tool.
        across = [k for k in range(3) if k != axis.column]
        rows = ca.vertcat(place, *[rotation[k, across].T for k in range(3)])
        self._postures = Postures(links, ConstraintSet(()), rows, ca.SX(0, 0), [], {})
        bodies = ca.horzsplit(links.landmarks())
        still = [body for body in bodies if not ca.depends_on(body, links.q)]
        moving = [place, *(body for body in bodies if ca.depends_on(body, links.q))]
        weight = ca.substitute(links.bias, links.v, ca.SX.zeros(links.v.numel()))
        self._function = TracedFunction(
            "places",
            {"q": links.q, "parameters": ca.vertcat(*[p.symbol for p in links.parameters])},
            {
                "outward": axis.sign * rotation[:, axis.column],
                "moving": ca.horzcat(*moving),
                "still": ca.horzcat(*still),
                "weight": weight,
            },
        )
        self._values = np.concatenate([p.value for p in links.parameters])
        speeds = links.velocity_limits[1]
        self._speeds = np.where(np.isfinite(speeds) & (speeds > 0.0), speeds, np.inf)
        efforts = np.full(links.v.numel(), np.inf)
        driven = np.argmax(np.abs(links.actuation_matrix), axis=0)
        efforts[driven] = links.effort_limits
        self._efforts = np.where(efforts > 0.0, efforts, np.inf)
        self._guesses = self._postures.guesses(_TRIES)
        self._slanted = [self._postures.at(guess) for guess in self._guesses]
        self._aligned = [self._along(axis) for axis in range(3)]

    def _along(self, axis: int) -> list[Posture]:
        """The postures with the tool along an axis of the world."""
        aligned: list[Posture] = []
        for count, guess in enumerate(self._guesses):
            if count == _PATIENCE and not aligned:
                break  # A planar robot cannot rotate its tool about some axes.
            posture = near_posture(self._postures, _tilts(axis), np.zeros(2), guess)
            aligned += [] if posture is None else [posture]
        return aligned

    def best(self, axis: int, sign: float) -> TipPlace | None:
        """The best place for a surface with a normal; None if there is none."""
        postures = [(posture, 1.0) for posture in self._aligned[axis]]
        postures += [(posture, _SLANTED) for posture in self._slanted]
        across = [k for k in range(3) if k != axis]
        directions = [axis, *across, *_tilts(axis)]
        best: tuple[float, list[int], Posture] | None = None
        for posture, weight in postures:
            share = weight * self._postures.margin(posture.q)
            share *= self._surroundings(posture, axis, sign)
            # No independence is above 1.
            if best is not None and share * len(directions) <= best[0] * len(best[1]):
                continue
            rows = first_independent(posture, [], directions, posture.q.size)
            if axis not in rows or not {*rows} & {*across}:
                continue  # The tip cannot move along the surface.
            quality = share * posture.independence(rows)
            if best is None or quality * len(rows) > best[0] * len(best[1]):
                best = quality, rows, posture
        if best is None:
            return None
        quality, rows, posture = best
        ways = tuple(row for row in rows if row in across)
        return TipPlace(
            posture.rows[:3],
            axis,
            sign,
            posture.q,
            quality,
            ways,
            len(rows),
            self._speed(posture, rows, len(ways)),
            self._force(posture, axis),
            self._postures.size,
        )

    def _surroundings(self, posture: Posture, axis: int, sign: float) -> float:
        """The factor of the quality of a posture: 0.1 for each disadvantage."""
        outward, moving, still, weight = self._function(posture.q, self._values)
        place, size = posture.rows[:3], self._postures.size
        behind = sign * (moving.reshape(3, -1)[axis] - place[axis])
        roots = still.reshape(3, -1).mean(axis=1)
        beside = place - roots
        beside[axis] = 0.0
        # A table may be as high as the base; a wall must not cut it.
        in_front = axis == 2 or sign * (roots[axis] - place[axis]) > 0.1 * size
        is_beside = axis != 2 or np.linalg.norm(beside) > 0.2 * size
        disadvantages = (
            bool(np.min(behind) < -0.02 * size),
            bool(sign * outward[axis] > -0.5),
            not in_front,
            not is_beside,
            bool(np.any(np.abs(weight) > 0.5 * self._efforts)),
        )
        return float(0.1 ** sum(disadvantages))

    def _speed(self, posture: Posture, rows: list[int], ways: int) -> float:
        """The largest speed of the tip in all directions along the surface."""
        inverse = np.linalg.pinv(posture.gradients[rows])[:, 1 : 1 + ways]
        fastest = np.max(np.abs(inverse) / self._speeds[:, None], initial=0.0)
        return float(_FRACTION / fastest) if fastest > 0.0 else np.inf

    def _force(self, posture: Posture, axis: int) -> float:
        """The largest force of the tip."""
        lever = np.abs(posture.gradients[axis])
        torque = np.max(lever / self._efforts, initial=0.0)
        return float(_FRACTION / 2 / torque) if torque > 0.0 else np.inf
