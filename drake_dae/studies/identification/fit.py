"""The values of unknowns that explain records best: Gauss-Newton on pieces in a chain."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from drake_dae.arrays import FloatArray
from drake_dae.errors import ModelError
from drake_dae.studies.identification.chain import StateChain, alone, triangle
from drake_dae.studies.identification.pieces import PieceDerivatives, RecordPieces

COUPLINGS = (1e-1, 1e-3, 1e-6)
"""How tightly pieces are joined, one after the other, in deviations of what a piece says of its
states. From 1e-5 on the results do not change any more."""

FIRST_NOISE = 1e-3
"""The least noise, relative to how much a column varies, while pieces are joined loosely."""

SMALLEST = 1e-7
"""The least noise in the end."""

EXACT = 1e-9
"""The deviation of constraints at the beginnings of pieces."""

MOST = 25
"""So many steps of Gauss-Newton are made with one coupling at most."""

CLOSE, NEAR = 0.03, 0.3
"""A step is the last one with a coupling if it is shorter than the first part of the deviations;
of `MOST` steps the last one may have the second, since contact and friction bend sharply."""

EXPECTED = 1.5
"""After the last step no column has errors that are larger than expected by this factor."""

SHORTER = 0.5
"""With derivatives of before, a step must be shorter than the last one by this factor."""

WEAK = 1e3
"""The deviation of a state that nothing is known about, in its size."""

UNDETERMINED = 1.0
"""A direction of the unknowns with a larger deviation than this, relative to their sizes, is not
determined, and is left where it began."""

MOST_OF_THE_WAY = 0.9
"""So much of the distance to its bound is the longest step of what must stay above it."""

WORSE = 3.0
"""Errors that a step makes larger by this factor show that it was too long."""

HALVED = 6
"""A step that is too long, or leads to where the motion has no value, is halved so often."""

LONGEST = 1.0
"""The longest step of an unknown, in its size."""

TINY = 1e-15
"""The least distance to a bound that SciPy can work with, in sizes."""


@dataclass(frozen=True, eq=False)
class FitResult:
    """The result of a fit.

    Attributes:
        values: The unknowns, shape (p,).
        information: For each piece of all records T^T T and T^T r, with the derivatives T of the
            weighted errors r along the motions that fit best, shape (j, p, p + 1).
        determined: Directions of the unknowns over their sizes that the data determine, in
            columns, shape (p, q).
        undetermined: Those that the data do not determine, shape (p, p - q).
        errors: Measured minus computed columns of each record, shape (k, c); nan where none is
            used.
        noise: The deviation of each column of each record, shape (c,).
        last_step: The length of the last step: no unknown moved by more of its deviations.
        left_out: How many steps between rows are not used, of how many.
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
    """Gauss-Newton for the unknowns of some records.

    The squares of measured minus computed columns over their noise are minimized, with the states
    at the beginning of each piece as unknowns beside the common ones; what joins the pieces and
    what constraints say are further errors, with small deviations. The noise of each group of
    columns is that of its errors.

    Args:
        pieces: The records.
        start: The values at which the unknowns begin, shape (p,).
        sizes: Their sizes, shape (p,).
        lowest: Their lower bounds, -inf for none, shape (p,).
        strict: Which must stay above these, shape (p,).
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
        self._pieces = [each.fine_enough(start) for each in pieces]
        self._values, self._sizes, self._lowest = start.copy(), sizes, lowest
        self._strict = strict
        self._states = [each.first_states.copy() for each in self._pieces]
        self._spread = [each.spread for each in self._pieces]
        self._floor = FIRST_NOISE
        guess = [FIRST_NOISE * spread for spread in self._spread] if noise is None else noise
        self._noise = [each.copy() for each in guess]
        self._parts = np.eye(start.size), np.zeros((start.size, 0))
        self._before, self._least_left = (self._values, list(self._states)), np.inf
        self._last = 0.0

    def run(self, couplings: Sequence[float] = COUPLINGS) -> FitResult:
        """Fits.

        Derivatives are computed anew only where steps with old ones do not become shorter, and at
        the end: they take most of the time.

        Args:
            couplings: How tightly pieces are joined, one after the other.

        Raises:
            ModelError: The computed motion leaves the recorded one, or the steps do not come to an
                end.
        """
        known: list[PieceDerivatives] | None = None
        for coupling in couplings:
            is_last = coupling == COUPLINGS[-1]
            # Loose pieces follow noise, so that what is left says nothing of it.
            self._floor = SMALLEST if is_last else FIRST_NOISE
            before, self._least_left = np.inf, np.inf
            for _ in range(MOST):
                slopes, chains = self._shortened(coupling, known)
                step, length = self._step(chains)
                if known is not None and length > max(SHORTER * before, CLOSE):
                    known = None
                    slopes, chains = self._chained(coupling, None)
                    step, length = self._step(chains)
                expected = self._move(step, slopes, chains)
                left = self._left([each.errors for each in slopes])
                # Tighter pieces leave more, as it is expected.
                self._least_left = max(min(self._least_left, left), self._left(expected))
                is_new, self._last = known is None, length * max(1.0, np.sqrt(step.size))
                known = slopes if length < SHORTER * before else None
                before = length
                if length < CLOSE:
                    if not is_last:
                        break
                    if is_new:
                        found = self._chained(coupling, slopes)
                        if self._is_expected(found[0]):
                            return self._fitted(*found)
                    known = None
            else:
                if is_last and length > NEAR:
                    raise ModelError(
                        f"the steps toward the best values have not come to an end after {MOST}: "
                        "the record does not fit this robot (look for a wrong unit or sign), or "
                        "the values to begin with are far off; free fewer parameters first"
                    )
        return self._fitted(*self._chained(couplings[-1], slopes))

    def _is_expected(self, slopes: Sequence[PieceDerivatives]) -> bool:
        """Whether a step has left the errors that were expected, also in the states alone."""
        pairs = zip(slopes, self._noise, strict=True)
        sizes = [
            np.sqrt(np.nanmean(np.square(s.errors / noise), axis=(0, 1))) for s, noise in pairs
        ]
        return bool(np.nanmax(sizes) < EXPECTED)

    def known(self, noise: Sequence[FloatArray]) -> FitResult:
        """The information about the unknowns at the values and states to begin with.

        Args:
            noise: The deviation of each column of each record, shape (c,).

        Raises:
            ModelError: The computed motion leaves the recorded one.
        """
        self._noise = list(noise)
        slopes, chains = self._chained(COUPLINGS[-1], None)
        self._split(chains)
        return self._fitted(slopes, chains)

    def _shortened(
        self, coupling: float, known: Sequence[PieceDerivatives] | None
    ) -> tuple[list[PieceDerivatives], list[StateChain]]:
        """`_chained` after the last step, or after a shorter one if it leads too far.

        Raises:
            ModelError: The computed motion leaves the recorded one.
        """
        for _ in range(HALVED):
            with suppress(ModelError):
                found = self._chained(coupling, known)
                if self._left([each.errors for each in found[0]]) <= WORSE * self._least_left:
                    return found
            values, states = self._before
            self._values = (values + self._values) / 2.0
            pairs = zip(states, self._states, strict=True)
            self._states = [(one + other) / 2.0 for one, other in pairs]
        return self._chained(coupling, known)

    def _left(self, errors: Sequence[FloatArray]) -> float:
        """The size of all errors, relative to how much their columns vary."""
        pairs = zip(errors, self._spread, strict=True)
        return max(float(np.sqrt(np.nanmean(np.square(e / spread)))) for e, spread in pairs)

    def _chained(
        self, coupling: float, known: Sequence[PieceDerivatives] | None
    ) -> tuple[list[PieceDerivatives], list[StateChain]]:
        slopes, chains = [], []
        for index, pieces in enumerate(self._pieces):
            old = None if known is None else known[index]
            found = pieces.slopes(self._states[index], self._values, old)
            if not found.is_finite:
                raise ModelError(
                    "the motion that is computed with these parameters leaves the recorded one: "
                    "a unit or a sign is wrong (rad, m, s, N m, N), the record is that of another "
                    "robot or run, or the values to begin with are far off"
                )
            slopes.append(found)
            chains.append(self._chain(index, found, coupling))
        return slopes, chains

    def _chain(self, index: int, slopes: PieceDerivatives, coupling: float) -> StateChain:
        """The least squares of a record around the present states."""
        scale, noise = self._pieces[index].driven.scale, self._noise[index]
        count = len(slopes.ends)
        width = slopes.of_ends.shape[2] + 1
        found = np.concatenate([slopes.of_errors, slopes.errors[..., None]], axis=3)
        found = np.where(np.isnan(slopes.errors)[..., None], 0.0, found) / noise[:, None]
        exact = np.concatenate([slopes.residuals[1], slopes.residuals[0][..., None]], axis=2)
        own = np.concatenate([found.reshape(count, -1, width), exact / EXACT], axis=1)
        defects = slopes.ends[:-1] - self._states[index][1:]
        moves = np.concatenate([slopes.of_ends[:-1], defects[..., None]], axis=2)
        # Across an event of a contact nothing is known of the next state.
        is_joined = self._pieces[index].is_joined[:, None]
        loose = np.where(is_joined, coupling * alone(own, scale, WEAK), WEAK * scale)
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
        """Makes a step; returns the errors that are expected after it."""
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
        """The step of the unknowns over their sizes, along what is determined and above bounds.

        Args:
            scaled, rest: As `_split` returns them.
        """
        known, unknown = self._parts
        found: FloatArray = known @ np.linalg.lstsq(scaled @ known, -rest, rcond=None)[0]
        # What must stay positive comes closer to zero by nine tenths at most.
        reach = np.where(self._strict, MOST_OF_THE_WAY, 1.0)
        least = reach * (self._lowest - self._values) / self._sizes
        found *= min(1.0, LONGEST / max(float(np.abs(found).max()), LONGEST))
        if (found >= least).all():
            return found
        rows = np.vstack([scaled, unknown.T / UNDETERMINED])
        right = np.concatenate([-rest, np.zeros(unknown.shape[1])])
        bounded = lsq_linear(rows, right, (np.minimum(least, -TINY), np.inf), method="bvls")
        return np.clip(bounded.x, least, LONGEST)

    def _split(self, chains: Sequence[StateChain]) -> tuple[FloatArray, FloatArray]:
        """Finds what is determined; returns the factor of the information over sizes, and rest."""
        common = triangle(np.vstack([chain.common for chain in chains]))
        p = self._values.size
        scaled, rest = common[:p, :p] * self._sizes, common[:p, p]
        _, strengths, rows = np.linalg.svd(scaled)
        is_known = strengths > 1.0 / UNDETERMINED
        self._parts = rows[is_known].T, rows[~is_known].T
        return scaled, rest

    def _set_noise(self, index: int, errors: FloatArray) -> None:
        """The noise of each group of columns, from their errors."""
        channels, spread = self._pieces[index].data.channels, self._spread[index]
        groups = [channel.group for channel in channels]
        for group in set(groups):
            own = [i for i, each in enumerate(groups) if each == group]
            found = float(np.sqrt(np.nanmean(np.square(errors[:, :, own]))))
            self._noise[index][own] = np.maximum(found, self._floor * float(np.max(spread[own])))

    def _fitted(
        self, slopes: Sequence[PieceDerivatives], chains: Sequence[StateChain]
    ) -> FitResult:
        p, information, errors = self._values.size, [], []
        for index, chain in enumerate(chains):
            found, along = slopes[index], chain.states(np.zeros(p))[1]
            n = along.shape[1]
            total = np.einsum("jkcn,jnp->jkcp", found.of_errors[..., :n], along)
            total += found.of_errors[..., n:]
            both = np.concatenate([total, found.errors[..., None]], axis=3)
            both = np.where(np.isnan(found.errors)[..., None], 0.0, both)
            both /= self._noise[index][:, None]
            flat = both.reshape(len(both), -1, p + 1)
            information.append(np.matmul(flat[..., :p].transpose(0, 2, 1), flat))
            pieces = self._pieces[index]
            left = np.full(pieces.data.values.shape, np.nan)
            left[pieces.rows[:, :-1][pieces.is_own]] = found.errors[pieces.is_own]
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
