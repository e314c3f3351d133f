"""Feedback gains, the error dynamics that they assign, and their exact response.   (30)-(34)"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, brief, numbers, show, vector
from drake_dae.dae.signals import DerivativeLayout
from drake_dae.errors import GainError
from drake_dae.trace.expressions import result_of


@checked(GainError)
@dataclass(frozen=True, eq=False)
class FeedbackGains:
    """The feedback gains of the law (28), which determine the error dynamics (30)."""

    names: tuple[str, ...]
    degrees: tuple[int, ...]
    matrix: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "degrees", tuple(int(degree) for degree in self.degrees))
        matrix = numbers("gains", self.matrix, GainError)
        shape = (len(self.names), sum(self.degrees))
        if matrix.shape != shape or len(self.names) != len(self.degrees):
            raise GainError(f"gains must have shape (p, sum mu_i) = {shape}, got {matrix.shape}")
        if not np.all(np.isfinite(matrix)):
            raise GainError(f"gains must be finite, got {matrix}")
        for name, degree, row in zip(self.names, self.degrees, matrix, strict=True):
            if degree == 0 and row.any():
                raise GainError(
                    f"output '{name}' has degree 0 and takes no gain: the law attains it without "
                    "delay"
                )
        matrix.setflags(write=False)
        object.__setattr__(self, "matrix", matrix)
        if np.any(self.poles.real >= 0.0):
            raise GainError(
                "the error dynamics (30) are not Hurwitz: poles "
                f"{show(self.poles)}; all real parts must be negative"
            )

    @property
    def layout(self) -> DerivativeLayout:
        """The layout of the error coordinates."""
        return DerivativeLayout(self.degrees)

    @property
    def error_matrix(self) -> FloatArray:
        """E of e' = E e, shape (N, N)."""
        layout = self.layout
        result = np.eye(layout.chain_size, k=1)
        result[layout.ends] = -self.matrix[layout.dynamic]  # (30)
        return result

    @property
    def poles(self) -> np.typing.NDArray[np.complex128]:
        """The poles of the errors, the eigenvalues of E, in 1/s, shape (N,)."""
        return np.linalg.eigvals(self.error_matrix).astype(complex)

    @checked(GainError)
    def error_response(self, times: ArrayLike, initial: ArrayLike) -> FloatArray:
        """Returns the exact tracking error exp(E t) e(0) of (30), (31), shape (k, p)."""
        moments = vector("times", np.atleast_1d(times), None, GainError)
        coordinates = vector("initial", initial, self.layout.chain_size, GainError)
        result = np.zeros((moments.size, len(self.degrees)))
        if not coordinates.size:
            return result
        # From one time to the next: a log with fixed steps has few different step lengths once its
        # times are rounded to a power of 2, whose differences floating-point numbers compute
        # exactly.
        grid = np.exp2(np.floor(np.log2(np.max(np.abs(moments), initial=1e-300))) - 50.0)
        order = np.argsort(moments)
        steps = np.diff(np.round(moments[order] / grid) * grid, prepend=0.0)
        lengths, which = np.unique(steps, return_inverse=True)
        # In units, powers of 2, in which the entries of E, and so of exp(E t), have similar sizes.
        balanced, (units, _) = scipy.linalg.matrix_balance(
            self.error_matrix, permute=False, separate=True
        )
        transitions = scipy.linalg.expm(lengths[:, None, None] * balanced)  # (31), (34)
        rows, current = np.zeros((moments.size, len(units))), coordinates / units
        for row, index in zip(order, which, strict=True):
            current = transitions[index] @ current
            rows[row] = current
        result[:, self.layout.dynamic] = (rows * units)[:, self.layout.heads]
        return result


# A function that makes gains for outputs of given names and degrees.
GainDesign = Callable[[Sequence[str], Sequence[int]], FeedbackGains]
Poles = float | complex | Sequence[float | complex]


@checked(GainError)
def poles(values: Poles | Mapping[str, Poles]) -> GainDesign:
    """Designs gains K_ij that assign poles to each output: the coefficients of (32).

    Args:
        values: One pole in 1/s for all, or a sequence of mu_i poles for every output, or these per
            output name, "*" for all others. Complex poles come in conjugate pairs.
    """
    return _row_by_row(values, _polynomial)


@checked(GainError)
def gain_coefficients(
    values: Sequence[float] | Mapping[str, float | Sequence[float]],
) -> GainDesign:
    """Designs the gains K_i1, ..., K_i mu_i of (32) from numbers, lowest derivative first."""
    return _row_by_row(values, _coefficients)


def gain_matrices(*groups: Sequence[ArrayLike]) -> GainDesign:
    """Designs gains from full matrices: Lambda_1, Lambda_2 of (60), Lambda_1, ... of (72)-(73)."""
    blocks = [
        [numbers(f"gain_matrices: groups[{k}]", block, GainError) for block in group]
        for k, group in enumerate(groups)
    ]

    def design(names: Sequence[str], degrees: Sequence[int]) -> FeedbackGains:
        occurring = sorted({degree for degree in degrees if degree}, reverse=True)
        if [len(group) for group in blocks] != occurring:
            raise GainError(
                f"the outputs have the degrees {occurring}. Give a group of gain matrices for each "
                f"degree, as many as it says; got {[len(group) for group in blocks]}"
            )
        matrix, starts = np.zeros((len(names), sum(degrees))), DerivativeLayout(degrees).starts
        for degree, group in zip(occurring, blocks, strict=True):
            members = [i for i, d in enumerate(degrees) if d == degree]
            for order, block in enumerate(map(np.atleast_2d, group)):
                if block.shape != (len(members), len(members)):
                    raise GainError(
                        f"a gain matrix has shape {block.shape}, but "
                        f"{', '.join(names[i] for i in members)} need {(len(members),) * 2}"
                    )
                # (60), (72)-(73), (82)-(83)
                matrix[np.ix_(np.array(members), starts[members] + order)] = block
        return FeedbackGains(tuple(names), tuple(degrees), matrix)

    return design


def designed(
    what: str, design: GainDesign | FeedbackGains, names: tuple[str, ...], degrees: tuple[int, ...]
) -> FeedbackGains:
    """Returns finished gains, or designs them; raises GainError if they are for other signals."""
    gains = design
    if not isinstance(gains, FeedbackGains):
        gains = result_of(what, gains, names, degrees, error=GainError)
    if not isinstance(gains, FeedbackGains):
        raise GainError(f"{what} must be a design such as poles(-4.0), got {brief(gains)}")
    if (gains.names, gains.degrees) != (names, degrees):
        raise GainError(
            f"{what} must be for {', '.join(names) or 'none'} with {degrees} poles, and is for "
            f"{', '.join(gains.names)} with {gains.degrees}"
        )
    return gains


def _row_by_row(
    values: Any, row_of: Callable[[str, int, Any], Sequence[float] | FloatArray]
) -> GainDesign:
    """Designs a row of K for each output with a degree above 0, by a value for all or for each."""

    def design(names: Sequence[str], degrees: Sequence[int]) -> FeedbackGains:
        matrix, owners = np.zeros((len(names), sum(degrees))), DerivativeLayout(degrees).owners
        needed = {name: degree for name, degree in zip(names, degrees, strict=True) if degree}
        chosen = values if isinstance(values, Mapping) else {"*": values}
        wrong = [name for name in chosen if name not in (*needed, "*")]
        missing = [name for name in needed if name not in chosen and "*" not in chosen]
        if wrong or missing:
            raise GainError(
                f"gains are needed for the outputs {', '.join(needed)}, of degree 1 or more; not "
                f"given: {', '.join(missing) or 'none'}; others: {', '.join(wrong) or 'none'}"
            )
        for i, name in enumerate(names):
            if name in needed:
                value = chosen[name if name in chosen else "*"]
                matrix[i, owners == i] = row_of(name, needed[name], value)
        return FeedbackGains(tuple(names), tuple(degrees), matrix)

    return design


def _polynomial(name: str, degree: int, chosen: Poles) -> FloatArray:
    """K_i1, ..., K_i mu_i of the polynomial (32) with the chosen roots."""
    roots = np.atleast_1d(np.asarray(chosen, dtype=complex))
    if roots.size == 1:
        roots = np.repeat(roots, degree)
    if roots.shape != (degree,):
        raise GainError(
            f"output '{name}' has degree {degree} and takes 1 or {degree} poles, got {roots.size}"
        )
    monic = np.poly(roots)  # (32)
    if np.abs(np.imag(monic)).max() > 1e-12 * np.abs(monic).max():
        raise GainError(f"complex poles of output '{name}' must come in conjugate pairs: {roots}")
    return np.real(monic)[:0:-1]


def _coefficients(name: str, degree: int, chosen: float | Sequence[float]) -> FloatArray:
    """K_i1, ..., K_i mu_i as they are given."""
    entries = np.atleast_1d(numbers(f"coefficients of output '{name}'", chosen, GainError))
    if entries.shape != (degree,):
        raise GainError(
            f"output '{name}' has degree {degree} and takes {degree} coefficients "
            f"K_i1, ..., K_i{degree}, got {entries.size}"
        )
    return entries
