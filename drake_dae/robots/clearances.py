"""Whether the links of a robot are on the free side of the surfaces that it touches."""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.robots.constraints import Constraint
from drake_dae.robots.model import RobotModel
from drake_dae.trace.functions import TracedFunction

SHARE = 0.05
"""A link counts as behind a surface where it is so deep, relative to its distance from the contact:
tools lie along a surface, and surfaces give way."""

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
        depth: How far its origin is behind the surface at most, in m.
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


def links_behind(
    model: RobotModel, times: FloatArray, states: FloatArray, parameters: FloatArray
) -> tuple[LinkBehind, ...]:
    """The deepest link behind each surface, along a motion.

    A link is where the origin of its frame is, and its surface asked for the distance there. A
    surface may end before it reaches the robot's base, as a table does that the robot stands
    beside. So a link counts where it is not farther from the contact than from what stands still.
    Between the origins of frames nothing is looked at, and no link is compared with another one.

    Args:
        model: The robot.
        times: The times of the motion in s, shape (k,).
        states: x at these times, shape (k, n).
        parameters: The values of all parameters at these times, shape (k, P).
    """
    chosen = np.unique(np.linspace(0, len(times) - 1, min(len(times), MOST)).astype(int))
    found = [
        _deepest(model, constraint, times[chosen], states[chosen], parameters[chosen])
        for constraint in model.constraints
        if len(times)
    ]
    return tuple(one for one in found if one is not None)


def _deepest(
    model: RobotModel,
    constraint: Constraint,
    times: FloatArray,
    states: FloatArray,
    parameters: FloatArray,
) -> LinkBehind | None:
    """The link that goes deepest behind the surface of one constraint; None if none does."""
    links = model.links
    touch = constraint.touch(links)
    if touch is None:
        return None
    points = ca.horzsplit(links.landmarks())
    moving = [ca.depends_on(point, links.q) for point in points]
    names = [name for name, yes in zip(links.landmark_names, moving, strict=True) if yes]
    of_links = [point for point, yes in zip(points, moving, strict=True) if yes]
    # The world's own origin is no part of a robot that moves freely.
    still = [
        point
        for name, point, yes in zip(links.landmark_names, points, moving, strict=True)
        if not yes and name != "world"
    ]
    if not of_links:
        return None
    contact = links.position(touch.frame, touch.point)
    function = TracedFunction(
        "clearances",
        {"q": links.q, "parameters": model.dae.parameter_symbol},
        {
            "depths": -ca.vertcat(*[touch.clearance(point) for point in of_links]),
            "to_contact": _distances(of_links, [contact]),
            "to_base": _distances(of_links, still),
        },
    )
    nq = links.q.numel()
    values = [
        [value.ravel().copy() for value in function(state[:nq], own)]
        for state, own in zip(states, parameters, strict=True)
    ]
    depths, to_contact, to_base = (np.array(each) for each in zip(*values, strict=True))
    counts = (depths > SHARE * to_contact) & (to_contact < NEARER * to_base)
    # What is at the contact itself is on the surface.
    counts &= to_contact > SHARE * to_contact.max(axis=1, keepdims=True)
    if not counts.any():
        return None
    row, column = np.unravel_index(np.argmax(np.where(counts, depths, 0.0)), depths.shape)
    return LinkBehind(
        constraint.name,
        names[column],
        float(depths[row, column]),
        float(times[row]),
        float(times[np.argmax(counts[:, column])]),
    )


def _distances(points: Sequence[ca.SX], others: Sequence[ca.SX]) -> ca.SX:
    """How far each point is from the nearest of some others, shape (k, 1); infinite without any."""
    rows = [
        ca.mmin(ca.vertcat(ca.inf, *[ca.norm_2(point - other) for other in others]))
        for point in points
    ]
    return ca.densify(ca.vertcat(*rows))
