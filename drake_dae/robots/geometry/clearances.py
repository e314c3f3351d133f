"""The distances of a robot's links from the surfaces that it touches."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from drake_dae.arrays import Booleans, FloatArray
from drake_dae.robots.constraints.constraint import Touch
from drake_dae.robots.geometry.shapes import TOUCHING, LeastDistance, LinkShapes, sampled
from drake_dae.robots.model import RobotModel
from drake_dae.trace.functions import TracedFunction

ORIGIN_DEPTH = 0.05
"""The depth at which a link's origin counts as behind a surface, relative to its distance from the
contact: tools lie along a surface, and surfaces are compliant."""

CORNER_DEPTH = 0.01
"""The same depth for a corner of its shape."""

NEARER = 1.1
"""A link counts if its distance from the contact is below this many times its distance from the
nearest fixed link."""


MOST_ORIGIN_STATES = 300
"""The largest number of examined states of a motion for origins of links."""


@dataclass(frozen=True)
class LinkBehind:
    """A link or its contact point that goes behind a surface.

    Attributes:
        constraint: The name of the constraint that has the surface.
        link: The name of the frame of the link, or of the contact point.
        depth: The largest depth of its origin, or of a corner of its shape, in m.
        time: The time of the largest depth, in s.
        since: The first time at which it is behind the surface, in s.
    """

    constraint: str
    link: str
    depth: float
    time: float
    since: float

    def __str__(self) -> str:
        when = f"at {self.time:.4g} s" if self.time == self.since else f"from {self.since:.4g} s on"
        return (
            f"{self.link} is behind the surface of '{self.constraint}' {when}, by up to "
            f"{self.depth:.3g} m"
        )


def surface_distances(
    model: RobotModel,
    times: FloatArray,
    states: FloatArray,
    parameters: FloatArray,
    shapes: LinkShapes | None = None,
) -> tuple[LeastDistance, ...]:
    """The link that comes closest to each surface along a motion.

    Links at the contact, and links farther from it than from fixed links, do not count, as for
    `links_behind`.

    Args:
        model: The robot.
        times: The times of the motion in s, shape (k,).
        states: x at these times, shape (k, n).
        parameters: The values of all parameters at these times, shape (k, P).
        shapes: The collision geometry of the links; without any, their origins.
    """
    distances, chosen = list[LeastDistance](), sampled(len(times))
    for surface in _surfaces(model, times):
        nearest = surface.nearest(times[chosen], states[chosen], parameters[chosen], shapes)
        distances += [nearest] if nearest is not None else []
    return tuple(distances)


def links_behind(
    model: RobotModel,
    times: FloatArray,
    states: FloatArray,
    parameters: FloatArray,
    shapes: LinkShapes | None = None,
) -> tuple[LinkBehind, ...]:
    """The deepest link behind each surface along a motion.

    The depth of a link is that of the origin of its frame, or with `shapes` of the corners of its
    collision geometry. A real surface may end before it reaches the robot's base, such as a table
    beside the robot. So a link counts only if it is not much farther from the contact than from
    fixed links. Where all fixed links are in front of the surface, the shapes of all links count,
    except those that are next to the base. The shapes of links at the contact never count.

    Args:
        model: The robot.
        times: The times of the motion in s, shape (k,).
        states: x at these times, shape (k, n).
        parameters: The values of all parameters at these times, shape (k, P).
        shapes: The collision geometry of the links; None for origins alone.
    """
    deepest: list[LinkBehind] = []
    for surface in _surfaces(model, times):
        chosen = sampled(len(times), MOST_ORIGIN_STATES)
        candidates = [surface.deepest(times[chosen], states[chosen], parameters[chosen])]
        if shapes:
            chosen = sampled(len(times))
            candidates.append(
                surface.deepest_shape(shapes, times[chosen], states[chosen], parameters[chosen])
            )
        behind = [link for link in candidates if link is not None]
        deepest += [max(behind, key=lambda link: link.depth)] if behind else []
    return tuple(deepest)


def _surfaces(model: RobotModel, times: FloatArray) -> Iterator["_Surface"]:
    """The surfaces that a robot touches; none for a motion without times."""
    for constraint in model.constraints if len(times) else ():
        touch = constraint.touch(model.links)
        if touch is not None:
            yield _Surface(model, constraint.name, touch)


class _Surface:
    """The depths of links behind a surface along a motion."""

    def __init__(self, model: RobotModel, name: str, touch: Touch) -> None:
        links, self._name, self._touch = model.links, name, touch
        points = ca.horzsplit(links.landmarks())
        moves = [ca.depends_on(point, links.q) for point in points]
        pairs = list(zip(links.landmark_names, points, moves, strict=True))
        self._links = [name for name, _, moving in pairs if moving]  # Two robots may share names.
        of_links = [point for _, point, moving in pairs if moving]
        # The world's origin is not part of a robot with a floating base.
        fixed = [point for name, point, moving in pairs if not moving and name != "world"]
        contact = links.position(touch.frame, touch.point)
        self._nq = links.q.numel()
        inputs = {"q": links.q, "parameters": model.dae.parameter_symbol}
        depths = [-touch.clearance(point) for point in of_links]
        self._origins = TracedFunction(
            "clearances",
            inputs,
            {
                "depths": ca.densify(ca.vertcat(*depths)),
                "to_contact": _distances(of_links, [contact]),
                "to_base": _distances(of_links, fixed),
            },
        )
        self._inputs, self._contact, self._fixed = inputs, contact, fixed

    @cached_property
    def _corner(self) -> ca.Function:
        """The function (point, q, parameters) -> the depths and distances of a corner.

        They are its depth, its distances from the contact and from fixed links, and the largest
        depth of fixed links.
        """
        point, clearance = ca.SX.sym("point", 3), self._touch.clearance
        fixed_depths = [-clearance(fixed) for fixed in self._fixed]
        return ca.Function(
            "corner",
            [point, *self._inputs.values()],
            [
                -clearance(point),
                ca.norm_2(point - self._contact),
                _distances([point], self._fixed),
                ca.mmax(ca.vertcat(-ca.inf, *fixed_depths)),
            ],
        )

    def deepest(
        self, times: FloatArray, states: FloatArray, parameters: FloatArray
    ) -> LinkBehind | None:
        """The link whose origin is deepest; None if none is behind."""
        if not self._links:
            return None
        depths, to_contact, counts = self._origins_along(states, parameters)
        counts &= depths > ORIGIN_DEPTH * to_contact
        return self._worst(times, np.where(counts, depths, 0.0), self._links)

    def deepest_shape(
        self, shapes: LinkShapes, times: FloatArray, states: FloatArray, parameters: FloatArray
    ) -> LinkBehind | None:
        """The link whose shape is deepest; None if none is behind."""
        depths = self._depths_of_shapes(shapes, states, parameters, True)
        if depths is None:
            return None
        names = [shapes.name(index) for index in range(shapes.count)]
        return self._worst(times, np.maximum(depths, 0.0), names)

    def nearest(
        self,
        times: FloatArray,
        states: FloatArray,
        parameters: FloatArray,
        shapes: LinkShapes | None,
    ) -> LeastDistance | None:
        """The link that comes closest; None if none counts."""
        depths, of_origin = None, True
        if shapes:
            depths, of_origin = self._depths_of_shapes(shapes, states, parameters, False), False
            names = [shapes.name(index) for index in range(shapes.count)]
        if depths is None or not np.isfinite(depths).any():
            if not self._links:
                return None
            of_origins, _, counts = self._origins_along(states, parameters)
            depths, names, of_origin = np.where(counts, of_origins, -np.inf), self._links, True
        if not np.isfinite(depths).any():
            return None
        row, column = divmod(int(np.argmax(depths)), len(names))
        distance, time = -float(depths[row, column]), float(times[row])
        return LeastDistance(names[column], self._name, True, of_origin, distance, time)

    def _origins_along(
        self, states: FloatArray, parameters: FloatArray
    ) -> tuple[FloatArray, FloatArray, Booleans]:
        """The depths of origins, their distances from the contact, and which count, by states."""
        values = [
            [value.ravel().copy() for value in self._origins(state[: self._nq], numbers)]
            for state, numbers in zip(states, parameters, strict=True)
        ]
        depths, to_contact, to_base = (np.array(table) for table in zip(*values, strict=True))
        counts = to_contact < NEARER * to_base
        # Links at the contact itself are on the surface.
        counts &= to_contact > ORIGIN_DEPTH * to_contact.max(axis=1, keepdims=True)
        return depths, to_contact, counts

    def _depths_of_shapes(
        self, shapes: LinkShapes, states: FloatArray, parameters: FloatArray, behind: bool
    ) -> FloatArray | None:
        """The depths of the shapes of links, one row for each state; -inf for links without any.

        Args:
            shapes: The shapes.
            states: x, one row for each time.
            parameters: The values of all parameters, one row for each time.
            behind: Whether only shapes count that are certainly behind the surface.

        Returns:
            The depths, shape (k, links); None if all links are at the contact.
        """
        at_contact, at_base, rows = shapes.moved_with(self._touch.frame), shapes.at_base(), []
        if shapes.links <= at_contact:
            return None
        for state, numbers in zip(states, parameters, strict=True):
            shapes.place(state)
            row = np.full(shapes.count, -np.inf)
            for index, points, radius in shapes.corners():
                if index in at_contact:
                    continue
                values = self._corner(points.T, state[: self._nq], numbers)
                depth, to_contact, to_base, base = (np.array(value).ravel() for value in values)
                counts = to_contact < NEARER * to_base
                if behind:
                    if index not in at_base:
                        counts |= base < TOUCHING
                    counts &= depth + radius > np.maximum(TOUCHING, CORNER_DEPTH * to_contact)
                row[index] = max(row[index], np.max(np.where(counts, depth + radius, -np.inf)))
            rows.append(row)
        return np.array(rows)

    def _worst(
        self, times: FloatArray, depths: FloatArray, names: Sequence[str]
    ) -> LinkBehind | None:
        row, column = divmod(int(np.argmax(depths)), len(names))
        if not depths[row, column] > 0.0:
            return None
        since = times[np.argmax(depths[:, column] > 0.0)]
        depth, time = float(depths[row, column]), float(times[row])
        return LinkBehind(self._name, names[column], depth, time, float(since))


def _distances(points: Sequence[ca.SX], others: Sequence[ca.SX]) -> ca.SX:
    """The distance of each point from the nearest of others, shape (k, 1); infinite without any."""
    rows = [
        ca.mmin(ca.vertcat(ca.inf, *[ca.norm_2(point - other) for other in others]))
        for point in points
    ]
    return ca.densify(ca.vertcat(*rows))
