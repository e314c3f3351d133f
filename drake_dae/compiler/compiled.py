"""A compiled diagram: its CasADi functions and the layout of their arguments."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import casadi as ca
import numpy as np
from pydrake.systems.framework import Context, Diagram, System

from drake_dae.arrays import FloatArray
from drake_dae.blocks.computations import HELD, Computations
from drake_dae.blocks.traced_system import context_in
from drake_dae.compiler.groups import discrete_states, numeric_parameters
from drake_dae.compiler.rates import ColumnPlace, UpdateRate, dense_function
from drake_dae.compiler.trace import Expressions, TracedCall
from drake_dae.compiler.wires import Wires
from drake_dae.dae import Signal
from drake_dae.errors import ModelError

ARGUMENTS = ("time", "state", "held", "parameters")
"""The arguments of a compiled diagram's functions; updates have a fifth one, "noise"."""


@dataclass(frozen=True, eq=False)
class CompiledDiagram:
    """A diagram as functions of time, continuous state, discrete state (`held`) and parameters.

    Each function also returns a validity: a number that is finite if its other results are valid.

    Attributes:
        wires: The leaf systems and their connections.
        context: A context in which unconnected input ports have values.
        outputs: The names of the output ports that are computed.
        states, held, parameters, noise: The slice of each block in these columns.
        fixed: The unconnected input ports, whose values are parameters: (system, name, slice).
        inputs: The inputs of a part of a diagram, also parameters: (name, slice).
        rates: The updates, one function for each period, offset and kind.
        blocks: System -> block, in the order of Drake's states.
    """

    wires: Wires
    context: Context
    outputs: tuple[str, ...]
    states: tuple[ColumnPlace, ...]
    held: tuple[ColumnPlace, ...]
    parameters: tuple[ColumnPlace, ...]
    fixed: tuple[tuple[System, str, slice], ...]
    inputs: tuple[tuple[str, slice], ...]
    noise: tuple[ColumnPlace, ...]
    rates: tuple[UpdateRate, ...]
    blocks: Mapping[System, Computations]
    _expressions: Expressions = field(repr=False)
    _columns: Mapping[str, ca.SX] = field(repr=False)
    _values: Mapping[str, Sequence[ca.SX]] = field(repr=False)

    @property
    def diagram(self) -> Diagram:
        """The diagram."""
        return self.wires.diagram

    @cached_property
    def sizes(self) -> dict[str, int]:
        """The number of entries of each argument."""
        return {name: int(column.numel()) for name, column in self._columns.items()}

    @cached_property
    def rate(self) -> ca.Function:
        """(time, state, held, parameters) -> the derivative of the state, shape (n,), validity."""
        return self._function("rate", self._values["rate"])

    @cached_property
    def row(self) -> ca.Function:
        """(time, state, held, parameters) -> all outputs stacked, validity."""
        return self._function("row", self._values["row"])

    @cached_property
    def staged(self) -> Mapping[str, ca.Function]:
        """Name -> function, with all that depends only on time and parameters precomputed.

        "given" is (time, parameters) -> the precomputed column. "rate", "row", "newton",
        "update_0", ... are the functions of these names, with this column as an additional
        argument after the parameters.
        """
        column, values, substituted = self._expressions.given_column()
        arguments = [self._columns["time"], self._columns["parameters"]]
        functions = {"given": dense_function("given", arguments, [values])}
        for name, results in {**self._values, "newton": self._newton(1)}.items():
            arguments = [*(self._columns[each] for each in ARGUMENTS), column]
            if name.startswith("update"):
                arguments.append(self._columns["noise"])
            functions[name] = dense_function(name, arguments, substituted(results))
        return functions

    @cached_property
    def scale(self) -> FloatArray:
        """The scale of each continuous state, for error norms, shape (n,)."""
        scales = np.ones(self.sizes["state"])
        for system, part in self.states:
            if (scale := self.blocks[system].scale) is not None:
                scales[part] = scale
        return scales

    def start(self, context: Context) -> tuple[FloatArray, FloatArray]:
        """The continuous and the discrete states in a context."""
        state, held = np.zeros(self.sizes["state"]), np.zeros(self.sizes["held"])
        for system, part in self.states:
            local = context_in(system, context)
            state[part] = local.get_continuous_state_vector().CopyToVector()
        for system, part in self.held:
            local, block = system.GetMyContextFromRoot(context), self.blocks[system]
            groups = [block.stepped.held(local)] if block.stepped else discrete_states(local)
            held[part] = np.concatenate(groups)
        return state, held

    def initialized(
        self, time: float, state: FloatArray, held: FloatArray, parameters: FloatArray
    ) -> FloatArray:
        """The discrete state at the start of a run: NaN entries are those of `initial`."""
        start = held.copy()
        for part, initial in self._initial:
            if np.isnan(held[part]).any():
                start[part] = initial(time, state, held, parameters).full()[:, 0]
        return start

    @cached_property
    def _initial(self) -> list[tuple[slice, ca.Function]]:
        """The slice and the initial value of each block whose discrete state starts as NaN."""
        return [
            (part, self._function("initial", [self._initial_held(system)]))
            for system, part in self.held
            if self.blocks[system].initial is not None
        ]

    def _initial_held(self, system: System) -> ca.SX:
        initial = self.blocks[system].initial
        assert initial is not None
        call = self._expressions.call(self.blocks[system], initial)
        return call.results[initial.outputs.index(HELD)]

    def initialization(self, held: FloatArray) -> ca.Function | None:
        """(time, state, held, parameters) -> the discrete state at the start of a run.

        Args:
            held: The discrete state in a context. The function replaces the blocks that are NaN
                in it. None is returned if all entries are finite.
        """
        if all(np.isfinite(held)):
            return None
        columns = [self._columns["held"][part] for _, part in self.held]
        for number, (system, part) in enumerate(self.held):
            if self.blocks[system].initial is not None and np.isnan(held[part]).any():
                columns[number] = self._initial_held(system)
        return self._function("begin", [ca.vertcat(*columns)])

    def values(self, context: Context) -> FloatArray:
        """The parameters in a context of the diagram, shape (m,).

        Raises:
            ModelError: An unconnected input port has no value in this context.
        """
        values = np.zeros(self.sizes["parameters"])
        for system, part in self.parameters:
            local = context_in(system, context)
            values[part] = np.concatenate(numeric_parameters(local))
        for system, name, part in self.fixed:
            local, port = system.GetMyContextFromRoot(context), system.GetInputPort(name)
            if not port.HasValue(local):
                raise ModelError(
                    f"the input port '{name}' of '{system.get_name()}' has no value in this context"
                )
            values[part] = port.Eval(local)
        for name, part in self.inputs:
            system, index = self.wires.inputs[name]
            values[part] = system.get_output_port(index).Eval(system.GetMyContextFromRoot(context))
        return values

    @cached_property
    def twins(self) -> Mapping[System, System]:
        """Plant -> its twin: the controller whose law has the plant's system as its model."""
        controllers = {
            id(block.model): system
            for system, block in self.blocks.items()
            if block.under is not None
        }
        return {
            system: controllers[id(block.model)]
            for system, block in self.blocks.items()
            if block.under is None and block.model is not None and id(block.model) in controllers
        }

    def have_twins(self, parameters: FloatArray) -> np.ndarray:
        """Whether the parameters of all `twins` equal those of their controllers, shape (k,).

        Args:
            parameters: A row for each run, in the order of `values`, shape (k, m).
        """
        parts = dict(self.parameters)
        are_equal = np.full(len(parameters), bool(self.twins))
        for plant, controller in self.twins.items():
            of_plant = parameters[:, parts.get(plant, slice(0, 0))]
            equal = of_plant == parameters[:, parts[controller]][:, : of_plant.shape[1]]
            equal[:, list(self.blocks[plant].moving)] = True
            are_equal &= equal.all(axis=1)
        return are_equal

    @cached_property
    def moved_parameters(self) -> Mapping[System, ca.Function]:
        """Plant with time-varying parameters -> a function that returns all its parameters.

        The arguments are (time, state, held, parameters).
        """
        return {
            system: self._function("parameters", [self._expressions.parameters(block)])
            for system, block in self.blocks.items()
            if block.check_start is not None and block.moving
        }

    def newton(self, count: int) -> ca.Function:
        """(time, state, held, parameters) -> the state after `count` Newton steps to its manifolds.

        The second result is the length of the last step, in states divided by their scale. All
        steps use the constraint gradients at the start.
        """
        return self._function("newton", self._newton(count))

    def _newton(self, count: int) -> list[ca.SX]:
        state = ca.SX(self._columns["state"])
        length = ca.SX(0.0)
        for system, part in self.states:
            block = self.blocks[system]
            if block.projection is None:
                continue
            parameters = self._expressions.parameters(block)
            x = start = self._columns["state"][part]
            for _ in range(count):
                change = block.projection.newton(x, start, parameters)
                x = x + ca.DM(block.projection.scale) * change
            state[part], length = x, ca.fmax(length, ca.norm_2(change))
        return [state, length]

    @property
    def signals(self) -> dict[str, tuple[Signal, ...]]:
        """Name of an output -> names and units of its entries; numbered if its block names none."""
        signals = {}
        for name in self.outputs:
            system, index = self.wires.outputs[name]
            port = system.get_output_port(index)
            named = self.blocks[system].ports.get(port.get_name())
            signals[name] = named or tuple(Signal(f"{name}[{i}]") for i in range(port.size()))
        return signals

    @property
    def has_stepped(self) -> bool:
        """Whether Drake steps one of the blocks, because it cannot be traced."""
        return bool(self.rates) and self.rates[-1].stepped is not None

    @property
    def stepped(self) -> tuple[UpdateRate, Computations]:
        """The update and the block that Drake steps; requires `has_stepped`."""
        rate = self.rates[-1]
        assert rate.stepped is not None
        return rate, rate.stepped

    @property
    def projects(self) -> bool:
        """Whether the state of a block is projected onto a manifold."""
        return any(block.projection is not None for block in self.blocks.values())

    @property
    def calls(self) -> Sequence[TracedCall]:
        """All computations, each after those that it depends on."""
        return self._expressions.calls

    def arguments_of(self, call: TracedCall) -> ca.Function:
        """(time, state, held, parameters) -> the arguments of one computation."""
        return self._function("arguments", list(call.arguments))

    def _function(self, name: str, values: Sequence[ca.SX]) -> ca.Function:
        values = self._expressions.expanded(values)
        return dense_function(name, [self._columns[each] for each in ARGUMENTS], values)
