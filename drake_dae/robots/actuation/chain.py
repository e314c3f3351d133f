"""Stages wired from the joints to the control."""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from drake_dae.dae.signals import Signal
from drake_dae.errors import ModelError
from drake_dae.robots.actuation.flexible_joints import FlexibleJoints
from drake_dae.robots.actuation.stage import AttachedStage, Stage
from drake_dae.robots.links.links import Links


@dataclass(frozen=True, eq=False)
class ActuationChain:
    """Stages attached to a robot, wired from the joints to the control.

    Attributes:
        stages: In this order, toward the motor; none for rigid joints.
        joint_force: tau(q, v, s), what the joints get from the stages, shape (p, 1).
        direct: What the joints get from u at once, shape (p, p): 1 for rigid joints, otherwise 0.
        state: All stages' states, shape (k, 1).
        mass, drift, drive: E s' = drift + drive u, shapes (k, k), (k, 1), (k, p).
        control_signals: Names and units of u.
    """

    stages: tuple[AttachedStage, ...]
    joint_force: ca.SX
    direct: ca.SX
    state: ca.SX
    mass: ca.SX
    drift: ca.SX
    drive: ca.SX
    control_signals: tuple[Signal, ...]


def chain(
    stages: Sequence[Stage], links: Links, position: ca.SX, velocity: ca.SX
) -> ActuationChain:
    """Wires stages: each drives the one before it, the control drives the last.

    Args:
        stages: From the joints toward the motor.
        links: The robot.
        position: Actuated positions, shape (p, 1).
        velocity: Actuated velocities, shape (p, 1).

    Raises:
        ModelError: A stage behind one that nothing can drive.
    """
    p = position.numel()
    if not stages:
        none = ca.SX(0, 1)
        return ActuationChain(
            stages=(),
            joint_force=ca.SX(p, 1),
            direct=ca.SX.eye(p),
            state=none,
            mass=ca.SX(0, 0),
            drift=none,
            drive=ca.SX(0, p),
            control_signals=tuple(links.actuator_signals),
        )
    attached = [stage.attach(links) for stage in stages]
    loads = [(position, velocity)]
    for stage, before in zip(stages[1:], attached, strict=False):
        if before.shaft is None:
            raise ModelError(
                f"{type(stage).__name__} cannot stand behind an electric or hydraulic stage, "
                "which has no shaft to drive; these come last"
            )
        if isinstance(stage, FlexibleJoints):
            raise ModelError("FlexibleJoints come once in a chain; put both springs into one")
        loads.append(before.shaft)
    delivered = [own.force(*load) for own, load in zip(attached, loads, strict=True)]
    drifts = [own.drift(*load) for own, load in zip(attached, loads, strict=True)]
    for i, force in enumerate(delivered[1:]):
        drifts[i] += ca.mtimes(attached[i].drive_matrix, force)
    idle = sum(own.state.numel() for own in attached[:-1])
    return ActuationChain(
        stages=tuple(attached),
        joint_force=delivered[0],
        direct=ca.SX(p, p),
        state=ca.vertcat(*[own.state for own in attached]),
        mass=ca.diagcat(*[own.mass for own in attached]),
        drift=ca.vertcat(*drifts),
        drive=ca.vertcat(ca.SX(idle, p), attached[-1].drive_matrix),
        control_signals=attached[-1].drive_signals,
    )
