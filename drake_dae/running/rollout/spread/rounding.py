"""How far rounded positions spread the signals of a sampled loop."""

from dataclasses import dataclass

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.running.rollout.program import RolloutProgram
from drake_dae.running.rollout.spread.recursion import Step

_RUNS = 64
"""The runs of the linearized loop. From 64 values a deviation is known to 9 per cent; the square
root of its mean over a time in which the loop forgets ten times is known to 3 per cent."""


@dataclass(frozen=True, eq=False)
class Rounding:
    """Encoders that round, in a loop whose encoders have a noise of the same deviation instead.

    Attributes:
        source: The name of the RandomSource of the encoders, whose first entries are of positions.
        signal: The name of the signal whose first entries are the positions.
        steps: The step h of each position, in rad or m, shape (k,); 0 for none.
        noise: The deviation of the noise that is added before a position is rounded, shape (k,).
    """

    source: str
    signal: str
    steps: FloatArray
    noise: FloatArray

    @property
    def deviations(self) -> FloatArray:
        """The deviation of rounded positions from true ones, sqrt(h^2 / 12 + noise^2)."""
        return np.sqrt(np.square(self.steps) / 12.0 + np.square(self.noise))


class RoundedRuns:
    """Runs of the linearized loop whose positions are rounded, each with other zeros of encoders.

    The loop is that of the noise, dz+ = A dz + B n and dy = C dz + D n, in which encoders read

        h round((q + dq + noise) / h + b) - h b,    -1/2 <= b < 1/2

    in place of q + dq, with the position q of the run without noise. That is not linear: a loop
    holds a resting joint at the limit between two steps, where its encoder answers a small motion
    with a whole step, so that the loop oscillates as with a relay. The variances are mean squares
    over these runs.

    Args:
        program: The diagram.
        rounding: How encoders round.
        size: The number of entries of z.
    """

    def __init__(self, program: RolloutProgram, rounding: Rounding, size: int) -> None:
        self._rounding, self._width = rounding, program.compiled.sizes["noise"]
        count = rounding.steps.size
        first = {source.get_name(): part.start for source, part in program.compiled.noise}
        start = first[rounding.source]
        self._entries = slice(start, start + count)
        names = list(program.signals)
        before = sum(len(program.signals[n]) for n in names[: names.index(rounding.signal)])
        self.positions = slice(before, before + count)
        self._random = np.random.default_rng(0)
        self._states = np.zeros((size, _RUNS))
        # Zeros of each encoder that are evenly spread, in an order of their own.
        places = np.tile((np.arange(_RUNS) + 0.5) / _RUNS - 0.5, (count, 1))
        self._zeros = self._random.permuted(places, axis=1)

    def after(
        self,
        steps: tuple[Step, Step],
        read: tuple[FloatArray, FloatArray],
        rows: FloatArray,
        moments: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """The variances of all signals and of their changes after further periods.

        They are means over the second half of these periods and the one that follows.

        Args:
            steps: Steps like those of the first and of the second half of these periods.
            read: The slopes of the positions before each update, of these steps.
            rows: The signals of the run without noise where each of them begins, where the
                following one begins and ends, and a period later.
            moments: When updates are due, as parts of a period.
        """
        since = len(rows) - 3
        nominal, half = rows[:, self.positions], since // 2
        squares = np.zeros((2, rows.shape[1]))
        states, before = self._states, None
        for index in range(since + 2):
            late = int(index >= half)
            (a, b, c, d), slopes = steps[late], read[late]
            if index == since:
                self._states = states
            between = nominal[index] + moments[:, None] * (nominal[index + 1] - nominal[index])
            noise = self._noise(slopes, between, states)
            shown = c @ states + d @ noise
            if before is not None:
                squares[1] += np.mean(np.square(shown - before), axis=1)
            if late and index <= since:
                squares[0] += np.mean(np.square(shown), axis=1)
                before = shown
            states = a @ states + b @ noise
        whole, change = squares / (since + 1 - half)
        return whole, change

    def _noise(self, read: FloatArray, nominal: FloatArray, states: FloatArray) -> FloatArray:
        """The random numbers of a period, those of the encoders with what rounding adds."""
        rounding, zeros = self._rounding, self._zeros
        numbers = self._random.standard_normal((len(nominal) * self._width, _RUNS))
        rounds = rounding.steps > 0.0
        steps = np.where(rounds, rounding.steps, 1.0)[:, None]
        unit = np.where(rounding.deviations > 0.0, rounding.deviations, 1.0)[:, None]
        for moment, (slopes, places) in enumerate(zip(read, nominal, strict=True)):
            first = moment * self._width
            drawn = numbers[first + self._entries.start : first + self._entries.stop]
            added = rounding.noise[:, None] * drawn
            moved = slopes @ np.vstack([states, numbers])
            place = (places[:, None] + moved + added) / steps + zeros
            rounded = steps * (np.round(place) - place)
            drawn[:] = (added + np.where(rounds[:, None], rounded, 0.0)) / unit
        return numbers
