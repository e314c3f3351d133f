"""The CasADi expressions of a diagram: the functions of its blocks, with connected arguments."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
from pydrake.systems.framework import Context, PortDataType, System

from drake_dae.blocks.computations import (
    HELD,
    NOISE,
    PARAMETERS,
    STATE,
    TIME,
    Computation,
    Computations,
    Traced,
)
from drake_dae.compiler.groups import discrete_states, numeric_parameters
from drake_dae.compiler.primitives import primitive
from drake_dae.compiler.wires import Port, Wires
from drake_dae.errors import ModelError


@dataclass(frozen=True, eq=False)
class TracedCall:
    """A computation of a block, evaluated at symbolic arguments.

    Attributes:
        block: The block.
        computation: The computation.
        arguments, results: Its arguments and results as expressions.
        dependencies: The calls on which the arguments depend.
        computed: The results that are computed here, without those that are passed on.
        is_precomputable: Whether it depends only on time and parameters. Its results are then new
            symbols, so that they can be computed once for all evaluations at one time.
    """

    block: Computations
    computation: Computation
    arguments: tuple[ca.SX, ...]
    results: tuple[ca.SX, ...]
    dependencies: tuple["TracedCall", ...]
    computed: tuple[ca.SX, ...]
    is_precomputable: bool

    @property
    def valid(self) -> ca.SX:
        """An expression that is finite if the results are valid, provided the arguments are."""
        if self.computation.traced is not None:
            return self.results[-1]
        return ca.sum1(ca.vertcat(0, *self.computed))


class Expressions:
    """Traces the expressions of a diagram on request.

    Blocks on which no requested expression depends, such as loggers, are never traced.

    Args:
        wires: The leaf systems and their connections.
        context: A context of the diagram; unconnected input ports with a value in it become
            symbols.
        twins: Plant -> the controller whose law has the plant's system as its model, with equal
            parameters. Both then use the controller's symbols.
        is_short: Whether the derivative of such a plant is computed by `Computations.under` of its
            controller, where the controller is connected directly to the plant.

    Attributes:
        time: The time in s.
        calls: All computations traced until now, each after those that it depends on.
        used: System -> block, for all blocks traced until now.
        precomputed: (symbol, expression) for each value that depends only on time and parameters.
        symbols: (system, STATE, HELD, PARAMETERS, NOISE, or the name of an unconnected input port
            that has a value) -> its symbols.
        inputs: Name of an external input, where a connection is cut -> its symbols.

    Raises:
        ModelError: A block cannot be traced.
    """

    def __init__(
        self,
        wires: Wires,
        context: Context,
        twins: Mapping[System, System] | None = None,
        is_short: bool = False,
    ) -> None:
        self.time = ca.SX.sym("time")
        self.calls: list[TracedCall] = []
        self.used: dict[System, Computations] = {}
        self.precomputed: list[tuple[ca.SX, ca.SX]] = []
        self.symbols: dict[tuple[System, str], ca.SX] = {}
        self._wires, self._context, self._twins = wires, context, dict(twins or {})
        self._calls: dict[tuple[System, Computation], TracedCall] = {}
        self._open: list[tuple[System, Computation]] = []
        # The calls on which each expression under construction depends; the innermost is last.
        self._dependencies: list[dict[int, TracedCall]] = []
        self._under: dict[System, tuple[Computations, Computation]] = {}
        cut = {name: system.get_output_port(i) for name, (system, i) in wires.inputs.items()}
        self.inputs = {name: ca.SX.sym(name, port.size()) for name, port in cut.items()}
        self._cut = {(p.get_system(), p.get_name()): self.inputs[n] for n, p in cut.items()}
        for plant, controller in self._twins.items() if is_short else ():
            self._shorten(plant, self.block(controller))

    def block(self, system: System) -> Computations:
        """The block of a system: its computations and updates."""
        if system not in self.used:
            self.used[system] = system.traced() if isinstance(system, Traced) else primitive(system)
        return self.used[system]

    def port(self, port: Port) -> ca.SX:
        """The expression of an output port.

        Raises:
            ModelError: It cannot be traced, or belongs to an algebraic loop.
        """
        system, index = port
        return self.output(system, system.get_output_port(index).get_name())

    def output(self, system: System, name: str) -> ca.SX:
        """The expression of a block's output, or of its DERIVATIVE; raises as `port` does."""
        if (system, name) in self._cut:
            return self._cut[system, name]
        block = self.block(system)
        computation = next((each for each in block.computations if name in each.outputs), None)
        if computation is None:
            raise ModelError(
                f"the output port '{name}' of '{system.get_name()}' cannot be traced. What depends "
                "on it only runs in Drake's Simulator"
            )
        if system in self._under and name in self._under[system][1].outputs:
            block, computation = self._under[system]
        return self.call(block, computation).results[computation.outputs.index(name)]

    def call(self, block: Computations, computation: Computation) -> TracedCall:
        """A computation evaluated at the expressions of its sources; raises as `port` does."""
        key = block.system, computation
        if key in self._calls:
            self._add_dependency(self._calls[key])
            return self._calls[key]
        if key in self._open:
            names = [system.get_name() for system, _ in self._open[self._open.index(key) :]]
            raise ModelError(
                f"the diagram has an algebraic loop: {' -> '.join([*names, names[0]])}. Insert a "
                "block with state, such as a sensor or a filter"
            )
        self._open.append(key)
        self._dependencies.append({})
        arguments = [self.source(block, name) for name in computation.sources]
        self._open.pop()
        dependencies = tuple(self._dependencies.pop().values())
        results = computation.function.call(arguments)
        is_passed_on = [result.is_valid_input() for result in results]
        is_precomputable = not {STATE, HELD, NOISE} & set(computation.sources) and all(
            call.is_precomputable for call in dependencies
        )
        if is_precomputable:
            results = [self._precomputed(result) for result in results]
        call = TracedCall(
            block,
            computation,
            tuple(arguments),
            tuple(results),
            dependencies,
            tuple(result for result, old in zip(results, is_passed_on, strict=True) if not old),
            is_precomputable,
        )
        self._calls[key] = call
        self.calls.append(call)
        self._add_dependency(call)
        return call

    def _precomputed(self, value: ca.SX) -> ca.SX:
        """New symbols for a value that depends only on time and parameters."""
        value = self.expanded([value])[0]
        symbol = ca.SX.sym("given", value.sparsity())
        self.precomputed.append((symbol, value))
        return symbol

    def expanded(self, values: Sequence[ca.SX]) -> list[ca.SX]:
        """Expressions in which the symbols of `precomputed` are replaced by their expressions."""
        if not self.precomputed:
            return list(values)
        symbols, meanings = zip(*self.precomputed, strict=True)
        expanded: list[ca.SX] = ca.substitute(list(values), list(symbols), list(meanings))
        return expanded

    def given_column(self) -> tuple[ca.SX, ca.SX, Callable[[Sequence[ca.SX]], list[ca.SX]]]:
        """The distinct symbols of `precomputed`, their expressions, and a substitution function.

        The substitution function replaces duplicate symbols by the first equal one, and symbols of
        constants and plain parameters by these. Plant and law often share references and
        time-varying parameters; only with equal symbols does CasADi recognize that both compute
        the same values.
        """
        values = ca.cse(ca.vertcat(ca.SX(0, 1), *(ca.vec(value) for _, value in self.precomputed)))
        symbols = ca.vertcat(ca.SX(0, 1), *(ca.vec(symbol) for symbol, _ in self.precomputed))
        first: dict[int, int] = {}
        replacements = ca.SX(symbols)
        for i in range(values.numel()):
            value = values[i]
            is_plain = value.is_constant() or value.is_symbolic()
            replacements[i] = (
                value if is_plain else symbols[first.setdefault(value.element_hash(), i)]
            )
        distinct = list(first.values())

        def substituted(expressions: Sequence[ca.SX]) -> list[ca.SX]:
            results: list[ca.SX] = ca.substitute(list(expressions), [symbols], [replacements])
            return results

        return symbols[distinct], values[distinct], substituted

    def _add_dependency(self, call: TracedCall) -> None:
        """Records that the expression under construction depends on a call."""
        if self._dependencies:
            self._dependencies[-1] |= {id(each): each for each in (*call.dependencies, call)}

    def checked(self, trace: Callable[[], Sequence[ca.SX]]) -> tuple[ca.SX, ca.SX]:
        """The expressions that a function traces, stacked, and their validity."""
        self._dependencies.append({})
        value = ca.vertcat(ca.SX(0, 1), *trace())
        calls = self._dependencies.pop().values()
        return value, sum((call.valid for call in calls), ca.SX(0))

    def source(self, block: Computations, name: str) -> ca.SX:
        """The expression of an argument of a block's computation."""
        system = block.system
        if name == TIME:
            return self.time
        if name == PARAMETERS:
            return self.parameters(block)
        if name == HELD and block.stepped is not None:
            return self.symbol(system, HELD, block.stepped.size)
        if name in (STATE, HELD, NOISE):
            return self.symbol(system, name, self._size(system, name))
        if system.HasInputPort(name):
            return self.input(block, name)
        return self.output(system, name)

    def input(self, block: Computations, name: str) -> ca.SX:
        """The expression of an input port.

        Raises:
            ModelError: The port has neither a connection nor a value.
        """
        system = block.system
        port, source = system.GetInputPort(name), self._source(system, name)
        if source is not None:
            return self.port(source)
        if port.HasValue(self._local(system)):
            return self.symbol(system, name, port.size())
        law = self._law_behind(system)
        if law is not None and law.HasOutputPort(name):
            return self.output(law, name)
        if name in block.unwired:
            return self.call(block, block.unwired[name]).results[0]
        if not port.size():
            return ca.SX(0, 1)
        raise ModelError(
            f"the input port '{name}' of '{system.get_name()}' has neither a connection nor a "
            "value. Connect it, or fix its value in the context"
        )

    def parameters(self, block: Computations) -> ca.SX:
        """The numeric parameters of a block; the time-varying ones are those of its input port."""
        system = block.system
        size = self._size(system, PARAMETERS)
        parameters = self.symbol(system, PARAMETERS, size)
        if (twin := self._twins.get(system)) is not None:
            parameters = self.symbol(twin, PARAMETERS, self._size(twin, PARAMETERS))[:size]
        if block.moving and system.HasInputPort("exogenous"):
            port = system.GetInputPort("exogenous")
            if self._source(system, "exogenous") is not None or port.HasValue(self._local(system)):
                parameters = ca.SX(parameters)
                parameters[list(block.moving)] = self.input(block, "exogenous")
        return parameters

    def _shorten(self, plant: System, controller: Computations) -> None:
        """Replaces a plant's derivative by `under` of a directly connected controller."""
        if controller.under is None or not plant.HasInputPort("control"):
            return
        source = self._source(plant, "control")
        port = controller.system.GetOutputPort("control")
        is_direct = source == (controller.system, int(port.get_index()))
        if source is None and not plant.GetInputPort("control").HasValue(self._local(plant)):
            is_direct = self._law_behind(plant) is controller.system
        under = controller.under() if is_direct else None
        if under is not None:
            self._under[plant] = controller, under

    def _source(self, system: System, name: str) -> Port | None:
        """The output port that an input port is connected to; None if it is unconnected."""
        index = int(system.GetInputPort(name).get_index())
        return self._wires.sources.get((system, index))

    def _local(self, system: System) -> Context:
        return system.GetMyContextFromRoot(self._context)

    def symbol(self, system: System, name: str, size: int) -> ca.SX:
        """The symbols of a column of a block, such as its state."""
        key = system, name
        if key not in self.symbols:
            self.symbols[key] = ca.SX.sym(f"{system.get_name()}_{name.strip('$')}", size)
        return self.symbols[key]

    def _law_behind(self, system: System) -> System | None:
        """The block connected to an abstract-valued input port, which provides the law."""
        for index in range(system.num_input_ports()):
            is_abstract = (
                system.get_input_port(index).get_data_type() == PortDataType.kAbstractValued
            )
            if is_abstract and (source := self._wires.sources.get((system, index))) is not None:
                return source[0]
        return None

    def _size(self, system: System, name: str) -> int:
        """The number of entries of a column of a block."""
        context = self._local(system)
        if name == STATE:
            return int(context.num_continuous_states())
        groups = numeric_parameters if name == PARAMETERS else discrete_states
        return sum(group.size for group in groups(context))
