"""A contact that opens and closes, as expressions: of the model, or of the plant alone."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import casadi as ca

from drake_dae.dae.system.contacts import UnilateralInput
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.system.system import DaeSystem
from drake_dae.robots.constraints.constraint import Constraint
from drake_dae.robots.model import RobotModel

LEAST_MARGIN = 1e-9
"""Two contacts at a distance l along a peg are independent up to (l / rho)^2, with the radius of
gyration rho of what it is fixed to: forces have 7 digits at l = 3e-5 rho."""


@dataclass(frozen=True, eq=False)
class Opening:
    """A contact that opens and closes.

    Attributes:
        name: The name of the contact.
        edges: The distances of its foot from the edges of its face in m; none without edges.
        clearance: With edges, the distance from the body that it touches, in m.
        sliding: The sliding velocity in m/s, shape (s, 1); s = 0 without friction.
        friction: The name of the parameter that is its coefficient of friction; None without.
        gap: phi in m, of a contact that only the plant has.
        push: The generalized force of a unit normal force with its friction, shape (nv, 1),
            likewise.
        excludes: The names of the contacts that cannot be closed together with it.
    """

    name: str
    edges: ca.SX
    clearance: ca.SX
    sliding: ca.SX
    friction: str | None
    gap: ca.SX = field(default_factory=lambda: ca.SX(0, 1))
    push: ca.SX = field(default_factory=lambda: ca.SX(0, 1))
    excludes: frozenset[str] = frozenset()


def opening_of(constraint: Constraint, model: RobotModel) -> Opening:
    """The contact of a constraint of a robot."""
    links, kinematics = model.links, model.links.kinematics()
    sliding, friction = constraint.sliding(kinematics), constraint.friction_parameter
    slides = sliding is not None and friction is not None
    edges, clearance = constraint.edges(links), ca.SX(0)
    if edges.numel() and (touch := constraint.touch(links)) is not None:
        clearance = touch.clearance(links.position(touch.frame, touch.point))
    return Opening(
        name=constraint.name,
        edges=edges,
        clearance=clearance,
        sliding=kinematics.value(sliding) if slides else ca.SX(0, 1),
        friction=friction if slides else None,
    )


def with_openings(model: RobotModel, openings: Sequence[Opening]) -> DaeSystem:
    """The system of a robot with further contacts, whose rows follow its constraints.

    Args:
        model: The robot.
        openings: The contacts that its system does not have.
    """
    dae, count = model.dae, len(openings)
    if not count:
        return dae
    before = model.links.q.numel()
    push = ca.horzcat(*(opening.push for opening in openings))
    after = ca.SX(dae.num_states - before - push.shape[0], count)
    contacts = tuple(
        UnilateralInput(f"{opening.name}.force", opening.friction, opening.sliding)
        for opening in openings
    )
    return replace(
        dae,
        g=ca.horzcat(dae.g, ca.vertcat(ca.SX(before, count), push, after)),
        k=ca.vertcat(dae.k, *(opening.gap for opening in openings)),
        m=ca.horzcat(dae.m, ca.SX(dae.num_outputs, count)),
        constraint_input_signals=(
            *dae.constraint_input_signals,
            *(Signal(f"{opening.name}.force", "N") for opening in openings),
        ),
        constraint_output_signals=(
            *dae.constraint_output_signals,
            *(Signal(f"{opening.name}.distance", "m") for opening in openings),
        ),
        implicit=None,
        least_margin=LEAST_MARGIN,
        contacts=(*dae.contacts, *contacts) if dae.contacts else (),
    )


def may_close(openings: Sequence[Opening], closed: Sequence[bool]) -> bool:
    """Whether contacts can be closed together by the shapes of bodies, one flag for each."""
    shut = [opening for opening, flag in zip(openings, closed, strict=True) if flag]
    names = {opening.name for opening in shut}
    return not any(names & opening.excludes for opening in shut)
