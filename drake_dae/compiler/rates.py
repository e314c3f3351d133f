"""Where the columns of blocks stand among those of a diagram, and updates of one instant."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
from pydrake.systems.framework import System

from drake_dae.systems.blocks.traced import Block


class ColumnPlace(NamedTuple):
    """Where a column of a block stands among those of the diagram."""

    system: System
    part: slice


@dataclass(frozen=True, eq=False)
class UpdateRate:
    """Updates of discrete states at t_k = offset + k period.

    Attributes:
        period, offset: In s.
        is_unrestricted: As of an `Update`.
        function: (time, state, held, parameters, noise) -> new values of some held entries, and a
            number that is finite if they are of use.
        places: Which entries these are.
        stepped: The block that Drake steps then; the function gives what its input port reads.
    """

    period: float
    offset: float
    is_unrestricted: bool
    function: ca.Function
    places: tuple[int, ...]
    stepped: Block | None = None


def dense_function(name: str, given: Sequence[ca.SX], values: Sequence[ca.SX]) -> ca.Function:
    """Expressions as a function with dense outputs and without what is common twice."""
    dense = [ca.densify(value) for value in values]
    return ca.Function(name, list(given), ca.cse(dense), {"cse": False})
