"""Stability of the zero dynamics at an equilibrium, by linearization.            (35)-(36)"""

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
import scipy.linalg

from drake_dae.arrays import FloatArray, show
from drake_dae.dae.manifold import coordinates
from drake_dae.dae.structure import Structure
from drake_dae.dae.zero_dynamics.pinned_outputs import PinnedSet

LINEARIZED = 1e-11
"""The error of a linearization, relative to the terms in each of its entries."""

ROUNDED = 1e-15
"""The error of computed eigenvalues, relative to the norm of the matrix."""

SHIFT = 1e-7
"""The error of an equilibrium, relative to the size of the states."""

ComplexArray = np.typing.NDArray[np.complex128]


class Verdict(StrEnum):
    """The verdicts on the zero dynamics."""

    STABLE = "exponentially stable"
    UNSTABLE = "unstable"
    UNDECIDED = "not decided"


@dataclass(frozen=True, eq=False)
class Stability:
    """The stability of the internal states about an equilibrium, with constant outputs.

    The verdict is local: for states near this equilibrium and outputs near its outputs. The global
    sufficient conditions (i) and (ii) below (36) are not examined.
    """

    verdict: Verdict
    reason: str
    eigenvalues: ComplexArray = field(default_factory=lambda: np.zeros(0, dtype=complex))
    state: FloatArray | None = None


def linearized_eigenvalues(
    pinned: PinnedSet, scale: FloatArray, state: FloatArray
) -> tuple[ComplexArray, FloatArray]:
    """Returns the eigenvalues of d(f* + h* u)/dx on the tangent space of Z(R), with errors.

    They come from round-off in the derivative, and from the error of the equilibrium, which is
    large if Newton's method converges slowly. Both in 1/s, largest real part first.
    """
    slopes = pinned.slopes(state)
    free, moved = coordinates(pinned.gradients(state), scale)
    # The tangent directions are known to round-off, relative to the scale of the states.
    least = np.where(moved == 0.0, 0.0, ROUNDED / LINEARIZED * scale[:, None] / scale[free])
    sizes = pinned.sizes_of_slopes(state)
    off = LINEARIZED * (sizes @ np.maximum(np.abs(moved), least))[free]
    # The numbers of a model are rounded as well, such as the cosine of a right angle.
    units = scale[free][:, None] / scale[free]
    matrix = (slopes @ moved)[free] / units
    off = off / units + ROUNDED * np.linalg.norm(matrix, 2)
    rounded = ROUNDED * float(np.linalg.norm(balanced_matrix(sizes * scale / scale[:, None])[0], 2))
    values, errors = eigenvalues_of(matrix, off, rounded)
    along = moved @ (scale[free] * np.random.default_rng(0).standard_normal(free.size))
    along /= np.max(np.abs(along) / scale, initial=0.0) or 1.0
    beside = pinned.slopes(state + SHIFT * along)
    if np.all(np.isfinite(beside)):
        shifted = (beside @ moved)[free] / units
        others, _ = eigenvalues_of(shifted, 0.0 * off)
        errors += np.min(np.abs(values[:, None] - others), axis=1, initial=np.inf)
        if stays_off_the_axis(matrix, off + np.abs(shifted - matrix), rounded):
            errors = np.minimum(errors, 0.5 * np.abs(values.real))
    return values, errors


def stays_off_the_axis(matrix: FloatArray, error: FloatArray, rounded: float) -> bool:
    """Returns whether no eigenvalue can be on the imaginary axis, within the matrix's error.

    Eigenvalues of a defective matrix have errors of the root of its error, even if all are far from
    the axis. A perturbation that moves one to i w is at least the smallest singular value of A - i
    w; this equals e for some w only if i w is an eigenvalue of [[A, -e], [e, -A^T]] (Byers 1988).
    """
    balanced, units = balanced_matrix(matrix)
    norm = float(np.linalg.norm(balanced, 2))
    off = float(np.linalg.norm(error / units[:, None] * units, 2)) + rounded + ROUNDED * norm
    if not (np.isfinite(off) and norm > 0.0):
        return False
    away = off * np.eye(len(matrix))
    values = np.linalg.eigvals(np.block([[balanced, -away], [away, -balanced.T]]))
    # Its eigenvalues have an error of the root of round-off where they meet on the axis.
    return bool(np.min(np.abs(values.real)) > np.sqrt(ROUNDED) * norm)


def balanced_matrix(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Returns a matrix whose norm does not depend on units, and these units of its rows."""
    with np.errstate(invalid="ignore"):  # SciPy casts factors of 1e50 to numbers of rows.
        balanced, similarity = scipy.linalg.matrix_balance(matrix, permute=False)
    return balanced, np.diag(similarity)


def eigenvalues_of(
    matrix: FloatArray, error: FloatArray, rounded: float = 0.0
) -> tuple[ComplexArray, FloatArray]:
    """Returns eigenvalues, largest real part first, and their error bounds.

    To first order an error E of the matrix moves an eigenvalue by at most |y|^H |E| |x| / |y^H x|,
    with its left and right eigenvectors y and x. So in a triangular matrix a small eigenvalue is as
    accurate as its own entry. Balancing removes the units first.
    `error` bounds the entries of the matrix, `rounded` those of the balanced one.
    """
    if not matrix.size:
        return np.zeros(0, dtype=complex), np.zeros(0)
    balanced, units = balanced_matrix(matrix)
    values, left, right = scipy.linalg.eig(balanced, left=True, right=True)
    off = error / units[:, None] * units + rounded + ROUNDED * np.linalg.norm(balanced, 2)
    moved = np.einsum("ik,ij,jk->k", np.abs(left), off, np.abs(right))
    errors = moved / np.maximum(np.abs(np.sum(left.conj() * right, axis=0)), 1e-300)
    order = np.lexsort((values.imag, -values.real))
    return values[order], errors[order]


def judge(
    values: ComplexArray, errors: FloatArray, state: FloatArray, place: str, degenerate: int = 0
) -> Stability:
    """Judges a state at rest by its eigenvalues.

    In `degenerate` directions its Jacobian is singular: as many eigenvalues are known to nothing.
    """
    smallest = np.argsort(np.abs(values))[:degenerate]
    errors = errors.copy()
    errors[smallest] = np.maximum(errors[smallest], 2.0 * np.abs(values[smallest]))
    largest = f"the largest real part of an eigenvalue is {values[0].real:.4g} 1/s {place}"
    if np.any(values.real > errors):
        return Stability(Verdict.UNSTABLE, f"non-minimum phase: {largest}", values, state)
    if np.all(values.real < -errors):
        return Stability(Verdict.STABLE, f"minimum phase: {largest}", values, state)
    count = np.count_nonzero(np.abs(values.real) <= errors)
    reason = (
        f"the linearization does not decide: {count} of {values.size} eigenvalues are on the "
        f"imaginary axis, up to round-off, {place}"
    )
    if degenerate:
        reason += ", where the Jacobian is singular"
    return Stability(Verdict.UNDECIDED, reason, values, state)


def without_dynamics(structure: Structure) -> Stability:
    """Judges a system without zero dynamics: whether R determines the motion."""
    margins = {
        "A(x) of Assumption (2)": structure.constraint_margin,
        "B(x) of (16)": structure.control_margin,
    }
    for matrix, margin in margins.items():
        if margin is not None and margin.is_singular:
            reason = (
                "no zero dynamics, but the reference does not determine the motion: "
                f"{matrix} is singular at x = {show(margin.state)}"
            )
            return Stability(Verdict.UNDECIDED, reason)
    return Stability(Verdict.STABLE, "no zero dynamics: the reference alone determines the motion")
