"""A run with fixed steps as a chain of functions, each of which has derivatives."""

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import casadi as ca

from drake_dae.arrays import FloatArray
from drake_dae.compiler.compiled import ARGUMENTS, CompiledDiagram
from drake_dae.running.rollout.program import Program
from drake_dae.running.rollout.run import Problem, Tableau
from drake_dae.running.rollout.stepping.called import Called
from drake_dae.running.rollout.stepping.course import REACHED
from drake_dae.running.rollout.stepping.interpreted import fixed_steps

MOST = 8
"""So often two Newton steps may follow each other, as the rollout has it."""


class Link(NamedTuple):
    """A function that a run has computed.

    Attributes:
        kind: What it determines: "row", "state" or "held".
        function: (time, state, held, parameters, and others) -> a column.
        arguments: What it was given.
        row: Which row of the record it is.
    """

    kind: str
    function: "Differentiable"
    arguments: tuple[FloatArray | float, ...]
    row: int = 0


class Differentiable:
    """A function with its derivatives in both directions, made when they are needed."""

    def __init__(self, function: ca.Function) -> None:
        self._function, self.value = function, Called(function)
        self.forward = cache(self._forward)
        self.backward = cache(self._backward)

    def _forward(self) -> Called:
        """(arguments, changes of state, held and parameters) -> the change of the result."""
        symbols = _symbols(self._function)
        changes = [ca.SX.sym("d", symbol.numel()) for symbol in symbols[1:4]]
        value = self._function.call(symbols)[0]
        found = sum(
            (ca.jtimes(value, x, d) for x, d in zip(symbols[1:4], changes, strict=True)),
            ca.SX.zeros(value.shape),
        )
        return self._called("forward", [*symbols, *changes], [found])

    def _backward(self) -> Called:
        """(arguments, weights of the result) -> the gradient by state, held and parameters."""
        symbols = _symbols(self._function)
        value = self._function.call(symbols)[0]
        weights = ca.SX.sym("weights", value.numel())
        found = [ca.jtimes(value, x, weights, True) for x in symbols[1:4]]
        return self._called("backward", [*symbols, weights], found)

    @staticmethod
    def _called(name: str, given: Sequence[ca.SX], found: Sequence[ca.SX]) -> Called:
        dense = [ca.densify(each) for each in found]
        return Called(ca.Function(name, list(given), ca.cse(dense), {"cse": False}))


class Links:
    """The functions of a run, found as they are computed, in the order of stepper.c."""

    def __init__(self, program: Program, problem: Problem, tableau: Tableau) -> None:
        self._program, self._problem, self._tableau = program, problem, tableau
        self._state, self._held, self._event = problem.state, problem.held, 0
        self._given = (problem.parameters,)
        self.found: list[Link] = []

    def run(self, longest: float) -> None:
        """Runs from the start to the end."""
        times, number = self._problem.times, 0
        for block in fixed_steps(self._problem, longest):
            for first, after, is_row in block.tolist():
                if not number:
                    self._add("row", "row", first)
                    number = 1
                self._update(first)
                self._add("state", "step", first, after - first)
                if is_row and number < times.size - 1:
                    self._add("row", "row", after, row=number)
                    number += 1
        self._update(times[-1])
        self._add("row", "row", times[-1], row=number)

    def _update(self, time: float) -> None:
        """What happens at the start of a step: the projection, and the updates that are due."""
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
        arguments = (time, self._state, self._held, *self._given, *others)
        value = function.value(*arguments)[0].copy()
        self.found.append(Link(kind, function, arguments, row))
        if kind == "state":
            self._state = value
        elif kind == "held":
            self._held = value

    def _function(self, name: str) -> "Differentiable":
        return self._program.kept(f"gradient {name} {self._key(name)}", lambda: self._made(name))

    def _key(self, name: str) -> str:
        return repr(self._tableau) if name == "step" else ""

    def _made(self, name: str) -> "Differentiable":
        compiled = self._program.compiled
        if name == "row":
            return Differentiable(compiled.row)
        if name == "newton":
            return Differentiable(compiled.newton(2))
        if name == "step":
            return Differentiable(_step(compiled.rate, self._tableau))
        _, due, kind = name.split()
        return Differentiable(_updates(compiled, int(due), kind == "True"))


def _symbols(function: ca.Function) -> list[ca.SX]:
    return [ca.SX.sym("x", function.numel_in(i)) for i in range(function.n_in())]


def _step(rate: ca.Function, tableau: Tableau) -> ca.Function:
    """A Runge-Kutta step: (time, state, held, parameters, step) -> the state."""
    time, state, held, parameters = _symbols(rate)
    step = ca.SX.sym("step")

    def weighted(weights: FloatArray) -> ca.SX:
        pairs = zip(weights.tolist(), rates, strict=False)
        return sum((weight * each for weight, each in pairs if weight), ca.SX.zeros(state.shape))

    rates: list[ca.SX] = []
    for row, part in zip(tableau.a, tableau.c, strict=True):
        stage = state + step * weighted(row)
        rates.append(rate(time + part * step, stage, held, parameters)[0])
    reached = state + step * weighted(tableau.b)
    return ca.Function("step", [time, state, held, parameters, step], [reached])


def _updates(compiled: CompiledDiagram, due: int, is_unrestricted: bool) -> ca.Function:
    """All updates of one kind at an instant: (time, ..., noise) -> what is held."""
    names = (*ARGUMENTS, "noise")
    symbols = [ca.SX.sym(name, compiled.sizes[name]) for name in names]
    held = ca.SX(symbols[2])
    for number, rate in enumerate(compiled.rates):
        if due >> number & 1 and rate.is_unrestricted == is_unrestricted:
            held[list(rate.places)] = rate.function(*symbols)[0]
    return ca.Function("update", symbols, [held])
