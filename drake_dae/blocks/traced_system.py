"""A block as a LeafSystem of Drake, on floats, AutoDiffXd and symbolic expressions."""

from collections.abc import Callable, Mapping
from functools import partial
from operator import add, methodcaller, mul, pow, sub, truediv
from typing import Any
from weakref import proxy

import casadi as ca
import numpy as np
import pydrake.symbolic as sym
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.systems.framework import (
    BasicVector_,
    Context,
    ContinuousState,
    EventStatus,
    InputPort,
    LeafSystem,
    LeafSystem_,
    OutputPort,
    PortDataType,
    State,
    System,
    SystemScalarConverter,
)

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, listed
from drake_dae.blocks.block import Block, BlockFunction, is_same, stacked
from drake_dae.blocks.failures import StepWatch, off_manifold, simulation_error
from drake_dae.blocks.lifetime import SHARED_DICTIONARY, weakly
from drake_dae.errors import InconsistentStateError, ModelError, SimulationError
from drake_dae.trace.compiled import Compiled

Reader = Callable[[Context], Any]
"""Reads a column of a block from a context."""

Evaluate = Callable[[Context], Any]
"""Returns some values of a block in a context."""

_CHANGED, _UNCHANGED = EventStatus.Succeeded(), EventStatus.DidNothing()


@checked(ModelError)
class TracedSystem(LeafSystem):
    """A `Block` as a LeafSystem: its ports, states, parameters and updates.

    Each output port depends on exactly what its expression depends on. Held values change at their
    samples; those that are an output as they stand are copied by Drake. The state is projected
    after each accepted step, as a per-step event, which Drake makes at the start of the next step:
    a log or a monitor sees the state before it.

    In a trial state of an integrator a value that is not valid is nan, so that error control takes
    a shorter step. At an accepted state, or if no step is short enough, it is an error with time,
    state and the requirement that did not hold.

    It converts to AutoDiffXd, by exact Jacobians of the same expressions, and to symbolic
    expressions where the block has no `requirements`. A converted system has no projection, and its
    updates are discrete ones, which Linearize knows.

    Args:
        block: The block.
        compiled: Whether functions that are called often become machine code.
        sees_steps: Whether trial states are told from accepted ones; by default if it has a
            continuous state.

    Attributes:
        block: The block.
        equations: The DaeSystem that plant and law may share; None if there is none.
        is_law: Whether it is a law for `equations`, and not a plant with these equations.

    Raises:
        ModelError: Sizes of the block do not fit, or an expression depends on another symbol.
        SingularityError: A matrix that must be regular is singular during a run.
        NonFiniteError: A value is not finite during a run.
        SimulationError: A value does not exist, or the state cannot be projected, during a run.
    """

    __slots__ = SHARED_DICTIONARY
    equations: object = None
    is_law = False

    def __init__(
        self, block: Block, *, compiled: Compiled = False, sees_steps: bool | None = None
    ) -> None:
        block.check()
        converter = SystemScalarConverter()
        for scalar, kind in _CONVERTED.items():
            converter._AddConstructor[scalar, float](partial(_convert, kind))
        super().__init__(converter)
        self.block, self.compiled = block, compiled
        self._watches = bool(block.state.numel()) if sees_steps is None else sees_steps
        self._steps = StepWatch(self, self._watches)
        _declare(self, float, partial(_by_numbers, proxy(self)))
        if block.projection is not None:
            values = {"parameters": block.projection.parameters}
            self._projected_by = _by_numbers(proxy(self), "parameters", values, self._readers)
            self.DeclarePerStepUnrestrictedUpdateEvent(weakly(self._project))
        if any(held.begin is not None for held in block.held.values()):
            begin = {n: h.begin for n, h in block.held.items() if h.begin is not None}
            evaluate = _by_numbers(proxy(self), "start", begin, self._readers)
            places = [list(block.held).index(name) for name in begin]
            self.DeclareInitializationUnrestrictedUpdateEvent(weakly(self._begin, evaluate, places))

    def __repr__(self) -> str:
        inputs = [self.get_input_port(i) for i in range(self.num_input_ports())]
        outputs = [self.get_output_port(i) for i in range(self.num_output_ports())]
        ports = [
            f"{kind}={listed([_shown(port) for port in some])}"
            for kind, some in (("inputs", inputs), ("outputs", outputs))
        ]
        return f"{type(self).__name__}('{self.get_name()}', {', '.join(ports)})"

    def check_context(self, context: Context) -> None:
        """Refuses the context of another system, by a ModelError."""
        check_context(self, context)

    def DoCalcTimeDerivatives(self, context: Context, derivatives: ContinuousState) -> None:
        if self._derivative is not None:  # In a diagram Drake asks also where there is no state.
            derivatives.SetFromVector(self._derivative(context)[0])

    def ToAutoDiffXd(self) -> LeafSystem_[AutoDiffXd]:
        # Drake's own method would wrap it and rename its ports.
        return _convert(_CONVERTED[AutoDiffXd], self)

    def ToSymbolic(self) -> LeafSystem_[sym.Expression]:
        return _convert(_CONVERTED[sym.Expression], self)

    def begin_run(self, context: Context) -> None:
        """Begins a run from a context without initialization events, which would do this."""
        if self._watches:
            self._steps.begin(context)

    def motion(self) -> ca.SX | None:
        """x' of a plant that is the law's own `equations`, in fewer operations; None without it.

        An expression of the block's symbols, for plants that get the law's control by a wire.
        """
        return None

    def explained(
        self, error: SimulationError, values: Mapping[str, FloatArray]
    ) -> SimulationError:
        """Returns the error of a function without a value, or a more precise one.

        `values` are those of each argument, by its source as of `Block.columns`.
        """
        return error

    def _begin(
        self, evaluate: Evaluate, places: list[int], context: Context, state: State
    ) -> EventStatus:
        held = [context.get_discrete_state(i).value() for i in places]
        if not any(np.isnan(each).any() for each in held):
            return _UNCHANGED  # A run that is continued.
        discrete = state.get_mutable_discrete_state()
        for place, values in zip(places, evaluate(context), strict=True):
            discrete.set_value(place, values)
        return _CHANGED

    def _project(self, context: Context, state: State) -> EventStatus:
        x, projection = context.get_continuous_state_vector().value(), self.block.projection
        assert projection is not None
        try:
            projected = projection.project(x, self._projected_by(context)[0])
        except InconsistentStateError as error:
            raise off_manifold(context.get_time(), x.copy(), error) from error
        if projected is x:
            return _UNCHANGED
        state.get_mutable_continuous_state().SetFromVector(projected)
        return _CHANGED


def check_context(system: System, context: Context) -> None:
    """Refuses the context of another system."""
    try:
        system.ValidateContext(context)
    except RuntimeError:
        raise ModelError(
            f"the context is not that of '{system.get_name()}'; of a diagram's context take "
            "system.GetMyMutableContextFromRoot(context)"
        ) from None


def context_in(system: System, root: Context) -> Context:
    """The context of a system in that of a diagram that contains it."""
    try:
        return system.GetMyMutableContextFromRoot(root)
    except RuntimeError:
        raise ModelError(
            f"the context is that of another diagram, without this '{system.get_name()}'"
        ) from None


def _shown(port: InputPort | OutputPort) -> str:
    """A port with its size, if it has vectors."""
    is_vector = port.get_data_type() == PortDataType.kVectorValued
    return f"{port.get_name()} ({port.size()})" if is_vector else port.get_name()


# ------------------------------------------------------------------------------------ declarations

Make = Callable[[str, Mapping[str, ca.SX], Mapping[str, Reader]], Evaluate]
"""(what, values, readers) -> a function of a context that returns these values."""


def _declare(system: Any, scalar: type, make: Make) -> None:
    """Declares ports, states, parameters and updates of a system on a scalar type."""
    # No callback holds the system or a port: Drake keeps callbacks in C++, where Python's collector
    # sees no cycle, and a port keeps its system alive.
    block, vector, is_float = system.block, BasicVector_[scalar], scalar is float
    system.set_name(block.name)
    # Only floats have a value without a copy.
    number: Reader = methodcaller("value" if is_float else "CopyToVector")
    readers: dict[str, Reader] = {
        "time": methodcaller("get_time"),
        "state": lambda context: number(context.get_continuous_state_vector()),
        "parameters": lambda context: number(context.get_numeric_parameter(0)),
    }
    # After a rejected step, Drake's runge_kutta5 and bogacki_shampine3 restore time and state, but
    # only the time invalidates cache entries (Drake 1.51).
    tickets = {
        "time": {system.time_ticket()},
        "state": {system.xc_ticket(), system.time_ticket()},
        "parameters": {system.all_parameters_ticket()},
    }
    for name, symbol in block.inputs.items():
        port = system.DeclareVectorInputPort(name, symbol.numel())
        readers[f"input {name}"] = _reader(port)
        tickets[f"input {name}"] = {system.input_port_ticket(port.get_index())}
    groups = {}
    for name, held in block.held.items():
        groups[name] = group = system.DeclareDiscreteState(vector(np.asarray(held.start, float)))
        readers[f"held {name}"] = partial(_read_held, number, int(group))
        tickets[f"held {name}"] = {system.discrete_state_ticket(group)}
    for name, value in block.defaults.items():
        sources = block.sources(value)
        tickets[f"input {name}"] |= set().union(*(tickets[source] for source in sources))
        evaluate = make(f"default of {name}", {name: value}, readers)
        readers[f"input {name}"] = _optional(system.GetInputPort(name), evaluate)
    if "parameters" in block.start or block.parameters.numel():
        system.DeclareNumericParameter(vector(block.default("parameters")))
    if block.state.numel():
        system.DeclareContinuousState(vector(block.default("state")))
    system._readers = readers
    for name, value in block.outputs.items():
        same = [n for n, h in block.held.items() if is_same(value, h.symbol)]
        if same:  # Drake copies it. A continuous state would be stale in trials.
            system.DeclareStateOutputPort(name, groups[same[0]])
            continue
        needs = set().union(*(tickets[source] for source in block.sources(value)))
        evaluate = make(name.replace("_", " "), {"value": value}, readers)
        system.DeclareVectorOutputPort(
            name, value.numel(), partial(_set_output, evaluate), needs or {system.nothing_ticket()}
        )
    for (period, offset, is_unrestricted), names in block.rates().items():
        update = make("update", {name: block.held[name].next for name in names}, readers)
        places = [int(groups[name]) for name in names]
        # Other scalars, as of Linearize, know discrete updates alone.
        if is_unrestricted and is_float:
            system.DeclarePeriodicUnrestrictedUpdateEvent(
                period, offset, partial(_set_state, update, places)
            )
        else:
            system.DeclarePeriodicDiscreteUpdateEvent(
                period, offset, partial(_set_held, update, places)
            )
    system._derivative = None
    if block.state.numel():
        system._derivative = make("derivative", {"value": block.derivative}, readers)


def _read_held(number: Reader, group: int, context: Context) -> Any:
    return number(context.get_discrete_state(group))


def _reader(port: InputPort) -> Reader:
    weak = proxy(port)
    return lambda context: weak.Eval(context)


def _optional(port: InputPort, evaluate: Evaluate) -> Reader:
    """Reads an input port, or its default without a wire."""
    weak = proxy(port)
    return lambda context: weak.Eval(context) if weak.HasValue(context) else evaluate(context)[0]


def _set_output(evaluate: Evaluate, context: Context, output: Any) -> None:
    output.SetFromVector(evaluate(context)[0])


def _set_held(update: Evaluate, places: list[int], context: Context, held: Any) -> None:
    for place, values in zip(places, update(context), strict=True):
        held.set_value(place, values)


def _set_state(update: Evaluate, places: list[int], context: Context, state: State) -> None:
    _set_held(update, places, context, state.get_mutable_discrete_state())


# -------------------------------------------------------------------------------------- evaluation

_STATES = ("state", "input estimated_state", "input measured_state", "held state")
"""The columns that are the state in messages."""


def _by_numbers(
    system: Any, what: str, values: Mapping[str, ca.SX], readers: Mapping[str, Reader]
) -> Evaluate:
    """On floats: the arrays that the next call in the same thread overwrites."""
    block = system.block
    function = BlockFunction(block, what, values, system.compiled)
    mine = [readers[source] for source in function.sources]

    def evaluate(context: Context) -> tuple[FloatArray, ...]:
        results = function.evaluate(*[read(context) for read in mine])
        if function.is_valid:
            return results
        given = [np.array(read(context)) for read in mine]
        function.evaluate(*given)
        error = _failed(system, function, context.get_time(), given)
        values = dict(zip(function.sources, given, strict=True))
        system._steps.tolerate(context, system.explained(error, values))
        return function.nowhere()

    return evaluate


def _failed(
    system: Any, function: BlockFunction, time: float, given: list[FloatArray]
) -> SimulationError:
    """The error of a function whose last values are not valid."""
    values = dict(zip(function.sources, given, strict=True))
    state = next((values[name] for name in _STATES if name in values), np.zeros(0))
    return simulation_error(function.failure(), time, state, system.block.signals)


def _by_jacobians(
    system: Any, what: str, values: Mapping[str, ca.SX], readers: Mapping[str, Reader]
) -> Evaluate:
    """On AutoDiffXd: values, and Jacobians times the gradients of what they depend on."""
    block = system.block
    columns, sources = block.columns(), block.sources(*values.values())
    value = stacked([ca.vec(each) for each in values.values()])
    slope = ca.densify(ca.jacobian(value, stacked([columns[source] for source in sources])))
    function = BlockFunction(block, what, {"value": value, "slope": slope})
    assert function.sources == tuple(sources)
    mine = [readers[source] for source in sources]
    ends = np.cumsum([each.numel() for each in values.values()])[:-1]

    def evaluate(context: Context) -> list[np.ndarray]:
        moving = [np.atleast_1d(read(context)) for read in mine]
        given = [ExtractValue(each).ravel() for each in moving]
        number, slopes = function.evaluate(*given)
        if not function.is_valid:
            raise _failed(
                system, function, ExtractValue(np.atleast_1d(context.get_time())).item(), given
            )
        gradient = np.zeros((0, 0))
        if moving:
            gradient = ExtractGradient(np.concatenate(moving).reshape(-1, 1))
        slopes = slopes.reshape(number.size, -1)
        return np.split(InitializeAutoDiff(number, slopes @ gradient).ravel(), ends)

    return evaluate


_NAMES = (
    *("sin", "cos", "tan", "asin", "acos", "atan", "atan2"),
    *("sinh", "cosh", "tanh", "exp", "log", "sqrt"),
)

_OPERATIONS: dict[int, Callable[..., Any]] = {
    **{ca.OP_ADD: add, ca.OP_SUB: sub, ca.OP_MUL: mul, ca.OP_DIV: truediv, ca.OP_POW: pow},
    **{ca.OP_CONSTPOW: pow, ca.OP_NEG: lambda a: -a, ca.OP_SQ: lambda a: a * a},
    **{ca.OP_TWICE: lambda a: 2 * a, ca.OP_INV: lambda a: 1 / a, ca.OP_NOT: lambda a: 1 - a},
    **{ca.OP_FMIN: sym.min, ca.OP_FMAX: sym.max, ca.OP_FABS: sym.abs, ca.OP_ASSIGN: lambda a: a},
    **{ca.OP_FLOOR: sym.floor, ca.OP_CEIL: sym.ceil},
    ca.OP_LT: lambda a, b: sym.if_then_else(a < b, 1, 0),
    ca.OP_LE: lambda a, b: sym.if_then_else(a <= b, 1, 0),
    ca.OP_EQ: lambda a, b: sym.if_then_else(a == b, 1, 0),
    ca.OP_NE: lambda a, b: sym.if_then_else(a == b, 0, 1),
    ca.OP_AND: mul,
    ca.OP_OR: sym.max,
    ca.OP_IF_ELSE_ZERO: lambda a, b: sym.if_then_else(a == 1, b, 0),
    **{getattr(ca, f"OP_{name.upper()}"): getattr(sym, name) for name in _NAMES},
}


def _by_instructions(
    system: Any, what: str, values: Mapping[str, ca.SX], readers: Mapping[str, Reader]
) -> Evaluate:
    """On Expression: CasADi's instructions, one by one."""
    f = BlockFunction(system.block, what, values)
    mine, f = [readers[source] for source in f.sources], f.function

    def evaluate(context: Context) -> list[np.ndarray]:
        arguments = [np.atleast_1d(read(context)) for read in mine]
        work = [sym.Expression(0.0)] * f.sz_w()
        results = [np.full(f.numel_out(i), work[0]) for i in range(len(values))]
        for k in range(f.n_instructions()):
            code, i, o = f.instruction_id(k), f.instruction_input(k), f.instruction_output(k)
            if code == ca.OP_CONST:
                work[o[0]] = sym.Expression(f.instruction_constant(k))
            elif code == ca.OP_INPUT:
                work[o[0]] = arguments[i[0]][i[1]]
            elif code == ca.OP_OUTPUT:
                if o[0] < len(values):
                    results[o[0]][o[1]] = work[i[0]]
            elif code in _OPERATIONS:
                work[o[0]] = _OPERATIONS[code](*(work[j] for j in i))
            else:
                raise ModelError(
                    f"{system.get_name()} does not convert to symbolic expressions: its {what} has "
                    f"the operation {code} of CasADi, which Drake's expressions do not have"
                )
        return results

    return evaluate


def _on(scalar: type, make: Callable[..., Evaluate]) -> type:
    """The class of converted systems on one scalar type; called twice, when this file is read."""

    class Converted(LeafSystem_[scalar]):
        """A converted block, with the ports, states and parameters of the original."""

        __slots__ = SHARED_DICTIONARY
        DoCalcTimeDerivatives = TracedSystem.DoCalcTimeDerivatives

        def __init__(self, block: Block) -> None:
            super().__init__()
            self.block = block
            _declare(self, scalar, partial(make, proxy(self)))

    return Converted


_CONVERTED = {
    AutoDiffXd: _on(AutoDiffXd, _by_jacobians),
    sym.Expression: _on(sym.Expression, _by_instructions),
}


def _convert(kind: type, system: TracedSystem) -> Any:
    for i in range(system.num_output_ports()):
        if (name := system.get_output_port(i).get_name()) not in system.block.outputs:
            raise ModelError(
                f"{system.get_name()} does not convert: its output port '{name}' was declared "
                "beside its block; make it an output of the block"
            )
    return kind(system.block)
