"""The numbers of a stage: one for all actuators, one for each, or a matrix."""

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arrays import FloatArray, numbers
from drake_dae.dae import Parameter
from drake_dae.errors import ModelError


def full_matrix(name: str, value: ArrayLike, size: int) -> FloatArray:
    """A number, a diagonal or a matrix, as a matrix of shape (size, size).

    Raises:
        ModelError: The value is something else, or not finite.
    """
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
    name: str, value: ArrayLike, size: int, unit: str, positive: bool = False
) -> tuple[Parameter, ca.SX]:
    """A parameter of one number per actuator, and its symbol, shape (size, 1).

    Raises:
        ModelError: The value is not one finite number, or one for each actuator.
    """
    array = numbers(name, value)
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

    Raises:
        ModelError: The matrix is not symmetric, or not positive definite (semidefinite).
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
