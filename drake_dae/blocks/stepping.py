"""A block as a stepper sees it: functions of numbers, and the runs to make with them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cache, cached_property
from threading import local
from typing import NamedTuple, Self

import casadi as ca
import numpy as np
from pydrake.systems.analysis import SimulatorConfig

from drake_dae.arrays import FloatArray
from drake_dae.blocks.block import TIME, Block, stacked
from drake_dae.errors import ModelError

SHARE = 1e-3
"""The error of a step over the accuracy: rows between long steps are then as accurate as these."""

SMALLEST = 1e-13
"""The least relative error of a step: below it is round-off."""


class Rate(NamedTuple):
    """Held values that are updated together, at t_k = offset + k period."""

    period: float
    offset: float
    is_unrestricted: bool
    places: list[int]  # among all held values
    function: ca.Function  # of (time, state, held, parameters, noise)


class Buffered:
    """A CasADi function on arrays, without conversions; arrays of its own for each thread."""

    def __init__(self, function: ca.Function) -> None:
        self._function, self._local = function, local()

    def _bind(self) -> None:
        function, mine = self._function, self._local
        mine.arrays = [np.zeros(function.numel_in(i)) for i in range(function.n_in())]
        mine.results = [np.zeros(function.numel_out(i)) for i in range(function.n_out())]
        mine.buffer, mine.evaluate = function.buffer()
        for i, array in enumerate(mine.arrays):
            mine.buffer.set_arg(i, array.data)
        for i, array in enumerate(mine.results):
            mine.buffer.set_res(i, array.data)

    def __call__(self, *arguments: FloatArray | float) -> list[FloatArray]:
        """Returns the results, which the next call in this thread overwrites."""
        if not hasattr(self._local, "arrays"):
            self._bind()
        mine = self._local
        for array, value in zip(mine.arrays, arguments, strict=True):
            array[...] = value
        mine.evaluate()
        results: list[FloatArray] = mine.results
        return results


class StepFunctions:
    """The functions of a block: of time, state, all held values and parameters, dense columns.

    Its only input is "noise", drawn for each update. A result that is not valid is not finite.
    `rate` is x', 0 for a block without a state; `row` all outputs, stacked; `newton` the state
    after a Newton step to its manifold, and the length of this step in units of the scale.
    """

    def __init__(self, block: Block) -> None:
        self.block, no_state = block, not block.state.numel()
        state = ca.SX.sym("none") if no_state else block.state
        held = stacked([each.symbol for each in block.held.values()])
        noise = block.inputs.get("noise", ca.SX.sym("noise", 0))
        self.columns = [TIME, state, held, block.parameters]
        self.size, self.sizes = state.numel(), [each.numel() for each in (*self.columns, noise)]
        self.scale = np.ones(self.size) if block.scale is None or no_state else block.scale
        self.rate = self._function("rate", [ca.SX(1, 1) if no_state else block.derivative])
        self.row = self._function("row", [stacked([*block.outputs.values()])])
        after, length = state, ca.SX(0.0)
        if block.projection is not None:
            step = block.projection.newton(state, state, block.projection.parameters)
            after, length = state + ca.DM(self.scale) * step, ca.norm_2(step)
        self.newton = self._function("newton", [after, length])
        ends = np.cumsum([0, *(each.symbol.numel() for each in block.held.values())])
        places = {name: range(ends[i], ends[i + 1]) for i, name in enumerate(block.held)}
        self.rates = [
            Rate(
                *rate,
                [place for name in names for place in places[name]],
                self._function("update", [stacked([block.held[n].next for n in names])], [noise]),
            )
            for rate, names in block.rates().items()
        ]
        self.projects = block.projection is not None

    def _function(
        self, name: str, values: list[ca.SX], more: list[ca.SX] | None = None
    ) -> ca.Function:
        dense = ca.cse([ca.densify(value) for value in values])
        return ca.Function(name, [*self.columns, *(more or [])], dense, {"cse": False})

    @cached_property
    def functions(self) -> dict[str, ca.Function]:
        """All functions by name; "update_0", ... in the order of `rates`."""
        updates = {f"update_{i}": rate.function for i, rate in enumerate(self.rates)}
        return {"rate": self.rate, "row": self.row, "newton": self.newton, **updates}

    @cached_property
    def buffered(self) -> Mapping[str, Callable[..., list[FloatArray]]]:
        """All functions, to be called on arrays."""
        return {name: Buffered(function) for name, function in self.functions.items()}

    @property
    def num_operations(self) -> int:
        """The number of operations of all functions together."""
        return sum(int(each.n_instructions()) for each in self.functions.values())

    @cached_property
    def _expressions(self) -> tuple[Buffered, Buffered]:
        """The held values at the start of a run, and the parameters of the projection."""
        held, projection = self.block.held.values(), self.block.projection
        begun = [each.symbol if each.begin is None else each.begin for each in held]
        parameters = ca.SX(0, 1) if projection is None else projection.parameters
        values = {"begin": stacked(begun), "of": parameters}
        begin, of = (Buffered(self._function(name, [value])) for name, value in values.items())
        return begin, of

    def begun(
        self, time: float, state: FloatArray, held: FloatArray, parameters: FloatArray
    ) -> FloatArray:
        """The held values at the start of a run: those that are nan come from `Held.begin`."""
        if not np.isnan(held).any():
            return held
        (begun,) = self._expressions[0](time, state, held, parameters)
        return np.where(np.isnan(held), begun, held)

    def projected(
        self, time: float, state: FloatArray, held: FloatArray, parameters: FloatArray
    ) -> FloatArray:
        """The state on the manifold, also where plain Newton steps do not lead there."""
        assert self.block.projection is not None
        (values,) = self._expressions[1](time, state, held, parameters)
        return self.block.projection.project(state, values)


class Tableau(NamedTuple):
    """An explicit Runge-Kutta method: A, shape (s, s), b and c, shape (s,)."""

    a: FloatArray
    b: FloatArray
    c: FloatArray


def _tableau(a: list[list[float]], b: list[float], c: list[float]) -> Tableau:
    square = np.zeros((len(b), len(b)))
    for row, values in enumerate(a):
        square[row, : len(values)] = values
    return Tableau(square, np.array(b, dtype=float), np.array(c, dtype=float))


FIXED = ("explicit_euler", "runge_kutta2", "runge_kutta3", "bogacki_shampine3", "runge_kutta5")
"""Drake's explicit schemes."""


@cache
def tableau_of(scheme: str) -> Tableau:
    """One of `FIXED`, or "dop853", of order 8, with error control (Hairer, Norsett, Wanner, 1993).

    SciPy's tables are read here: a run that needs none need not load its integrators.
    """
    from scipy.integrate import DOP853, RK23, RK45

    return {
        "explicit_euler": _tableau([[]], [1.0], [0.0]),
        "runge_kutta2": _tableau([[], [1.0]], [0.5, 0.5], [0.0, 1.0]),
        "runge_kutta3": _tableau([[], [0.5], [-1.0, 2.0]], [1 / 6, 2 / 3, 1 / 6], [0.0, 0.5, 1.0]),
        "bogacki_shampine3": _tableau(RK23.A, RK23.B, RK23.C),
        "runge_kutta5": _tableau(RK45.A, RK45.B, RK45.C),
        "dop853": Tableau(DOP853.A, DOP853.B, DOP853.C),
    }[scheme]


@cache
def dop853_tables() -> dict[str, FloatArray]:
    """The estimates of the error and the interpolant of DOP853, by their names in stepper.c."""
    from scipy.integrate import DOP853

    named = {"e3": DOP853.E3, "e5": DOP853.E5, "d": DOP853.D}
    named |= {"a_more": DOP853.A_EXTRA, "c_more": DOP853.C_EXTRA}
    return {name: np.ascontiguousarray(table) for name, table in named.items()}


class RunEnding(IntEnum):
    """How the stepping ended; stepper.c has the same list."""

    DONE = 0
    PAUSED = 1
    INVALID = 2
    OFF_MANIFOLD = 3
    STUCK = 4
    SPOILT = 5
    SLOW = 6


Look = Callable[[Callable[[], FloatArray]], bool]
"""Called from time to time with a function that returns the rows up to then: whether to stop."""


@dataclass(frozen=True, eq=False)
class StepSettings:
    """How to step."""

    longest: float  # or the fixed one, in s
    tableau: Tableau | None  # None: error control by DOP853
    absolute: FloatArray  # of each state, (n,)
    relative: float
    look: Look  # may stop a run

    @classmethod
    def of(cls, config: SimulatorConfig, functions: StepFunctions, look: Look) -> Self:
        """The settings from Drake's; implicit schemes have no fixed steps."""
        tableau, scheme = None, config.integration_scheme
        if not config.use_error_control:
            if scheme not in FIXED:
                raise ModelError(
                    f"integration_scheme: a rollout takes no fixed steps of {scheme}; choose "
                    f"{', '.join(FIXED)}, or use_error_control"
                )
            tableau = tableau_of(scheme)
        elif not functions.block.state.numel():  # There is no error to control.
            tableau = tableau_of("explicit_euler")
        relative = max(SHARE * config.accuracy, SMALLEST)
        return cls(config.max_step_size, tableau, relative * functions.scale, relative, look)


@dataclass(frozen=True, eq=False)
class RunProblem:
    """One run, or k runs over the same times, which then have a row each."""

    times: FloatArray  # of the rows, from the start to the end
    state: FloatArray  # (n,) or (k, n)
    held: FloatArray
    parameters: FloatArray  # (p,) or (k, p); (1, p) for all
    events: FloatArray
    due: np.ndarray  # the rates that are due at the events, as bits
    noise: FloatArray  # (len(events), q), or (k, ...), (1, ...)

    def run(self, i: int) -> "RunProblem":
        """One of many."""
        parameters, noise = (t[i if len(t) > 1 else 0] for t in (self.parameters, self.noise))
        return RunProblem(
            self.times, self.state[i], self.held[i], parameters, self.events, self.due, noise
        )


@dataclass(frozen=True, eq=False)
class Run:
    """The result of a run."""

    rows: FloatArray  # up to its end
    ending: RunEnding
    time: float  # of the last accepted state
    state: FloatArray
    held: FloatArray
    steps: int
    error: Exception | None = None  # of Drake
