"""Weighted least squares for the unknowns of records: Gauss-Newton with multiple shooting."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from drake_dae.arrays import FloatArray
from drake_dae.errors import ModelError
from drake_dae.studies.identification.chain import StateChain, qr_factor, separate_deviations
from drake_dae.studies.identification.pieces import PieceDerivatives, RecordPieces

COUPLINGS = (1e-1, 1e-3, 1e-6)
"""The successive deviations of the gaps between pieces, relative to the deviation of a state that
is estimated from its piece. The results do not change below 1e-5."""

FIRST_NOISE = 1e-3
"""The least noise, relative to the spread of a column, with all couplings except the last."""

SMALLEST = 1e-7
"""The least noise, relative to the spread of a column, with the last coupling."""

EXACT = 1e-9
"""The deviation of the constraint residuals of initial states."""

MOST = 25
"""The largest number of Gauss-Newton steps with one coupling."""

CLOSE, NEAR = 0.03, 0.3
"""Steps have converged if shorter than `CLOSE`, in deviations. After `MOST` steps, `NEAR` suffices,
since contact and friction are strongly nonlinear."""

EXPECTED = 1.5
"""After the last step no column has errors that are larger than expected by this factor."""

SHORTER = 0.5
"""Derivatives are reused while each step is shorter than the step before by this factor."""

WEAK = 1e3
"""The deviation of an unmeasured state, relative to its size."""

UNDETERMINED = 1.0
"""A direction of the unknowns with a larger deviation than this, relative to their sizes, is
undetermined, and keeps its initial value."""

MOST_OF_THE_WAY = 0.9
"""The longest step toward a strict bound, as a fraction of the distance to it."""

WORSE = 3.0
"""A step that makes errors larger by this factor was too long."""

HALVED = 6
"""How many times a step is halved that is too long or leads to values that are not finite."""

LONGEST = 1.0
"""The longest step of an unknown, relative to its size."""

TINY = 1e-15
"""The least distance to a bound that SciPy accepts, relative to the size."""


@dataclass(frozen=True, eq=False)
class FitResult:
    """The result of a fit.

    Attributes:
        values: The unknowns, shape (p,).
        information: [T^T T, T^T r] for each piece of all records, with the weighted errors r and
            their derivatives T by the unknowns, at the best fit, shape (j, p, p + 1).
        determined: Columns that span the determined directions of unknowns / sizes, shape (p, q).
        undetermined: Columns that span the other directions, shape (p, p - q).
        errors: Measured minus computed columns of each record, shape (k, c); nan where a value is
            not used.
        noise: The deviation of each column of each record, shape (c,).
        last_step: The length of the last step; each unknown moved by at most this many deviations.
        left_out: The number of steps between rows that are not used, and the number of all.
    """

    values: FloatArray
    information: FloatArray
    determined: FloatArray
    undetermined: FloatArray
    errors: Sequence[FloatArray]
    noise: Sequence[FloatArray]
    last_step: float
    left_out: tuple[int, int]


class ParameterFit:
    """Gauss-Newton iterations for the unknowns of some records.

    They minimize the sum of ((measured - computed) / noise)^2. The initial states of all pieces are
    unknowns, too. The gaps between pieces and the constraint residuals are further errors, with
    small deviations. The noise of a group of columns is the root mean square of its errors.

    Args:
        pieces: The records.
        start: The initial guess of the unknowns, shape (p,).
        sizes: The sizes of the unknowns, shape (p,).
        lowest: Their lower bounds, -inf for none, shape (p,).
        strict: Whether each unknown must stay above its bound, shape (p,).
        noise: A guess of the deviation of each column of each record, shape (c,).
    """

    def __init__(
        self,
        pieces: Sequence[RecordPieces],
        start: FloatArray,
        sizes: FloatArray,
        lowest: FloatArray,
        strict: np.ndarray,
        noise: Sequence[FloatArray] | None = None,
    ) -> None:
        self._pieces = [record.fine_enough(start) for record in pieces]
        self._values, self._sizes, self._lowest = start.copy(), sizes, lowest
        self._strict = strict
        self._states = [record.first_states.copy() for record in self._pieces]
        self._spread = [record.spread for record in self._pieces]
        self._floor = FIRST_NOISE
        guess = [FIRST_NOISE * spread for spread in self._spread] if noise is None else noise
        self._noise = [deviations.copy() for deviations in guess]
        self._parts = np.eye(start.size), np.zeros((start.size, 0))
        self._before, self._least_size = (self._values, list(self._states)), np.inf
        self._last = 0.0

    def run(self, couplings: Sequence[float] = COUPLINGS) -> FitResult:
        """Iterates until convergence.

        Derivatives take most of the time. They are computed again only at the end, and if steps
        with old ones do not become shorter.

        Args:
            couplings: The successive deviations of the gaps between pieces, see `COUPLINGS`.

        Raises:
            ModelError: The computed motion is far from the recorded one, or the steps do not
                converge.
        """
        known: list[PieceDerivatives] | None = None
        for coupling in couplings:
            is_last = coupling == COUPLINGS[-1]
            # Loosely coupled pieces fit the noise, too: their errors do not show it.
            self._floor = SMALLEST if is_last else FIRST_NOISE
            before, self._least_size = np.inf, np.inf
            for _ in range(MOST):
                slopes, chains = self._shortened(coupling, known)
                step, length = self._step(chains)
                if known is not None and length > max(SHORTER * before, CLOSE):
                    known = None
                    slopes, chains = self._chained(coupling, None)
                    step, length = self._step(chains)
                expected = self._move(step, slopes, chains)
                size = self._error_size([record.errors for record in slopes])
                # Tighter coupling makes errors larger, as expected.
                self._least_size = max(min(self._least_size, size), self._error_size(expected))
                is_new, self._last = known is None, length * max(1.0, np.sqrt(step.size))
                known = slopes if length < SHORTER * before else None
                before = length
                if length < CLOSE:
                    if not is_last:
                        break
                    if is_new:
                        final = self._chained(coupling, slopes)
                        if self._is_expected(final[0]):
                            return self._fitted(*final)
                    known = None
            else:
                if is_last and length > NEAR:
                    raise ModelError(
                        f"the steps toward the best values have not come to an end after {MOST}: "
                        "the record does not fit this robot (look for a wrong unit or sign), or "
                        "the initial guess is far off; free fewer parameters first"
                    )
        return self._fitted(*self._chained(couplings[-1], slopes))

    def _is_expected(self, slopes: Sequence[PieceDerivatives]) -> bool:
        """Whether the errors after a step are not much larger than the noise."""
        pairs = zip(slopes, self._noise, strict=True)
        sizes = [
            np.sqrt(np.nanmean(np.square(s.errors / noise), axis=(0, 1))) for s, noise in pairs
        ]
        return bool(np.nanmax(sizes) < EXPECTED)

    def at_start(self, noise: Sequence[FloatArray]) -> FitResult:
        """The Fisher information of the unknowns at the initial guess, without any step.

        Args:
            noise: The deviation of each column of each record, shape (c,).

        Raises:
            ModelError: The computed motion is far from the recorded one.
        """
        self._noise = list(noise)
        slopes, chains = self._chained(COUPLINGS[-1], None)
        self._split(chains)
        return self._fitted(slopes, chains)

    def _shortened(
        self, coupling: float, known: Sequence[PieceDerivatives] | None
    ) -> tuple[list[PieceDerivatives], list[StateChain]]:
        """`_chained` after the last step, which is halved as long as it was too long."""
        for _ in range(HALVED):
            with suppress(ModelError):
                slopes, chains = self._chained(coupling, known)
                size = self._error_size([record.errors for record in slopes])
                if size <= WORSE * self._least_size:
                    return slopes, chains
            values, states = self._before
            self._values = (values + self._values) / 2.0
            pairs = zip(states, self._states, strict=True)
            self._states = [(before + after) / 2.0 for before, after in pairs]
        return self._chained(coupling, known)

    def _error_size(self, errors: Sequence[FloatArray]) -> float:
        """The root mean square of all errors, relative to the spread of their columns."""
        pairs = zip(errors, self._spread, strict=True)
        return max(float(np.sqrt(np.nanmean(np.square(e / spread)))) for e, spread in pairs)

    def _chained(
        self, coupling: float, known: Sequence[PieceDerivatives] | None
    ) -> tuple[list[PieceDerivatives], list[StateChain]]:
        """The errors with derivatives, and the least squares of each record.

        Raises:
            ModelError: The computed motion is far from the recorded one.
        """
        slopes, chains = [], []
        for index, pieces in enumerate(self._pieces):
            old = None if known is None else known[index]
            computed = pieces.slopes(self._states[index], self._values, old)
            if not computed.is_finite:
                raise ModelError(
                    "the motion that is computed with these parameters leaves the recorded one: "
                    "a unit or a sign is wrong (rad, m, s, N m, N), the record is that of another "
                    "robot or run, or the initial guess is far off"
                )
            slopes.append(computed)
            chains.append(self._chain(index, computed, coupling))
        return slopes, chains

    def _chain(self, index: int, slopes: PieceDerivatives, coupling: float) -> StateChain:
        """The linearized least squares of a record at the present states."""
        scale, noise = self._pieces[index].driven.scale, self._noise[index]
        count = len(slopes.ends)
        width = slopes.of_ends.shape[2] + 1
        weighted = _weighted(slopes.of_errors, slopes.errors, noise)
        exact = np.concatenate([slopes.residuals[1], slopes.residuals[0][..., None]], axis=2)
        own = np.concatenate([weighted.reshape(count, -1, width), exact / EXACT], axis=1)
        defects = slopes.ends[:-1] - self._states[index][1:]
        moves = np.concatenate([slopes.of_ends[:-1], defects[..., None]], axis=2)
        # An event of a contact leaves the next state undetermined.
        is_joined = self._pieces[index].is_joined[:, None]
        loose = np.where(is_joined, coupling * separate_deviations(own, scale, WEAK), WEAK * scale)
        return StateChain.of(own, np.where(is_joined[..., None], moves, 0.0), loose, WEAK * scale)

    def _step(self, chains: Sequence[StateChain]) -> tuple[FloatArray, float]:
        """A step of the unknowns, and its length in their deviations."""
        scaled, rest = self._split(chains)
        step = self._over_sizes(scaled, rest)
        length = float(np.linalg.norm(scaled @ step))
        return self._sizes * step, length / max(1.0, np.sqrt(step.size))

    def _move(
        self, step: FloatArray, slopes: Sequence[PieceDerivatives], chains: Sequence[StateChain]
    ) -> list[FloatArray]:
        """Makes a step, and returns the errors that are expected after it."""
        self._before, expected = (self._values, list(self._states)), []
        for index, chain in enumerate(chains):
            states, _ = chain.states(step)
            self._states[index] = self._states[index] + states
            both = np.concatenate([states, np.broadcast_to(step, (len(states), step.size))], 1)
            own = slopes[index]
            expected.append(own.errors + np.einsum("jkci,ji->jkc", own.of_errors, both))
            self._set_noise(index, expected[-1])
        self._values = np.maximum(self._values + step, self._lowest)
        return expected

    def _over_sizes(self, scaled: FloatArray, rest: FloatArray) -> FloatArray:
        """The step of unknowns / sizes, in determined directions and above bounds.

        Args:
            scaled, rest: The results of `_split`.
        """
        determined, undetermined = self._parts
        step: FloatArray = determined @ np.linalg.lstsq(scaled @ determined, -rest, rcond=None)[0]
        reach = np.where(self._strict, MOST_OF_THE_WAY, 1.0)
        least = reach * (self._lowest - self._values) / self._sizes
        step *= min(1.0, LONGEST / max(float(np.abs(step).max()), LONGEST))
        if (step >= least).all():
            return step
        rows = np.vstack([scaled, undetermined.T / UNDETERMINED])
        right = np.concatenate([-rest, np.zeros(undetermined.shape[1])])
        bounded = lsq_linear(rows, right, (np.minimum(least, -TINY), np.inf), method="bvls")
        return np.clip(bounded.x, least, LONGEST)

    def _split(self, chains: Sequence[StateChain]) -> tuple[FloatArray, FloatArray]:
        """Finds the determined directions; returns the QR factor of unknowns / sizes, and rest."""
        common = qr_factor(np.vstack([chain.common for chain in chains]))
        p = self._values.size
        scaled, rest = common[:p, :p] * self._sizes, common[:p, p]
        _, strengths, rows = np.linalg.svd(scaled)
        is_known = strengths > 1.0 / UNDETERMINED
        self._parts = rows[is_known].T, rows[~is_known].T
        return scaled, rest

    def _set_noise(self, index: int, errors: FloatArray) -> None:
        """Sets the noise of each group of columns to the root mean square of its errors."""
        spread = self._spread[index]
        for group in self._pieces[index].data.groups:
            deviation = float(np.sqrt(np.nanmean(np.square(errors[:, :, group]))))
            least = self._floor * float(np.max(spread[group]))
            self._noise[index][group] = np.maximum(deviation, least)

    def _fitted(
        self, slopes: Sequence[PieceDerivatives], chains: Sequence[StateChain]
    ) -> FitResult:
        p, information, errors = self._values.size, [], []
        for index, chain in enumerate(chains):
            own, of_states = slopes[index], chain.states(np.zeros(p))[1]
            n = of_states.shape[1]
            total = np.einsum("jkcn,jnp->jkcp", own.of_errors[..., :n], of_states)
            total += own.of_errors[..., n:]
            weighted = _weighted(total, own.errors, self._noise[index])
            flat = weighted.reshape(len(weighted), -1, p + 1)
            information.append(np.matmul(flat[..., :p].transpose(0, 2, 1), flat))
            pieces = self._pieces[index]
            left = np.full(pieces.data.values.shape, np.nan)
            left[pieces.rows[:, :-1][pieces.is_own]] = own.errors[pieces.is_own]
            errors.append(left)
        cuts = [pieces.data.cut for pieces in self._pieces]
        return FitResult(
            self._values,
            np.concatenate(information),
            *self._parts,
            errors,
            self._noise,
            self._last,
            (sum(int(cut.sum()) for cut in cuts), sum(cut.size for cut in cuts)),
        )


def _weighted(slopes: FloatArray, errors: FloatArray, noise: FloatArray) -> FloatArray:
    """[slopes, errors] over the noise, and 0 where nothing is measured, (j, k, c, i + 1)."""
    both = np.concatenate([slopes, errors[..., None]], axis=3)
    return np.where(np.isnan(errors)[..., None], 0.0, both) / noise[:, None]
