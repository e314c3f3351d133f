"""What a compiled diagram holds: its columns, its functions, and how values stand in them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import casadi as ca
import numpy as np
from pydrake.systems.framework import Context, Diagram, System

from drake_dae.arrays import FloatArray
from drake_dae.compiler.rates import ColumnPlace, UpdateRate, dense_function
from drake_dae.compiler.trace import Expressions, TracedCall
from drake_dae.compiler.wires import Wires
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError
from drake_dae.systems.blocks.traced import HELD, Block

ARGUMENTS = ("time", "state", "held", "parameters")
"""What the functions of a diagram take; an update takes new random numbers, "noise", as well."""


@dataclass(frozen=True, eq=False)
class CompiledDiagram:
    """A diagram as functions of the time, its state, what it holds, and its parameters.

    Attributes:
        wires: The diagram and its wires.
        context: A context in which inputs without a wire have values.
        outputs: The names of the output ports of the diagram that are computed.
        states, held, parameters, noise: Where the columns of each block stand.
        fixed: The input ports without a wire whose values are parameters: (system, name, part).
        inputs: The inputs of a part of a diagram, among the parameters: (name, part).
        rates: The updates, one function for each period and offset.
        blocks: The blocks by their systems, in the order of Drake's states.
        guards: Where the margins of each block stand that changes at moments which a run finds.
        watched: The same of blocks that look at their guards in samples.
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
    blocks: Mapping[System, Block]
    guards: tuple[ColumnPlace, ...]
    watched: tuple[ColumnPlace, ...]
    _expressions: Expressions = field(repr=False)
    _columns: Mapping[str, ca.SX] = field(repr=False)
    _asked: Mapping[str, Sequence[ca.SX]] = field(repr=False)

    @property
    def diagram(self) -> Diagram:
        """The diagram."""
        return self.wires.diagram

    @cached_property
    def sizes(self) -> dict[str, int]:
        """How many entries each argument of the functions has."""
        return {name: int(column.numel()) for name, column in self._columns.items()}

    @cached_property
    def rate(self) -> ca.Function:
        """(time, state, held, parameters) -> the derivative of the state, shape (n,), and validity.

        The second value is a number that is finite if the first is of use.
        """
        return self._function("rate", self._asked["rate"])

    @cached_property
    def row(self) -> ca.Function:
        """(time, state, held, parameters) -> all outputs below each other, and validity."""
        return self._function("row", self._asked["row"])

    @cached_property
    def guard(self) -> ca.Function:
        """(time, state, held, parameters) -> margins, gaps, their rates, and validity.

        See `Guard`; those of all blocks stand below each other. Only where there are guards.
        """
        return self._function("guard", self._asked["guard"])

    @cached_property
    def watch(self) -> ca.Function:
        """The same of the guards that are looked at in samples. Only where there are such."""
        return self._function("watch", self._asked["watch"])

    @property
    def watched_rates(self) -> int:
        """The rates at whose samples blocks look at their guards, as bits."""
        found = 0
        for system, _ in self.watched:
            for update in self.blocks[system].updates:
                key = update.period, update.offset, update.is_unrestricted
                keys = [(rate.period, rate.offset, rate.is_unrestricted) for rate in self.rates]
                found |= 1 << keys.index(key)
        return found

    @property
    def changes(self) -> bool:
        """Whether blocks change at moments that a run has to find, by guards."""
        return bool(self.guards or self.watched)

    @cached_property
    def staged(self) -> Mapping[str, ca.Function]:
        """Name -> function, for who computes what the time alone determines once for each time.

        "given" is (time, parameters) -> a column; "rate", "row", "newton", "update_0", ...,
        "guard" and "watch" are as the functions of the same names, and take this column after the
        parameters.
        """
        functions = {**self._asked, "newton": self._newton(1)}
        column, values, meant = self._expressions.given_column()
        given = [self._columns["time"], self._columns["parameters"]]
        found = {"given": dense_function("given", given, [values])}
        for name, asked in functions.items():
            arguments = [*(self._columns[each] for each in ARGUMENTS), column]
            if name.startswith("update"):
                arguments.append(self._columns["noise"])
            found[name] = dense_function(name, arguments, meant(asked))
        return found

    @cached_property
    def scale(self) -> FloatArray:
        """The sizes of the states, shape (n,)."""
        found = np.ones(self.sizes["state"])
        for system, part in self.states:
            scale = self.blocks[system].scale
            if scale is not None:
                found[part] = scale
        return found

    def start(self, context: Context) -> tuple[FloatArray, FloatArray]:
        """The state and what is held in a context of the diagram, shapes (n,) and (k,)."""
        state, held = np.zeros(self.sizes["state"]), np.zeros(self.sizes["held"])
        for system, part in self.states:
            own = system.GetMyContextFromRoot(context)
            state[part] = own.get_continuous_state_vector().CopyToVector()
        for system, part in self.held:
            own, stepped = system.GetMyContextFromRoot(context), self.blocks[system].stepped
            values = [own.get_discrete_state(i).value() for i in range(_groups(own))]
            if stepped is not None:
                values = [stepped.held(own)]
            held[part] = np.concatenate(values)
        return state, held

    def put(
        self,
        context: Context,
        time: float,
        state: FloatArray,
        held: FloatArray,
        parameters: FloatArray,
    ) -> None:
        """Puts into a context of the diagram what its functions take."""
        context.SetTime(time)
        for system, part in self.states:
            system.GetMyMutableContextFromRoot(context).SetContinuousState(state[part])
        for system, part in self.held:
            own, first = system.GetMyMutableContextFromRoot(context), part.start
            for i in range(own.num_discrete_state_groups()):
                last = first + own.get_discrete_state(i).size()
                own.SetDiscreteState(i, held[first:last])
                first = last
        for system, part in self.parameters:
            own, first = system.GetMyMutableContextFromRoot(context), part.start
            for i in range(own.num_numeric_parameter_groups()):
                last = first + own.get_numeric_parameter(i).size()
                own.get_mutable_numeric_parameter(i).SetFromVector(parameters[first:last])
                first = last
        for system, name, part in self.fixed:
            own = system.GetMyMutableContextFromRoot(context)
            system.GetInputPort(name).FixValue(own, parameters[part])

    def begun(
        self, time: float, state: FloatArray, held: FloatArray, parameters: FloatArray
    ) -> FloatArray:
        """What is held when a run begins: what is not a number yet, as its block says."""
        found = held.copy()
        for part, initial in self._initial:
            if np.isnan(found[part]).any():
                found[part] = initial(time, state, held, parameters).full()[:, 0]
        return found

    @cached_property
    def _initial(self) -> list[tuple[slice, ca.Function]]:
        """What blocks hold when a run begins, where that is not a number."""
        found = []
        for system, part in self.held:
            initial = self.blocks[system].initial
            if initial is not None:
                call = self._expressions.call(self.blocks[system], initial)
                value = call.results[initial.outputs.index(HELD)]
                found.append((part, self._function("initial", [value])))
        return found

    def begin(self, held: FloatArray) -> ca.Function | None:
        """(time, state, held, parameters) -> what is held when a run begins; None if `held` is.

        Args:
            held: What is held before, not a number where a block says what it is.
        """
        columns = [self._columns["held"][part] for _, part in self.held]
        for number, (system, part) in enumerate(self.held):
            initial = self.blocks[system].initial
            if initial is not None and np.isnan(held[part]).any():
                call = self._expressions.call(self.blocks[system], initial)
                columns[number] = call.results[initial.outputs.index(HELD)]
        if all(np.isfinite(held)):
            return None
        return self._function("begin", [ca.vertcat(*columns)])

    def values(self, context: Context) -> FloatArray:
        """The parameters in a context of the diagram, shape (m,).

        Raises:
            ModelError: An input port without a wire has no value in this context.
        """
        found = np.zeros(self.sizes["parameters"])
        for system, part in self.parameters:
            own = system.GetMyContextFromRoot(context)
            groups = range(own.num_numeric_parameter_groups())
            found[part] = np.concatenate([own.get_numeric_parameter(i).value() for i in groups])
        for system, name, part in self.fixed:
            own, port = system.GetMyContextFromRoot(context), system.GetInputPort(name)
            if not port.HasValue(own):
                raise ModelError(
                    f"the input port '{name}' of '{system.get_name()}' has no value in this context"
                )
            found[part] = port.Eval(own)
        for name, part in self.inputs:
            system, index = self.wires.inputs[name]
            found[part] = system.get_output_port(index).Eval(system.GetMyContextFromRoot(context))
        return found

    @cached_property
    def twins(self) -> Mapping[System, System]:
        """Plant -> the controller whose law has the plant's system as its model."""
        laws = {
            id(block.model): system
            for system, block in self.blocks.items()
            if block.under is not None
        }
        return {
            system: laws[id(block.model)]
            for system, block in self.blocks.items()
            if block.under is None and block.model is not None and id(block.model) in laws
        }

    def have_twins(self, parameters: FloatArray) -> np.ndarray:
        """In which rows plants and laws that have one model have the same numbers, too, shape (k,).

        Args:
            parameters: As `values` returns them, a row for each run, shape (k, m).
        """
        parts = dict(self.parameters)
        found = np.full(len(parameters), bool(self.twins))
        for plant, controller in self.twins.items():
            own, of_law = parts.get(plant, slice(0, 0)), parts[controller]
            size = own.stop - own.start
            same = parameters[:, own] == parameters[:, of_law][:, :size]
            same[:, list(self.blocks[plant].moving)] = True
            found &= same.all(axis=1)
        return found

    @cached_property
    def moved_parameters(self) -> Mapping[System, ca.Function]:
        """Plant with moving parameters -> (time, state, held, parameters) -> all of its own."""
        return {
            system: self._function("parameters", [self._expressions.parameters(block)])
            for system, block in self.blocks.items()
            if block.check_start is not None and block.moving
        }

    def newton(self, count: int) -> ca.Function:
        """(time, state, held, parameters) -> the state after Newton steps to its manifolds.

        With the length of the last step, in states over their scale. Gradients of all are those at
        the start.

        Args:
            count: How many steps.
        """
        return self._function("newton", self._newton(count))

    def _newton(self, count: int) -> list[ca.SX]:
        state = ca.SX(self._columns["state"])
        left = ca.SX(0.0)
        for system, part in self.states:
            projection = self.blocks[system].projection
            if projection is None:
                continue
            block = self.blocks[system]
            given = self._expressions.parameters(block), self._expressions.source(block, HELD)
            x = start = self._columns["state"][part]
            for _ in range(count):
                change = projection.newton(x, start, *given)
                x, left_here = x + ca.DM(projection.scale) * change, ca.norm_2(change)
            state[part], left = x, ca.fmax(left, left_here) if left.nnz() else left_here
        return [state, left]

    @property
    def signals(self) -> dict[str, tuple[Signal, ...]]:
        """Name of an output -> names and units of its entries, as far as its block tells them."""
        found = {}
        for name in self.outputs:
            system, index = self.wires.outputs[name]
            port = system.get_output_port(index)
            known = self.blocks[system].ports.get(port.get_name())
            found[name] = known or tuple(Signal(f"{name}[{i}]") for i in range(port.size()))
        return found

    @property
    def has_stepped(self) -> bool:
        """Whether Drake steps one of the blocks, which is not traced."""
        return bool(self.rates) and self.rates[-1].stepped is not None

    @property
    def stepped(self) -> tuple[UpdateRate, Block]:
        """The steps of the block that Drake runs, and this block; only where there is one."""
        rate = self.rates[-1]
        assert rate.stepped is not None
        return rate, rate.stepped

    @property
    def projects(self) -> bool:
        """Whether a block has a manifold that its state is brought to."""
        return any(block.projection is not None for block in self.blocks.values())

    @property
    def calls(self) -> Sequence[TracedCall]:
        """All that is computed, each after what it needs."""
        return self._expressions.calls

    def arguments_of(self, call: TracedCall) -> ca.Function:
        """(time, state, held, parameters) -> the arguments of a computation."""
        return self._function("arguments", list(call.arguments))

    def _function(self, name: str, values: Sequence[ca.SX]) -> ca.Function:
        values = self._expressions.expanded(values)
        return dense_function(name, [self._columns[each] for each in ARGUMENTS], values)


def _groups(context: Context) -> int:
    return int(context.num_discrete_state_groups())
