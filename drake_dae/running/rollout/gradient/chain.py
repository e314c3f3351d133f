"""A run with fixed steps as a chain of functions, each of which has derivatives."""

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import casadi as ca

from drake_dae.arrays import FloatArray, show
from drake_dae.compiler.called import BufferedFunction
from drake_dae.compiler.compiled import ARGUMENTS, CompiledDiagram
from drake_dae.compiler.rates import dense_function
from drake_dae.errors import InconsistentStateError
from drake_dae.running.rollout.program import RolloutProgram
from drake_dae.running.rollout.run import RunProblem, Tableau
from drake_dae.running.rollout.stepping.functions import REACHED
from drake_dae.running.rollout.stepping.interpreted import fixed_steps

MOST = 8
"""The largest number of pairs of Newton steps, as in a rollout."""


class ComputedFunction(NamedTuple):
    """A function that a run has evaluated.

    Attributes:
        kind: The kind of its result: "row", "state" or "held".
        function: (time, state, held, parameters, ...) -> a column.
        arguments: The arguments.
        row: The index of a row in the record.
    """

    kind: str
    function: "Differentiable"
    arguments: tuple[FloatArray | float, ...]
    row: int = 0


class Differentiable:
    """A function with its derivatives in forward and backward mode, made when they are needed."""

    def __init__(self, function: ca.Function) -> None:
        self._function, self.value = function, BufferedFunction(function)
        self.forward = cache(self._forward)
        self.backward = cache(self._backward)

    def _forward(self, count: int) -> BufferedFunction:
        """(arguments, changes of state, held and parameters) -> the result, and its change.

        Args:
            count: The number of changes, in columns.
        """
        return BufferedFunction(_forward(self._function, count))

    def _backward(self) -> BufferedFunction:
        """(arguments, weights of the result) -> the gradient by state, held and parameters."""
        symbols = _symbols(self._function)
        value = self._function.call(symbols)[0]
        weights = ca.SX.sym("weights", value.numel())
        gradients = [ca.jtimes(value, x, weights, True) for x in symbols[1:4]]
        return BufferedFunction(dense_function("backward", [*symbols, weights], gradients))


class RungeKuttaStep(Differentiable):
    """A Runge-Kutta step, (time, state, held, parameters, step) -> the state.

    Args:
        rate: The derivative of the state.
        tableau: The method.
    """

    def __init__(self, rate: ca.Function, tableau: Tableau) -> None:
        super().__init__(_step(rate, tableau))
        self._rate, self._tableau = rate, tableau

    def _forward(self, count: int) -> BufferedFunction:
        # The stages share one function, which keeps the derivatives by many changes short.
        rate, sizes = _forward(self._rate, count), [self._rate.numel_in(i) for i in range(4)]
        time, state, held, parameters = (ca.MX.sym("x", size) for size in sizes)
        step = ca.MX.sym("step")
        changes = [ca.MX.sym("d", size, count) for size in sizes[1:]]
        values, slopes, zero = list[ca.MX](), list[ca.MX](), ca.MX(0.0)
        for row, part in zip(self._tableau.a, self._tableau.c, strict=True):
            x = state + step * _sum(row, values, zero)
            d = changes[0] + step * _sum(row, slopes, zero)
            value, slope = rate(time + part * step, x, held, parameters, d, *changes[1:])
            values.append(value)
            slopes.append(slope)
        b = self._tableau.b
        results = [state + step * _sum(b, values, zero), changes[0] + step * _sum(b, slopes, zero)]
        symbols = [time, state, held, parameters, step, *changes]
        return BufferedFunction(ca.Function("forward", symbols, results))


class ComputedFunctions:
    """The functions of a run, in the order in which stepper.c evaluates them."""

    def __init__(self, program: RolloutProgram, problem: RunProblem, tableau: Tableau) -> None:
        self._program, self._problem, self._tableau = program, problem, tableau
        self._state, self._held, self._event = problem.state, problem.held, 0
        self._parameters = problem.parameters
        self._key = repr(tableau)
        self._functions: dict[str, Differentiable] = {}
        self.links: list[ComputedFunction] = []

    def run(self, longest: float) -> None:
        """Runs from the start to the end."""
        times, number = self._problem.times, 1
        self._add("row", "row", times[0])
        for first, after, is_row in fixed_steps(self._problem, longest):
            self._update(first)
            self._add("state", "step", first, after - first)
            if is_row and number < times.size - 1:
                self._add("row", "row", after, row=number)
                number += 1
        self._update(times[-1])
        self._add("row", "row", times[-1], row=number)

    def _update(self, time: float) -> None:
        """Projects the state and makes the updates that are due, at the start of a step."""
        problem, projects = self._problem, self._program.compiled.projects
        while True:
            is_due = self._event < problem.events.size and problem.events[self._event] <= time
            due = int(problem.due[self._event]) if is_due else 0
            for is_unrestricted in (True, False):
                if due:
                    name = f"update {due} {is_unrestricted}"
                    self._add("held", name, time, problem.noise[self._event])
                if projects and is_unrestricted:
                    self._project(time)
            projects = False
            if not due:
                return
            self._event += 1

    def _project(self, time: float) -> None:
        for _ in range(MOST):
            self._add("state", "newton", time)
            if self._function("newton").value.results[1][0] <= REACHED:
                return

    def _add(
        self, kind: str, name: str, time: float, *others: FloatArray | float, row: int = 0
    ) -> None:
        function = self._function(name)
        arguments = (time, self._state, self._held, self._parameters, *others)
        value = function.value(*arguments)[0].copy()
        self.links.append(ComputedFunction(kind, function, arguments, row))
        if kind == "state":
            self._state = value
        elif kind == "held":
            self._held = value

    def _function(self, name: str) -> "Differentiable":
        if name not in self._functions:
            key = f"gradient {name} {self._key if name == 'step' else ''}"
            self._functions[name] = self._program.kept(key, lambda: self._made(name))
        return self._functions[name]

    def _made(self, name: str) -> "Differentiable":
        compiled = self._program.compiled
        if name == "row":
            return Differentiable(compiled.row)
        if name == "newton":
            return _newton(self._program)
        if name == "step":
            return RungeKuttaStep(compiled.rate, self._tableau)
        _, due, kind = name.split()
        return Differentiable(_updates(compiled, int(due), kind == "True"))


def projected(
    program: RolloutProgram,
    time: float,
    state: FloatArray,
    held: FloatArray,
    parameters: FloatArray,
) -> tuple[FloatArray, list[ComputedFunction]]:
    """Projects a state onto N*; returns it, and the functions of its Newton steps.

    Raises:
        InconsistentStateError: The Newton steps do not converge.
    """
    links = list[ComputedFunction]()
    if not program.compiled.projects:
        return state, links
    newton, start = _newton(program), state
    for _ in range(MOST):
        arguments = time, state, held, parameters
        links.append(ComputedFunction("state", newton, arguments))
        reached, left = newton.value(*arguments)
        state = reached.copy()
        if left[0] <= REACHED:
            return state, links
    raise InconsistentStateError(f"{program.name}: no start on N* near {show(start)}", left.copy())


def _newton(program: RolloutProgram) -> Differentiable:
    """Returns the function of two Newton steps to N*."""
    return program.kept("gradient newton", lambda: Differentiable(program.compiled.newton(2)))


def _symbols(function: ca.Function) -> list[ca.SX]:
    return [ca.SX.sym("x", function.numel_in(i)) for i in range(function.n_in())]


def _forward(function: ca.Function, count: int) -> ca.Function:
    """(arguments, changes of state, held and parameters) -> the result, and its change."""
    symbols = _symbols(function)
    changes = [ca.SX.sym("d", symbol.numel(), count) for symbol in symbols[1:4]]
    value = function.call(symbols)[0]
    change = sum(
        (ca.jtimes(value, x, d) for x, d in zip(symbols[1:4], changes, strict=True)),
        ca.SX.zeros(value.numel(), count),
    )
    return dense_function("forward", [*symbols, *changes], [value, change])


def _sum(weights: FloatArray, values: Sequence[Any], zero: Any) -> Any:
    """Returns the weighted sum of the stages so far."""
    pairs = zip(weights.tolist(), values, strict=False)
    return sum((weight * each for weight, each in pairs if weight), zero)


def _step(rate: ca.Function, tableau: Tableau) -> ca.Function:
    """Returns a Runge-Kutta step: (time, state, held, parameters, step) -> the state."""
    time, state, held, parameters = _symbols(rate)
    step, zero, rates = ca.SX.sym("step"), ca.SX.zeros(state.shape), list[ca.SX]()
    for row, part in zip(tableau.a, tableau.c, strict=True):
        stage = state + step * _sum(row, rates, zero)
        rates.append(rate(time + part * step, stage, held, parameters)[0])
    reached = state + step * _sum(tableau.b, rates, zero)
    return ca.Function("step", [time, state, held, parameters, step], [reached])


def _updates(compiled: CompiledDiagram, due: int, is_unrestricted: bool) -> ca.Function:
    """Returns all updates of one kind at an instant: (time, ..., noise) -> held values."""
    names = (*ARGUMENTS, "noise")
    symbols = [ca.SX.sym(name, compiled.sizes[name]) for name in names]
    held = ca.SX(symbols[2])
    for number, rate in enumerate(compiled.rates):
        if due >> number & 1 and rate.is_unrestricted == is_unrestricted:
            held[list(rate.places)] = rate.function(*symbols)[0]
    return ca.Function("update", symbols, [held])
