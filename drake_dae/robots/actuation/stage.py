"""What stands between the control and the joints: a chain of stages toward the motor.

No stage is rigid joints (37), where the control is the joint torque. A stage delivers a force to
its load, the joints or the shaft of the stage before it, and is driven by the stage after it or by
the control. All positions, velocities and forces are on the joints' side of the gears.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arrays import FloatArray
from drake_dae.dae.signals import Parameter, Signal
from drake_dae.errors import ModelError
from drake_dae.robots.links.links import Links


@dataclass(frozen=True, eq=False)
class AttachedStage:
    """A stage at the p actuators of one robot: E s' = drift(load) + drive_matrix * drive.

    Attributes:
        state: s, symbols, shape (k, 1).
        state_signals: Names and units of s.
        mass: E, shape (k, k), symmetric positive definite.
        drift: Of the load's position and velocity, each of shape (p, 1); returns shape (k, 1).
        drive_matrix: Shape (k, p).
        drive_signals: Names and units of the drive, shape (p,).
        force: What the load gets, of its position and velocity; returns shape (p, 1).
        shaft: Position and velocity of what a next stage drives; None if nothing can drive it.
        carries_rotors: Whether the rotors that the URDF declares turn with it, not with the links.
        ports: Output port name -> which entries of s it shows.
        parameters: Of these expressions.
    """

    state: ca.SX
    state_signals: tuple[Signal, ...]
    mass: ca.SX
    drift: Callable[[ca.SX, ca.SX], ca.SX]
    drive_matrix: ca.SX
    drive_signals: tuple[Signal, ...]
    force: Callable[[ca.SX, ca.SX], ca.SX]
    shaft: tuple[ca.SX, ca.SX] | None
    carries_rotors: bool
    ports: dict[str, slice]
    parameters: tuple[Parameter, ...]


class Stage(Protocol):
    """One kind of actuation; `attach` gives its equations for a robot."""

    def attach(self, links: Links) -> AttachedStage:
        """The equations at the actuators of these links.

        Raises:
            ModelError: A value that does not fit.
        """


def numbers_of(name: str, value: ArrayLike) -> FloatArray:
    """The numbers of a stage as an array.

    Raises:
        ModelError: The value holds something else.
    """
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise ModelError(f"{name} must be numbers, got {value!r}") from None


def full_matrix(name: str, value: ArrayLike, size: int) -> FloatArray:
    """A number, a diagonal or a matrix as a matrix."""
    array = numbers_of(name, value)
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
    name: str, value: ArrayLike, size: int, unit: str, positive: bool = False
) -> tuple[Parameter, ca.SX]:
    """A parameter of one number per actuator, and its symbol."""
    array = numbers_of(name, value)
    if array.ndim == 0:
        array = np.full(size, float(array))
    if array.shape != (size,) or not np.all(np.isfinite(array)):
        raise ModelError(f"{name} must be a finite number or shape ({size},), got {value!r}")
    parameter = Parameter(name, array, unit, positive)
    return parameter, parameter.symbol


def matrix_parameter(
    name: str, value: ArrayLike, size: int, unit: str, definite: bool = True
) -> tuple[Parameter, ca.SX]:
    """A parameter that is a diagonal, or column by column a matrix, and the matrix of symbols.

    It is symmetric, and positive definite or at least semidefinite.
    """
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
