"""A system and what is known of it, worked out by hand."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from drake_dae.dae import DaeSystem, Structure, find_structure

Array = np.ndarray


class Known(NamedTuple):
    """What (2), (13), (14), (16) and (28) are at a state."""

    constraint_matrix: Array  # A, (m, m)
    alpha: Array  # (m,)
    beta: Array  # (m, p)
    drift: Array  # a, (p,)
    control_matrix: Array  # B, (p, p)


@dataclass(frozen=True)
class Problem:
    """A system and what is known of it.

    Attributes:
        system: The system.
        constraint_degrees, output_degrees: r and mu.
        index: Of the DAE; 0 without constraints.
        zero_dynamics: dim xi (22).
        output_order: The outputs in the paper's order (15).
        known: x -> the closed forms.
        consistent: Random generator -> a state on N*, found without the library.
        reference: Per output start, slope and amplitude of a signal that can be followed.
        derivatives: x -> k and its derivatives, constraint-major, shape (sum r_i,).
        horizon: How long it can be followed, in s.
    """

    system: DaeSystem
    constraint_degrees: tuple[int, ...]
    output_degrees: tuple[int, ...]
    index: int
    zero_dynamics: int
    output_order: tuple[int, ...]
    known: Callable[[Array], Known]
    consistent: Callable[[np.random.Generator], Array]
    reference: Sequence[tuple[float, float, float]]
    derivatives: Callable[[Array], Array] = field(default=lambda x: np.zeros(0))
    horizon: float = 1.5

    @cached_property
    def structure(self) -> Structure:
        """Found once for all tests of a process."""
        return find_structure(self.system)

    @property
    def manifold_dimension(self) -> int:
        return self.system.num_states - sum(self.constraint_degrees)


def known(constraint_matrix, alpha, beta, drift, control_matrix) -> Known:
    """From numbers and nested lists."""
    return Known(
        np.atleast_2d(np.asarray(constraint_matrix, dtype=float)),
        np.atleast_1d(np.asarray(alpha, dtype=float)),
        np.atleast_2d(np.asarray(beta, dtype=float)),
        np.atleast_1d(np.asarray(drift, dtype=float)),
        np.atleast_2d(np.asarray(control_matrix, dtype=float)),
    )


def unconstrained(controls: int, drift, control_matrix) -> Known:
    return Known(
        np.zeros((0, 0)),
        np.zeros(0),
        np.zeros((0, controls)),
        np.atleast_1d(np.asarray(drift, dtype=float)),
        np.atleast_2d(np.asarray(control_matrix, dtype=float)),
    )
