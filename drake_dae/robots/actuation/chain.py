"""Stages wired from the joints to the control."""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from drake_dae.dae import Parameter, Signal
from drake_dae.errors import ModelError
from drake_dae.robots.actuation.stage import AttachedStage, Stage
from drake_dae.robots.links.links import Links


@dataclass(frozen=True, eq=False)
class ActuationChain:
    """Stages attached to a robot, wired from the joints to the control.

    Attributes:
        stages: The stages from the joints toward the motor; none for rigid joints.
        joint_force: tau(q, v, s), the forces of the stages on the joints, shape (p, 1); 0 for rigid
            joints.
        direct: The direct action of u on the joints, shape (p, p): 1 for rigid joints, otherwise 0.
        state: The states of all stages, shape (k, 1).
        mass, drift, drive: E s' = drift + drive u, shapes (k, k), (k, 1), (k, p).
        control_signals: Names and units of u.
        parameters: The parameters of all stages.
    """

    stages: tuple[AttachedStage, ...]
    joint_force: ca.SX
    direct: ca.SX
    state: ca.SX
    mass: ca.SX
    drift: ca.SX
    drive: ca.SX
    control_signals: tuple[Signal, ...]
    parameters: tuple[Parameter, ...]

    @property
    def carries_rotors(self) -> bool:
        """Whether the rotors move with a stage instead of the links."""
        return any(stage.carries_rotors for stage in self.stages)

    @property
    def state_signals(self) -> tuple[Signal, ...]:
        """Names and units of all stages' states."""
        return tuple(signal for stage in self.stages for signal in stage.state_signals)


def chain(stages: Sequence[Stage], links: Links) -> ActuationChain:
    """Wires stages: each drives the one before it, the control drives the last.

    Args:
        stages: The stages from the joints toward the motor.
        links: The robot.

    Raises:
        ModelError: There are no actuators, a stage follows one without a shaft, two stages carry
            the rotors, or the actuators do not each drive their own joint velocity.
    """
    if not stages:
        return _rigid_joints(links)
    if not links.actuator_signals:
        raise ModelError(
            f"{type(stages[0]).__name__} needs actuators of the links, and there are none"
        )
    position, velocity = _actuated(links)
    p = position.numel()
    attached = [stage.attach(links) for stage in stages]
    names = [type(stage).__name__ for stage in stages]
    _check_rotors(names, attached)
    loads = [(position, velocity)]
    for name, other, before in zip(names[1:], names, attached, strict=False):
        if before.shaft is None:
            raise ModelError(f"{name} cannot drive {other}, which has no shaft; put {other} last")
        loads.append(before.shaft)
    delivered = [stage.force(*load) for stage, load in zip(attached, loads, strict=True)]
    drifts = [stage.drift(*load) for stage, load in zip(attached, loads, strict=True)]
    for i, force in enumerate(delivered[1:]):
        drifts[i] += ca.mtimes(attached[i].drive_matrix, force)
    idle = sum(stage.state.numel() for stage in attached[:-1])
    return ActuationChain(
        stages=tuple(attached),
        joint_force=delivered[0],
        direct=ca.SX(p, p),
        state=ca.vertcat(*[stage.state for stage in attached]),
        mass=ca.diagcat(*[stage.mass for stage in attached]),
        drift=ca.vertcat(*drifts),
        drive=ca.vertcat(ca.SX(idle, p), attached[-1].drive_matrix),
        control_signals=attached[-1].drive_signals,
        parameters=tuple(p for stage in attached for p in stage.parameters),
    )


def _rigid_joints(links: Links) -> ActuationChain:
    """The chain without a stage: the control is the joint force."""
    p, none = len(links.actuator_signals), ca.SX(0, 1)
    return ActuationChain(
        stages=(),
        joint_force=ca.SX(p, 1),
        direct=ca.SX.eye(p),
        state=none,
        mass=ca.SX(0, 0),
        drift=none,
        drive=ca.SX(0, p),
        control_signals=tuple(links.actuator_signals),
        parameters=(),
    )


def _actuated(links: Links) -> tuple[ca.SX, ca.SX]:
    """Positions and velocities of the actuated joints, shape (p, 1) each."""
    select = links.actuation_matrix
    if not np.allclose(select.T @ select, np.eye(select.shape[1])):
        raise ModelError(
            "actuation stages need one actuator per actuated joint, so orthonormal columns of the "
            "actuation matrix"
        )
    transposed = ca.SX(ca.sparsify(ca.DM(select.T)))
    rates = ca.mtimes(transposed, links.velocity_map)
    if not ca.is_equal(ca.sparsify(rates), transposed, 9):
        raise ModelError(
            "actuation stages need the actuated velocities to be derivatives of positions, "
            "q_i' = v_i: choose such coordinates where N(q) is not the identity"
        )
    return ca.mtimes(transposed, links.q), ca.mtimes(transposed, links.v)


def _check_rotors(names: Sequence[str], attached: Sequence[AttachedStage]) -> None:
    """Refuses rotors in more than one stage, since they would count twice."""
    carriers = [n for n, stage in zip(names, attached, strict=True) if stage.carries_rotors]
    if len(carriers) > 1:
        raise ModelError(
            f"the rotors would turn with each of {', '.join(carriers)}, but stages that carry them "
            "come once in a chain; put all springs into one"
        )
