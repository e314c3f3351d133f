"""Whether the links of a robot are on the free side of the surfaces that it touches."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from drake_dae.arrays import Booleans, FloatArray
from drake_dae.robots.constraints.constraint import Touch
from drake_dae.robots.geometry.shapes import TOUCHING, LeastDistance, LinkShapes, moments
from drake_dae.robots.model import RobotModel
from drake_dae.trace.functions import TracedFunction

SHARE = 0.05
"""A link counts as behind a surface where it is so deep, relative to its distance from the contact:
tools lie along a surface, and surfaces give way."""

SHAPE = 0.01
"""So deep, relative to the same distance, a corner of its shape is."""

NEARER = 1.1
"""A link belongs to the contact where its distance from there is below so many times that from what
stands still."""

MOST = 300
"""So many states of a motion are looked at, at most."""


@dataclass(frozen=True)
class LinkBehind:
    """A link that goes behind a surface.

    Attributes:
        constraint: The name of the constraint that has the surface.
        link: The name of the link's frame.
        depth: How far its origin, or a corner of its shape, is behind the surface at most, in m.
        time: When, in s.
        since: When it is first behind, in s.
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

    Which links count is as for `links_behind`: not what is at the contact, nor what is farther from
    it than from what stands still.

    Args:
        model: The robot.
        times: The times of the motion in s, shape (k,).
        states: x at these times, shape (k, n).
        parameters: The values of all parameters at these times, shape (k, P).
        shapes: The collision geometry of the links; without any a link is its origin.
    """
    found, chosen = list[LeastDistance](), moments(len(times))
    for constraint in model.constraints if len(times) else ():
        touch = constraint.touch(model.links)
        if touch is None:
            continue
        surface = _Surface(model, constraint.name, touch)
        nearest = surface.nearest(times[chosen], states[chosen], parameters[chosen], shapes)
        found += [nearest] if nearest is not None else []
    return tuple(found)


def links_behind(
    model: RobotModel,
    times: FloatArray,
    states: FloatArray,
    parameters: FloatArray,
    shapes: LinkShapes | None = None,
) -> tuple[LinkBehind, ...]:
    """The deepest link behind each surface, along a motion.

    A link is where the origin of its frame is, and with `shapes` where corners of its collision
    geometry are; its surface is asked for the distance there. A surface may end before it reaches
    the robot's base, as a table does that the robot stands beside. So a link counts where it is not
    farther from the contact than from what stands still; its shape also where that is in front of
    the surface, if it is not the first link. The shapes of what is at the contact do not count.

    Args:
        model: The robot.
        times: The times of the motion in s, shape (k,).
        states: x at these times, shape (k, n).
        parameters: The values of all parameters at these times, shape (k, P).
        shapes: The collision geometry of the links, if it is to be looked at.
    """
    if not len(times):
        return ()
    found: list[LinkBehind] = []
    for constraint in model.constraints:
        touch, chosen = constraint.touch(model.links), moments(len(times), MOST)
        if touch is None:
            continue
        surface = _Surface(model, constraint.name, touch)
        tried = [surface.deepest(times[chosen], states[chosen], parameters[chosen])]
        if shapes:
            chosen = moments(len(times))
            tried.append(
                surface.deepest_shape(shapes, times[chosen], states[chosen], parameters[chosen])
            )
        behind = [one for one in tried if one is not None]
        found += [max(behind, key=lambda one: one.depth)] if behind else []
    return tuple(found)


class _Surface:
    """What is behind a surface, along a motion."""

    def __init__(self, model: RobotModel, name: str, touch: Touch) -> None:
        links, self._name, self._touch = model.links, name, touch
        points = ca.horzsplit(links.landmarks())
        moving = [ca.depends_on(point, links.q) for point in points]
        pairs = list(zip(links.landmark_names, points, moving, strict=True))
        self._links = [name for name, _, yes in pairs if yes]
        of_links = [point for _, point, yes in pairs if yes]
        # The world's own origin is no part of a robot that moves freely.
        still = [point for name, point, yes in pairs if not yes and name != "world"]
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
                "to_base": _distances(of_links, still),
            },
        )
        self._inputs, self._contact, self._still = inputs, contact, still

    @cached_property
    def _corner(self) -> ca.Function:
        """From points (3, k), q and parameters to how deep they are, and their distances."""
        point, clearance = ca.SX.sym("point", 3), self._touch.clearance
        of_still = [-clearance(each) for each in self._still]
        return ca.Function(
            "corner",
            [point, *self._inputs.values()],
            [
                -clearance(point),
                ca.norm_2(point - self._contact),
                _distances([point], self._still),
                ca.mmax(ca.vertcat(-ca.inf, *of_still)),
            ],
        )

    def deepest(
        self, times: FloatArray, states: FloatArray, parameters: FloatArray
    ) -> LinkBehind | None:
        """The link whose origin is deepest; None if none is behind."""
        found = self._origins_along(states, parameters)
        if found is None:
            return None
        depths, to_contact, counts = found
        counts &= depths > SHARE * to_contact
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
            found, names, of_origin = self._origins_along(states, parameters), self._links, True
            depths = None if found is None else np.where(found[2], found[0], -np.inf)
        if depths is None or not np.isfinite(depths).any():
            return None
        row, column = divmod(int(np.argmax(depths)), len(names))
        distance, time = -float(depths[row, column]), float(times[row])
        return LeastDistance(names[column], self._name, True, of_origin, distance, time)

    def _origins_along(
        self, states: FloatArray, parameters: FloatArray
    ) -> tuple[FloatArray, FloatArray, Booleans] | None:
        """How deep origins of links are, how far from the contact, and which count, by states."""
        if not self._links:
            return None
        values = [
            [value.ravel().copy() for value in self._origins(state[: self._nq], own)]
            for state, own in zip(states, parameters, strict=True)
        ]
        depths, to_contact, to_base = (np.array(each) for each in zip(*values, strict=True))
        counts = to_contact < NEARER * to_base
        # What is at the contact itself is on the surface.
        counts &= to_contact > SHARE * to_contact.max(axis=1, keepdims=True)
        return depths, to_contact, counts

    def _depths_of_shapes(
        self, shapes: LinkShapes, states: FloatArray, parameters: FloatArray, behind: bool
    ) -> FloatArray | None:
        """How deep the shapes of links are, one row for each state; -inf where none counts.

        Args:
            shapes: The shapes.
            states: x, one row for each moment.
            parameters: The values of all parameters, one row for each moment.
            behind: Whether only shapes count that are behind the surface by more than they touch.
        """
        at_contact, at_base, found = shapes.moved_with(self._touch.frame), shapes.at_base(), []
        if shapes.links <= at_contact:
            return None
        for state, own in zip(states, parameters, strict=True):
            shapes.place(state)
            row = np.full(shapes.count, -np.inf)
            for index, points, radius in shapes.corners():
                if index in at_contact:
                    continue
                values = self._corner(points.T, state[: self._nq], own)
                depth, to_contact, to_base, base = (np.array(each).ravel() for each in values)
                counts = to_contact < NEARER * to_base
                if behind:
                    if index not in at_base:
                        counts |= base < TOUCHING
                    counts &= depth + radius > np.maximum(TOUCHING, SHAPE * to_contact)
                row[index] = max(row[index], np.max(np.where(counts, depth + radius, -np.inf)))
            found.append(row)
        return np.array(found)

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
    """How far each point is from the nearest of some others, shape (k, 1); infinite without any."""
    rows = [
        ca.mmin(ca.vertcat(ca.inf, *[ca.norm_2(point - other) for other in others]))
        for point in points
    ]
    return ca.densify(ca.vertcat(*rows))
