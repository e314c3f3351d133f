"""Stages of actuation between the control and the joints, and their chain.

Without stages the joints are rigid (37), and the control is the joint torque. A stage applies a
force to its load, the joints or the shaft of the previous stage, and is driven by the next stage or
by the control. All positions, velocities and forces are on the joints' side of the gears.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arrays import FloatArray, numbers
from drake_dae.dae import Parameter, Signal
from drake_dae.errors import ModelError
from drake_dae.robots.links.links import Links


@dataclass(frozen=True, eq=False)
class AttachedStage:
    """A stage at the p actuators of one robot: E s' = drift(load) + drive_matrix * drive.

    The load is given by its position and velocity, shape (p, 1) each.
    """

    state: ca.SX  # s, symbols, shape (k, 1).
    state_signals: tuple[Signal, ...]
    mass: ca.SX  # E, shape (k, k), symmetric positive definite.
    drift: Callable[[ca.SX, ca.SX], ca.SX]  # The load -> shape (k, 1).
    drive_matrix: ca.SX  # Shape (k, p).
    drive_signals: tuple[Signal, ...]
    force: Callable[[ca.SX, ca.SX], ca.SX]  # The load -> the force on it, shape (p, 1).
    parameters: tuple[Parameter, ...] = ()
    ports: Mapping[str, slice] = field(default_factory=dict)  # Port of the plant -> entries of s.
    shaft: tuple[ca.SX, ca.SX] | None = None  # Position and velocity of what a next stage drives.
    carries_rotors: bool = False  # Whether rotors move with it instead of the links.


class Stage(ABC):
    """One kind of actuation, to be attached to a robot.

    1. `attach` gives equations for the p actuators of the given links, in new symbols for the
       state; the stage itself does not change and can be attached to many robots.
    2. Numbers are `parameters` of these equations, with names that begin with the kind, as
       "dc_motors.resistance". An invalid value raises ModelError with the name and the value.
    3. E is symmetric positive definite. `drift` and `force` are smooth, and depend on s, on
       parameters, and on the load's position and velocity, not on the drive: so the control does
       not reach the joints in the same instant.
    4. Another stage can drive it exactly if there is a `shaft`; its drive is then a force.
    5. At rest, the drive can balance any force on the load: s' = 0 has a solution (s, drive).
    6. Names of states and ports are unique in a chain. At most one stage carries the rotors.
    """

    @abstractmethod
    def attach(self, links: Links) -> AttachedStage:
        """The equations at the actuators of these links; ModelError if a value does not fit."""


@dataclass(frozen=True, eq=False)
class ActuationChain:
    """Stages attached to a robot, from the joints toward the motor: E s' = drift + drive u."""

    stages: tuple[AttachedStage, ...]  # Empty for rigid joints.
    joint_force: ca.SX  # tau(q, v, s), shape (p, 1); 0 for rigid joints.
    direct: ca.SX  # Of u on the joints, shape (p, p): 1 for rigid joints, otherwise 0.
    mass: ca.SX  # E, shape (k, k).
    drift: ca.SX
    drive: ca.SX  # Shape (k, p).
    control_signals: tuple[Signal, ...]

    @property
    def state(self) -> ca.SX:
        """The states of all stages, shape (k, 1)."""
        return ca.vertcat(ca.SX(0, 1), *[stage.state for stage in self.stages])

    @property
    def state_signals(self) -> tuple[Signal, ...]:
        return tuple(signal for stage in self.stages for signal in stage.state_signals)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(parameter for stage in self.stages for parameter in stage.parameters)

    @property
    def carries_rotors(self) -> bool:
        """Whether the rotors move with a stage instead of the links."""
        return any(stage.carries_rotors for stage in self.stages)


def chain(stages: Sequence[Stage], links: Links) -> ActuationChain:
    """Wires stages from the joints toward the motor: each drives the one before it."""
    p = len(links.actuator_signals)
    if not stages:  # Rigid joints: the control is the joint force.
        none = ca.SX(0, 1), ca.SX(0, p)
        rigid = ca.SX(p, 1), ca.SX.eye(p), ca.SX(0, 0), *none
        return ActuationChain((), *rigid, tuple(links.actuator_signals))
    names = [type(stage).__name__ for stage in stages]
    if not p:
        raise ModelError(f"{names[0]} needs actuators of the links, and there are none")
    select = links.actuation_matrix
    if not np.allclose(select.T @ select, np.eye(p)):
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
    attached = [stage.attach(links) for stage in stages]
    carriers = [n for n, stage in zip(names, attached, strict=True) if stage.carries_rotors]
    if len(carriers) > 1:
        raise ModelError(
            f"the rotors would turn with each of {', '.join(carriers)}, but stages that carry them "
            "come once in a chain; put all springs into one"
        )
    loads = [(ca.mtimes(transposed, links.q), ca.mtimes(transposed, links.v))]
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
        mass=ca.diagcat(*[stage.mass for stage in attached]),
        drift=ca.vertcat(*drifts),
        drive=ca.vertcat(ca.SX(idle, p), attached[-1].drive_matrix),
        control_signals=attached[-1].drive_signals,
    )


def full_matrix(name: str, value: ArrayLike, size: int) -> FloatArray:
    """A finite number, a diagonal or a matrix, as a matrix of shape (size, size)."""
    array = numbers(name, value)
    if array.ndim == 0:
        array = np.full(size, float(array))
    if array.ndim == 1:
        array = np.diag(array)
    if array.shape != (size, size) or not np.all(np.isfinite(array)):
        raise ModelError(
            f"{name} must be a finite number, shape ({size},) or ({size}, {size}), got {value!r}"
        )
    return array


def diagonal_parameter(
    name: str,
    value: ArrayLike,
    size: int,
    unit: str,
    positive: bool = False,
    nonnegative: bool = False,
) -> tuple[Parameter, ca.SX]:
    """A parameter of one number per actuator, and its symbol, shape (size, 1)."""
    array = numbers(name, value)
    if array.ndim == 0:
        array = np.full(size, float(array))
    if array.shape != (size,) or not np.all(np.isfinite(array)):
        raise ModelError(f"{name} must be a finite number or shape ({size},), got {value!r}")
    parameter = Parameter(name, array, unit, positive, nonnegative=nonnegative)
    return parameter, parameter.symbol


def matrix_parameter(
    name: str, value: ArrayLike, size: int, unit: str, definite: bool = True
) -> tuple[Parameter, ca.SX]:
    """A parameter that is a diagonal, or column by column a matrix, and the matrix of symbols."""
    array = full_matrix(name, value, size)
    if not np.allclose(array, array.T, rtol=1e-12, atol=0):
        raise ModelError(f"{name} must be symmetric")
    smallest = float(np.linalg.eigvalsh(array)[0])
    if smallest <= 0 if definite else smallest < -1e-12 * np.abs(array).max():
        kind = "positive definite" if definite else "positive semidefinite"
        raise ModelError(f"{name} must be {kind}; its smallest eigenvalue is {smallest:.3g}")
    if np.ndim(value) < 2:
        parameter = Parameter(name, np.diag(array), unit, positive=definite)
        return parameter, ca.diag(parameter.symbol)
    parameter = Parameter(name, array.reshape(-1, order="F"), unit)
    return parameter, ca.reshape(parameter.symbol, size, size)
