"""A sampled loop over one sample: its map, and the modes and errors of its linear model."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, log2, pi

import casadi as ca
import numpy as np
import scipy.linalg

from drake_dae.arrays import FloatArray
from drake_dae.blocks.block import TIME, Block, stacked
from drake_dae.errors import ModelError

HELD = 0.3
"""Real poles within 0.3/s of 0 are left out: counters, and estimates that are held where nothing
moves them; as the posture turns, these drift. Slow modes by friction are pairs."""

EVERY = 2.0
"""A deviation appears or turns every 2 s; noise has acted as long."""

_CHANGE, _LEAST = 1e-7, 1e-2
"""The change of a value for a difference, relative to its size, of which the least is 0.01."""

_FLOW = 2.5e-4
"""The longest step in s by which a continuous state is integrated."""

_SAME = 1e-6


@dataclass(frozen=True, eq=False)
class LinearLoop:
    """x[k+1] = A x[k] + B n[k] about a motion, with noise n of deviation 1, and rows C x.

    Attributes:
        period: The time between samples in s.
        A, B: The matrices.
        rows: Name of an output of the block -> its C.
    """

    period: float
    A: FloatArray
    B: FloatArray
    rows: dict[str, FloatArray]

    @property
    def poles(self) -> np.ndarray:
        """log(z) / T of the eigenvalues z, in 1/s, the slowest first."""
        if not np.isfinite(self.A).all():  # A state without a sample after it.
            return np.array([np.inf + 0j])
        found = self._logarithms(np.linalg.eigvals(self.A))
        found = found[np.isfinite(found)]
        return found[np.argsort(-found.real)]

    def _logarithms(self, values: np.ndarray) -> np.ndarray:
        """log(z) / T, and -inf for what is left out."""
        z = values.astype(complex)
        poles = np.log(np.where(np.abs(z) > 1e-9, z, 1.0)) / self.period
        poles[(np.abs(poles) < HELD) & (np.abs(poles.imag) < 1e-3)] = -np.inf
        return poles

    @property
    def decay(self) -> float:
        """The rate at which the slowest mode decays, in 1/s; negative if it grows."""
        return float(-self.poles[0].real)

    @property
    def damping(self) -> float:
        """The least damping ratio below half the Nyquist rate, pi / (2 T); -1 if it has none."""
        poles = self.poles
        if not np.isfinite(poles).all():
            return -1.0
        poles = poles[np.abs(poles.imag) < pi / (2.0 * self.period)]
        return float(np.min(-poles.real / np.abs(poles), initial=1.0))

    def participation(self, ratio: float) -> FloatArray:
        """The shares of all x in the worst mode: decays count in 1/s, damping ratios by `ratio`."""
        if not np.isfinite(self.A).all():
            return np.zeros(len(self.A))
        values, left, right = scipy.linalg.eig(self.A, left=True)
        poles = self._logarithms(values)
        with np.errstate(invalid="ignore"):
            damped = np.where(np.isfinite(poles), -poles.real / np.abs(poles) / ratio, np.inf)
        inside = np.abs(poles.imag) < pi / (2.0 * self.period)
        worst = int(np.argmin(np.minimum(-poles.real, np.where(inside, damped, np.inf))))
        shares: FloatArray = np.abs(left[:, worst] * right[:, worst])
        return shares

    def by_noise(self, name: str) -> FloatArray:
        """The standard deviation of each row by noise."""
        C = self.rows[name]
        spread = _summed(self.A, self.B @ self.B.T, self._doublings)
        return _roots(C @ spread @ C.T)

    def change_by_noise(self, name: str) -> FloatArray:
        """The standard deviation of each row's change from sample to sample."""
        C = self.rows[name]
        change, direct = C @ self.A - C, C @ self.B
        spread = _summed(self.A, self.B @ self.B.T, self._doublings)
        return _roots(change @ spread @ change.T + direct @ direct.T)

    def after_push(self, name: str, push: FloatArray) -> FloatArray:
        """The rms of each row over `EVERY`, with w added to x[k+1] at each sample."""
        size = len(self.A)
        whole = np.zeros((size + 1, size + 1))
        whole[:size, :size], whole[:size, size], whole[size, size] = self.A, push, 1.0
        start = np.zeros((size + 1, size + 1))
        start[size, size] = 1.0
        spread = _summed(whole, start, self._doublings)[:size, :size]
        C = self.rows[name]
        return _roots(C @ spread @ C.T) / 2.0 ** (self._doublings / 2)

    @property
    def _doublings(self) -> int:
        return max(1, round(log2(EVERY / self.period)))


def _summed(A: FloatArray, Q: FloatArray, doublings: int) -> FloatArray:
    """The sum of A^k Q A^k^T for k < 2^doublings; it exists where A has an eigenvalue 1, too."""
    for _ in range(doublings):
        Q = Q + A @ Q @ A.T
        A = A @ A
    return Q


def _roots(squares: FloatArray) -> FloatArray:
    result: FloatArray = np.sqrt(np.maximum(np.diag(squares), 0.0))
    return result


class SampledLoop:
    """The map x[k+1] = F(t, x[k], n[k]; p) of a block with samples, from one to the next.

    x are its states and held values just before the updates of a sample. Updates of one instant
    come in Drake's order; a continuous state is integrated by the classical Runge-Kutta method.

    Args:
        block: The block. Its inputs are noise.
        outputs: The names of outputs of which `linear` has the rows.

    Attributes:
        block: The argument.
        period: The longest period of its samples, in s.
        places: Name of held values -> the place of their first one in x.
        start: x at the start; nan where it follows from others, see `begun`.

    Raises:
        ModelError: The block has no samples, or a period that is no fraction of the longest one.
    """

    def __init__(self, block: Block, outputs: Sequence[str]) -> None:
        if not block.held:
            raise ModelError(f"'{block.name}' has no samples")
        self.block, groups = block, list(block.held.values())
        self.period = max(held.period for held in groups)
        parts = [block.state, *(held.symbol for held in groups)]
        self._x, self._n = stacked(parts), stacked([*block.inputs.values()])
        self._places = np.cumsum([0, *(part.numel() for part in parts)]).tolist()
        self.size, self.noise = self._x.numel(), self._n.numel()
        self.start = np.concatenate([block.default("state"), *(held.start for held in groups)])
        begins = [held.symbol if held.begin is None else held.begin for held in groups]
        self._begins = self._function([stacked([block.state, *begins])])
        ends = self._places[1:-1]
        self.places = dict(zip(block.held, ends, strict=True))
        self._shown = self._function([stacked([block.outputs[name] for name in outputs])])
        self._names = {name: block.outputs[name].numel() for name in outputs}
        self._flow = self._function([block.derivative]) if block.state.numel() else None
        self._events = self._schedule()
        self._maps: dict[tuple[ca.Function, int], ca.Function] = {}

    def _function(self, values: list[ca.SX]) -> ca.Function:
        symbols = [TIME, self._x, self._n, self.block.parameters]
        return ca.Function("f", symbols, [ca.densify(value) for value in values], {"cse": True})

    def _schedule(self) -> list[tuple[float, ca.Function]]:
        """The updates within a period: their times in s, and x after them."""
        due: dict[tuple[float, bool], list[int]] = {}
        for i, held in enumerate(self.block.held.values()):
            count = round(self.period / held.period)
            if abs(count * held.period - self.period) > _SAME * self.period:
                raise ModelError(
                    f"'{self.block.name}': a period of {held.period:g} s is no whole fraction of "
                    f"{self.period:g} s"
                )
            for j in range(count):
                moment = round((held.offset + j * held.period) % self.period, 12)
                due.setdefault((moment, not held.is_unrestricted), []).append(i)
        made: dict[tuple[int, ...], ca.Function] = {}
        events = []
        for (moment, _), indices in sorted(due.items()):
            if (key := tuple(indices)) not in made:
                parts = [self.block.state]
                for i, held in enumerate(self.block.held.values()):
                    parts.append(held.next if i in indices else held.symbol)
                made[key] = self._function([stacked(parts)])
            events.append((moment, made[key]))
        return events

    def begun(self, time: float, x: FloatArray, parameters: FloatArray) -> FloatArray:
        """Columns of x at the start, with what sensors and holds begin with in place of nan."""
        none = np.zeros((self.noise, x.shape[1]))
        for _ in self.block.held:  # A hold may begin with what a law makes of a sensor's beginning.
            if not np.isnan(x).any():
                break
            x = np.where(np.isnan(x), self._call(self._begins, time, x, none, parameters), x)
        return x

    def after(self, time: float, x: FloatArray, parameters: FloatArray) -> FloatArray:
        """The next x without noise, of columns of x and of parameters."""
        return self._after(time, x, np.zeros((self.noise, x.shape[1])), parameters)

    def _after(self, time: float, x: FloatArray, n: FloatArray, p: FloatArray) -> FloatArray:
        moment = 0.0
        for event, update in [*self._events, (self.period, None)]:
            x = self._flown(time + moment, event - moment, x, n, p)
            moment = event
            if update is not None:
                x = self._call(update, time + moment, x, n, p)
        return x

    def _flown(
        self, time: float, length: float, x: FloatArray, n: FloatArray, p: FloatArray
    ) -> FloatArray:
        """x after its continuous states have moved on."""
        count, states = ceil(length / _FLOW - _SAME), self.block.state.numel()
        if self._flow is None or count <= 0:
            return x
        h = length / count
        for i in range(count):
            rates = list[FloatArray]()
            for share in (0.0, 0.5, 0.5, 1.0):
                moved = x.copy()
                if rates:
                    moved[:states] += share * h * rates[-1]
                rates.append(self._call(self._flow, time + (i + share) * h, moved, n, p))
            x = x.copy()
            x[:states] += h / 6.0 * (rates[0] + 2.0 * rates[1] + 2.0 * rates[2] + rates[3])
        return x

    def _call(
        self, function: ca.Function, time: float, x: FloatArray, n: FloatArray, p: FloatArray
    ) -> FloatArray:
        count = x.shape[1]
        key = function, count
        if key not in self._maps:
            self._maps[key] = function.map(count) if count > 1 else function
        result: FloatArray = self._maps[key](np.full((1, count), time), x, n, p).full()
        return result

    def shown(self, time: float, x: FloatArray, parameters: FloatArray) -> dict[str, FloatArray]:
        """Name of an output -> its columns."""
        none = np.zeros((self.noise, x.shape[1]))
        values = self._call(self._shown, time, x, none, parameters)
        ends = np.cumsum([*self._names.values()])[:-1]
        return dict(zip(self._names, np.split(values, ends), strict=True))

    def linear(self, time: float, x: FloatArray, parameters: FloatArray) -> LinearLoop:
        """The linear model about x, shape (n,), by central differences.

        Exact derivatives of an estimator have fifty times its operations, and are no numbers where
        nothing moves yet.
        """
        sizes = np.concatenate([np.maximum(np.abs(x), _LEAST), np.ones(self.noise)])
        steps = _CHANGE * np.concatenate([sizes[: self.size], 1e3 * sizes[self.size :]])
        moved = np.hstack([np.zeros((steps.size, 1)), np.diag(steps)])
        moved[: self.size] += x[:, None]
        columns, noise = np.split(moved, [self.size])
        p = np.tile(parameters[:, None], (1, moved.shape[1]))

        def slopes(values: FloatArray) -> FloatArray:
            result: FloatArray = (values[:, 1:] - values[:, :1]) / steps
            return result

        ahead = self._after(time, columns, noise, p)
        A, B = np.hsplit(slopes(ahead), [self.size])
        later = ahead[:, 0]
        counts = (x == np.round(x)) & (np.abs(x) >= 1.0) & (later == np.round(later))
        A[:, counts] = np.eye(self.size)[:, counts]  # Logic has no slope.
        shown = slopes(self._call(self._shown, time, columns, noise, p))[:, : self.size]
        ends = np.cumsum([*self._names.values()])[:-1]
        rows = dict(zip(self._names, np.split(shown, ends), strict=True))
        return LinearLoop(self.period, A, B, rows)
