"""The expressions of a diagram: each block's, with what its wires bring put in."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
from pydrake.systems.framework import Context, PortDataType, System

from drake_dae.compiler.primitives import primitive
from drake_dae.compiler.wires import Port, Wires
from drake_dae.errors import ModelError
from drake_dae.systems.blocks.traced import (
    DERIVATIVE,
    HELD,
    NOISE,
    PARAMETERS,
    STATE,
    TIME,
    Block,
    Computation,
    Traced,
)


@dataclass(frozen=True, eq=False)
class TracedCall:
    """A computation with its arguments put in.

    Attributes:
        block: Whose it is.
        computation: What is computed.
        arguments: Its arguments as expressions.
        results: Its results as expressions.
        needed: The calls that the arguments need.
        made: Those of its results that are computed here, and not only passed on.
        is_given: Whether it needs the time and parameters alone. Its results are then symbols of
            their own, so that they can be computed once for all that happens at a time.
        gate: What is finite if that is of use which its computation chooses, see `Computation`.
    """

    block: Block
    computation: Computation
    arguments: tuple[ca.SX, ...]
    results: tuple[ca.SX, ...]
    needed: tuple["TracedCall", ...]
    made: tuple[ca.SX, ...]
    is_given: bool
    gate: ca.SX

    @property
    def valid(self) -> ca.SX:
        """Finite if the results are valid; values that are passed on were checked before."""
        if self.computation.traced is not None:
            return self.results[-1]
        return ca.sum1(ca.vertcat(self.gate, *self.made))


class Expressions:
    """The expressions of a diagram, found as they are asked for.

    A block that nothing asked for leads to is none of them, such as a logger.

    Args:
        wires: The wires.
        context: A context of the diagram, which says where inputs without a wire have a value.
        twins: Plant -> the controller whose law has it as its model, with the same numbers. Both
            then have the parameters of the controller.
        is_short: Whether the derivative of such a plant follows from what its law wants, where the
            law says how and nothing stands between.

    Attributes:
        time: The time in s.
        calls: All computations so far, each after those that it needs.
        used: The blocks so far, by their systems.
        given: Each symbol of what the time and parameters alone determine, with its expression.
        symbols: (system, STATE, HELD, PARAMETERS, NOISE, or the name of an input port with a fixed
            value) -> its symbols.
        inputs: Name of an input, where wires are cut -> its symbols.

    Raises:
        ModelError: A block cannot be traced; its name and why.
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
        self.used: dict[System, Block] = {}
        self.given: list[tuple[ca.SX, ca.SX]] = []
        self.symbols: dict[tuple[System, str], ca.SX] = {}
        self._wires, self._context, self._twins = wires, context, dict(twins or {})
        self._found: dict[tuple[System, Computation], TracedCall] = {}
        self._open: list[tuple[System, Computation]] = []
        self._needed: list[dict[int, TracedCall]] = []
        self._owners: dict[System, dict[str, Computation]] = {}
        self._under: dict[System, tuple[Block, Computation]] = {}
        cut = {name: each.get_output_port(i) for name, (each, i) in wires.inputs.items()}
        self.inputs = {name: ca.SX.sym(name, port.size()) for name, port in cut.items()}
        self._cut = {(p.get_system(), p.get_name()): self.inputs[n] for n, p in cut.items()}
        for plant, controller in self._twins.items() if is_short else ():
            self._shorten(plant, self.block(controller))

    def block(self, system: System) -> Block:
        """What a system computes."""
        if system not in self.used:
            found = system.traced() if isinstance(system, Traced) else primitive(system)
            self.used[system] = found
            self._owners[system] = {
                name: one for one in found.computations for name in one.outputs if name
            }
        return self.used[system]

    def port(self, port: Port) -> ca.SX:
        """What an output port shows.

        Raises:
            ModelError: It cannot be traced, or depends on itself in the same instant.
        """
        system, index = port
        return self.output(system, system.get_output_port(index).get_name())

    def output(self, system: System, name: str) -> ca.SX:
        """An output of a block, or its derivative; errors as of `port`."""
        if (system, name) in self._cut:
            return self._cut[system, name]
        block = self.block(system)
        computation = self._owners[system].get(name)
        if computation is None:
            raise ModelError(
                f"the output port '{name}' of '{system.get_name()}' cannot be traced, so that "
                "what it leads to runs in Drake's Simulator alone"
            )
        owner = block
        if DERIVATIVE in computation.outputs and system in self._under:
            owner, computation = self._under[system]
        found = self.call(owner, computation)
        return found.results[computation.outputs.index(name)]

    def call(self, block: Block, computation: Computation) -> TracedCall:
        """A computation with its arguments put in; errors as of `port`."""
        key = block.system, computation
        if key in self._found:
            self._note(self._found[key])
            return self._found[key]
        if key in self._open:
            names = [each.get_name() for each, _ in self._open[self._open.index(key) :]]
            raise ModelError(
                f"the diagram has an algebraic loop: {' -> '.join([*names, names[0]])}; put a "
                "block with state between, as a sensor or a filter"
            )
        self._open.append(key)
        self._needed.append({})
        chosen: dict[str, ca.SX] = {}
        arguments = []
        for name in computation.sources:
            if computation.choice is not None and name in computation.choice[1:]:
                self._needed.append({})
                arguments.append(self.source(block, name))
                inner = self._needed.pop().values()
                chosen[name] = sum((one.valid for one in inner), ca.SX(0))
            else:
                arguments.append(self.source(block, name))
        self._open.pop()
        needed = tuple(self._needed.pop().values())
        gate = ca.SX(0)
        if computation.choice is not None:
            flag, one, other = computation.choice
            is_one = arguments[computation.sources.index(flag)] > 0.5
            gate = ca.if_else(is_one, chosen[one], chosen[other])
        results = computation.function.call(arguments)
        is_passed_on = [result.is_valid_input() for result in results]
        is_given = not {STATE, HELD, NOISE} & set(computation.sources)
        is_given = is_given and not chosen and all(one.is_given for one in needed)
        if is_given:
            results = [self._named(result) for result in results]
        made = tuple(one for one, old in zip(results, is_passed_on, strict=True) if not old)
        given = block, computation, tuple(arguments), tuple(results), needed, made
        found = TracedCall(*given, is_given, gate)
        self._found[key] = found
        self.calls.append(found)
        self._note(found)
        return found

    def _named(self, value: ca.SX) -> ca.SX:
        """Symbols for a value that the time and parameters alone determine."""
        value = self.expanded([value])[0]
        symbol = ca.SX.sym("given", value.sparsity())
        self.given.append((symbol, value))
        return symbol

    def expanded(self, values: Sequence[ca.SX]) -> list[ca.SX]:
        """Expressions in which no symbol of `given` is left."""
        if not self.given:
            return list(values)
        symbols, meant = zip(*self.given, strict=True)
        found: list[ca.SX] = ca.substitute(list(values), list(symbols), list(meant))
        return found

    def given_column(self) -> tuple[ca.SX, ca.SX, Callable[[Sequence[ca.SX]], list[ca.SX]]]:
        """Symbols of `given`, each value once; their values; and what puts them in expressions.

        Constants and parameters that stand there as they are come without a symbol.

        Plant and law often have the same references and the same moving parameters: only where
        these are the same symbols, what both compute from them is found to be the same.
        """
        values = ca.cse(ca.vertcat(ca.SX(0, 1), *(ca.vec(value) for _, value in self.given)))
        symbols = ca.vertcat(ca.SX(0, 1), *(ca.vec(symbol) for symbol, _ in self.given))
        first: dict[int, int] = {}
        meant = ca.SX(symbols)
        for i in range(values.numel()):
            value = values[i]
            is_plain = value.is_constant() or value.is_symbolic()
            meant[i] = value if is_plain else symbols[first.setdefault(value.element_hash(), i)]
        chosen = list(first.values())

        def put_in(asked: Sequence[ca.SX]) -> list[ca.SX]:
            found: list[ca.SX] = ca.substitute(list(asked), [symbols], [meant])
            return found

        return symbols[chosen], values[chosen], put_in

    def _note(self, found: TracedCall) -> None:
        """Keeps that what is being computed needs a call, and what that needs."""
        if self._needed:
            self._needed[-1] |= {id(one): one for one in (*found.needed, found)}

    def checked(self, ask: Callable[[], Sequence[ca.SX]]) -> tuple[ca.SX, ca.SX]:
        """Some expressions below each other, and what is finite if they are of use.

        Args:
            ask: What asks for them.
        """
        self._needed.append({})
        value = ca.vertcat(ca.SX(0, 1), *ask())
        needed = self._needed.pop().values()
        valid = sum((call.valid for call in needed), ca.SX(0))
        return value, valid

    def source(self, block: Block, name: str) -> ca.SX:
        """An argument of a computation of a block."""
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

    def input(self, block: Block, name: str) -> ca.SX:
        """What stands at an input port.

        Raises:
            ModelError: It has neither a wire nor a value.
        """
        system = block.system
        port = system.GetInputPort(name)
        source = self._wires.sources.get((system, int(port.get_index())))
        if source is not None:
            return self.port(source)
        if port.HasValue(system.GetMyContextFromRoot(self._context)):
            return self.symbol(system, name, port.size())
        law = self._law_behind(system)
        if law is not None and law.HasOutputPort(name):
            return self.output(law, name)
        if name in block.unwired:
            found = self.call(block, block.unwired[name])
            return found.results[0]
        if not port.size():
            return ca.SX(0, 1)
        raise ModelError(
            f"the input port '{name}' of '{system.get_name()}' has neither a wire nor a value; "
            "connect it, or fix its value in the context"
        )

    def parameters(self, block: Block) -> ca.SX:
        """The numeric parameters of a block, those that move as their wire says."""
        system = block.system
        twin = self._twins.get(system)
        size = self._size(system, PARAMETERS)
        found = self.symbol(system, PARAMETERS, size)
        if twin is not None:
            found = self.symbol(twin, PARAMETERS, self._size(twin, PARAMETERS))[:size]
        if block.moving and system.HasInputPort("exogenous"):
            port = system.GetInputPort("exogenous")
            index = int(port.get_index())
            if (system, index) in self._wires.sources or port.HasValue(
                system.GetMyContextFromRoot(self._context)
            ):
                found = ca.SX(found)
                found[list(block.moving)] = self.input(block, "exogenous")
        return found

    def _shorten(self, plant: System, controller: Block) -> None:
        """Lets a plant's derivative follow from what its law wants, where it acts as it is."""
        if not plant.HasInputPort("control"):
            return
        port = plant.GetInputPort("control")
        source = self._wires.sources.get((plant, int(port.get_index())))
        acts = controller.system, int(controller.system.GetOutputPort("control").get_index())
        is_direct = source == acts
        if source is None and not port.HasValue(plant.GetMyContextFromRoot(self._context)):
            is_direct = self._law_behind(plant) is controller.system
        under = controller.under() if is_direct and controller.under is not None else None
        if under is not None:
            self._under[plant] = controller, under

    @property
    def is_shortened(self) -> bool:
        """Whether the derivative of a plant follows from what its law wants."""
        return bool(self._under)

    def symbol(self, system: System, name: str, size: int) -> ca.SX:
        """The symbols of a block's own column."""
        key = system, name
        if key not in self.symbols:
            self.symbols[key] = ca.SX.sym(f"{system.get_name()}_{name.strip('$')}", size)
        return self.symbols[key]

    def _law_behind(self, system: System) -> System | None:
        """The block whose law comes through an abstract wire, in place of a value without one."""
        for index in range(system.num_input_ports()):
            if system.get_input_port(index).get_data_type() == PortDataType.kAbstractValued:
                source = self._wires.sources.get((system, index))
                if source is not None:
                    return source[0]
        return None

    def _size(self, system: System, name: str) -> int:
        """How many entries a block's own column has."""
        context = system.GetMyContextFromRoot(self._context)
        if name == STATE:
            return int(context.num_continuous_states())
        if name == PARAMETERS:
            count = context.num_numeric_parameter_groups()
            return sum(context.get_numeric_parameter(i).size() for i in range(count))
        count = context.num_discrete_state_groups()
        return sum(context.get_discrete_state(i).size() for i in range(count))
