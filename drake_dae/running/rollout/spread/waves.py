"""How far rounded positions spread the signals of a sampled loop."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import schur, solve_triangular

from drake_dae.arrays import FloatArray
from drake_dae.running.rollout.program import RolloutProgram
from drake_dae.running.rollout.spread.recursion import Step, of_signals, passed

ComplexArray = NDArray[np.complex128]

_WAVES = 50
"""The waves of a rounding error; what follows, 1 % of its variance, counts as white noise."""

_PER_DECADE, _SLOWEST = 40, 1e-5
"""The frequencies at which the loop is looked at: 0, and from 1e-5 of that of the samples on."""

_OFF = 1e-9
"""A growth per period, so that a frequency is never an eigenvalue."""


@dataclass(frozen=True, eq=False)
class Rounding:
    """Encoders that round, in a loop whose encoders have a noise of the same deviation instead.

    The error of a position q that is rounded to multiples of h is

        h sum_n (-1)^n / (pi n) sin(2 pi n q / h),

    a wave for each n with the frequency n q' / h and the variance h^2 / (2 pi^2 n^2), together
    h^2 / 12. If the zero of the encoder is unknown, so is its phase. Where a joint rests, all waves
    are constants. Where it passes many steps in a sample, the frequencies that the samples show are
    all over their range, as those of white noise. A deviation s of what is rounded, by the noise of
    the sensor and by the motion of the joint that noise causes, weakens a wave by exp(-2 pi^2 n^2
    s^2 / h^2) (Widrow's theorem); what it loses is white noise.

    Attributes:
        source: The name of the RandomSource of the encoders, whose first entries are of positions.
        signal: The name of the signal whose first entries are the positions.
        steps: h for each position, in rad or m, shape (k,); 0 for none.
        noise: The deviation of the noise that is added before a position is rounded, shape (k,).
    """

    source: str
    signal: str
    steps: FloatArray
    noise: FloatArray

    @property
    def unit(self) -> FloatArray:
        """`deviations`, and 1 in place of 0."""
        return np.where(self.deviations > 0.0, self.deviations, 1.0)

    @property
    def deviations(self) -> FloatArray:
        """The deviation of rounded positions from true ones, sqrt(h^2 / 12 + noise^2)."""
        return np.sqrt(np.square(self.steps) / 12.0 + np.square(self.noise))

    def waves(self, jitter: FloatArray) -> FloatArray:
        """The variances of the waves, relative to those of `deviations`, shape (n, k).

        Args:
            jitter: The deviations of the positions by noise, shape (k,).
        """
        number = np.arange(1, _WAVES + 1)[:, None]
        rounds = self.steps > 0.0
        steps = np.where(rounds, self.steps, 1.0)
        shaken = (np.square(jitter) + np.square(self.noise)) / np.square(steps)
        parts = np.exp(-np.square(2.0 * np.pi * number) * shaken) / (2.0 * (np.pi * number) ** 2)
        return np.where(rounds, parts * np.square(self.steps / self.unit), 0.0)


class RoundedPositions:
    """The part of the spread that rounded positions have: waves, and what is left as noise.

    A loop that holds a joint moves it to where its mean measured position is the wanted one. This
    is mostly at the limit between two steps, where noise turns the measurement to and fro. If the
    position answers its mean rounding error e(q) by -e, places have the density 1 + e'(q), and of
    the square of a rounding error, whose waves are h^2 (-1)^n / (pi n)^2 cos(2 pi n q / h), the
    mean grows by twice the variance of the waves. An answer G e to a wave counts with the real part
    of -G. This is noise as well, beside what `Rounding` says.
    """

    def __init__(self, program: RolloutProgram, rounding: Rounding, size: int) -> None:
        self._rounding, self._draws = rounding, program.compiled.sizes["noise"]
        first = {source.get_name(): part.start for source, part in program.compiled.noise}
        start = first[rounding.source]
        self._entries = slice(start, start + rounding.steps.size)
        names = list(program.signals)
        before = sum(len(program.signals[n]) for n in names[: names.index(rounding.signal)])
        self._positions = slice(before, before + rounding.steps.size)
        self._spread, self._count = np.zeros((size, size)), 0

    def after(
        self, first: Step, last: Step, rows: FloatArray, as_noise: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """The variances of all signals and of their changes after further periods.

        Args:
            first, last: Steps like those of the first and of the second half of these periods.
            rows: The signals without noise in the middle of each of them, and of the next.
            as_noise: The variances of the signals if all that is rounded were white noise.
        """
        (a, b, c, d), rounding, since = last, self._rounding, len(rows) - 1
        positions, entries = self._positions, self._entries
        waves = rounding.waves(np.sqrt(as_noise[positions]))
        # Of the updates in a period, those at which encoders are read.
        into, shown = (each.reshape(len(each), -1, self._draws)[..., entries] for each in (b, d))
        read = into.any(axis=(0, 2)) | shown.any(axis=(0, 2))
        moved = a.any(axis=0) | a.any(axis=1) | into.any(axis=(1, 2))
        part = a[np.ix_(moved, moved)], into[moved][:, read], c[:, moved], shown[:, read]
        frequencies = _frequencies(int(np.count_nonzero(read)))
        self._count += since
        gains = _gains(part, self._count, frequencies)
        steps = np.where(rounding.steps > 0.0, rounding.steps, 1.0)
        shares = _shares(waves, np.diff(rows[:, positions], axis=0) / steps, frequencies)
        square = np.einsum("jf,frj->fr", shares, np.square(np.abs(gains)))
        turned = np.square(2.0 * np.sin(np.pi * frequencies))
        follows = -np.einsum("jf,fjj->j", shares, gains[:, positions].real) / rounding.unit
        left = np.ones(self._draws)
        left[entries] += 2.0 * np.maximum(follows, 0.0) - np.sum(waves, axis=0)
        root = np.sqrt(np.maximum(left, 0.0))
        first, last = (self._weighed(each, root) for each in (first, last))
        self._spread = passed(first, last, since, self._spread)
        whole, change = of_signals(last, self._spread)
        return whole + np.sum(square, axis=0), change + turned @ square

    def _weighed(self, step: Step, root: FloatArray) -> Step:
        """A step with other deviations of the random numbers that are drawn at each update."""
        a, b, c, d = step
        roots = np.tile(root, b.shape[1] // self._draws)
        return a, b * roots, c, d * roots


def _shares(waves: FloatArray, turns: FloatArray, frequencies: FloatArray) -> FloatArray:
    """The variances of the waves at the frequencies of a grid, shape (k, frequencies).

    Args:
        waves: The variances of the waves, shape (n, k).
        turns: The steps of each encoder that a position passes in a period, shape (periods, k).
        frequencies: The grid, from 0 to half of the frequency of the draws, in turns per period.
    """
    number, last = np.arange(1, len(waves) + 1)[:, None], frequencies.size - 1
    draws = 2.0 * frequencies[-1]
    shares = np.zeros((waves.shape[1], last + 1))
    for joint, share in enumerate(shares):
        turned = number * turns[:, joint] / draws
        folded = draws * np.abs(turned - np.round(turned))
        place = np.interp(folded, frequencies, np.arange(last + 1.0))
        low = np.minimum(place.astype(int), last - 1)
        each = waves[:, joint, None] / max(len(turns), 1)
        np.add.at(share, low, each * (low + 1.0 - place))
        np.add.at(share, low + 1, each * (place - low))
    return shares


def _frequencies(draws: int) -> FloatArray:
    """The frequencies of a grid from 0 to half of that of the draws, in turns per period."""
    most = 0.5 * draws
    count = int(np.ceil(_PER_DECADE * np.log10(most / _SLOWEST)))
    return np.concatenate([[0.0], np.geomspace(_SLOWEST, most, count)])


def _gains(step: Step, count: int, frequencies: FloatArray) -> ComplexArray:
    """The signals by waves of 1 that have come in since some periods, shape (frequencies, rows, k).

    Such a wave z^k, with z = exp(i w), has reached

        y = (D + C (z - A)^-1 (1 - A^k z^-k) B) z^k.

    Args:
        step: A, B, C and D of one period, with the columns of the first to the last draw of each
            position in it, B of the shape (states, draws, k).
        count: The number of periods k.
        frequencies: w in turns per period.
    """
    a, b, c, d = step
    triangle, basis = schur(a, output="complex")
    past = np.linalg.matrix_power(triangle, count)
    inputs, outputs = np.tensordot(basis.conj().T, b, 1), c @ basis
    moments = np.arange(b.shape[1]) / b.shape[1]
    eye, found = np.eye(len(a)), []
    for frequency in frequencies.tolist():
        phases = np.exp(2j * np.pi * frequency * moments)
        z = np.exp(2j * np.pi * frequency + _OFF)
        driven = np.einsum("sdk,d->sk", inputs, phases)
        reached = solve_triangular(z * eye - triangle, driven - z**-count * (past @ driven))
        found.append(outputs @ reached + np.einsum("rdk,d->rk", d, phases))
    return np.array(found)
