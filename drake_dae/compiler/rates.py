"""The updates of a diagram, and the slices of its columns that belong to each block."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
from pydrake.systems.framework import System

from drake_dae.blocks.computations import Computations


class ColumnPlace(NamedTuple):
    """The slice of a diagram's column, such as its state, that belongs to one block."""

    system: System
    part: slice


@dataclass(frozen=True, eq=False)
class UpdateRate:
    """Updates of discrete states at t_k = offset + k period.

    Attributes:
        period, offset: In s.
        is_unrestricted: Whether these are unrestricted updates, which Drake makes before the
            discrete ones.
        function: (time, state, held, parameters, noise) -> the new values of the entries `places`
            of the discrete state, and a number that is finite if these values are valid. With
            `stepped`, the first result is the input of the block that Drake steps.
        places: The entries of the discrete state that change.
        stepped: The block that Drake steps at these times, if any.
    """

    period: float
    offset: float
    is_unrestricted: bool
    function: ca.Function
    places: tuple[int, ...]
    stepped: Computations | None = None


def appended(column: ca.SX, values: ca.SX) -> tuple[ca.SX, slice]:
    """A column with values appended, and the slice of these values."""
    first = column.numel()
    return ca.vertcat(column, values), slice(first, first + values.numel())


def dense_function(name: str, arguments: Sequence[ca.SX], values: Sequence[ca.SX]) -> ca.Function:
    """A function with dense outputs that computes common subexpressions once."""
    dense = [ca.densify(value) for value in values]
    shared = ca.cse(dense) if dense else []  # Of an empty list CasADi makes a number.
    return ca.Function(name, list(arguments), shared, {"cse": False})
