"""Expressions of pydrake.symbolic in CasADi: as a DaeSystem, and Drake's own systems as blocks."""

from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from numbers import Real
from operator import add, mul, truediv
from typing import Any
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.symbolic import Expression, ExpressionKind, Formula, FormulaKind, Variable
from pydrake.systems.framework import PortDataType, System

from drake_dae.arguments import checked
from drake_dae.arrays import numbers
from drake_dae.blocks.block import NOTHING, TIME, Block, Held, stacked
from drake_dae.dae import DaeSystem, Parameter, Signal
from drake_dae.errors import ModelError

_FUNCTIONS: dict[ExpressionKind, Callable[..., ca.SX]] = {
    ExpressionKind.Constant: lambda number: number,
    ExpressionKind.Var: lambda symbol: symbol,
    ExpressionKind.Add: lambda *terms: reduce(add, terms),
    ExpressionKind.Mul: lambda *factors: reduce(mul, factors),
    ExpressionKind.Div: truediv,
    ExpressionKind.Pow: pow,
    **{
        getattr(ExpressionKind, name.title()): getattr(ca, name)
        for name in (
            *("log", "exp", "sqrt", "sin", "cos", "tan", "asin", "acos", "atan", "atan2"),
            *("sinh", "cosh", "tanh"),
        )
    },
}

_NOT_SMOOTH: dict[ExpressionKind, tuple[str, Callable[..., ca.SX]]] = {
    ExpressionKind.Abs: ("abs", ca.fabs),
    ExpressionKind.Min: ("min", ca.fmin),
    ExpressionKind.Max: ("max", ca.fmax),
    ExpressionKind.Ceil: ("ceil", ca.ceil),
    ExpressionKind.Floor: ("floor", ca.floor),
    ExpressionKind.IfThenElse: ("if_then_else", ca.if_else),
}
"""Functions without derivatives everywhere, which can be evaluated nevertheless; with their
names."""

_RELATIONS: dict[FormulaKind, Callable[..., ca.SX]] = {
    FormulaKind.True_: lambda: ca.SX(1),
    FormulaKind.False_: lambda: ca.SX(0),
    FormulaKind.Eq: ca.eq,
    FormulaKind.Neq: ca.ne,
    FormulaKind.Gt: ca.gt,
    FormulaKind.Geq: ca.ge,
    FormulaKind.Lt: ca.lt,
    FormulaKind.Leq: ca.le,
    FormulaKind.And: lambda *parts: reduce(ca.logic_and, parts),
    FormulaKind.Or: lambda *parts: reduce(ca.logic_or, parts),
    FormulaKind.Not: ca.logic_not,
}

_CONTINUOUS = Variable.Type.CONTINUOUS


@checked(ModelError)
def from_symbolic(
    state: Sequence[Variable],
    *,
    f: Any,
    h: Any = None,
    l: Any = None,  # noqa: E741 - the paper's letter
    g: Any = None,
    k: Any = None,
    m: Any = None,
    parameters: Mapping[Variable, float] | None = None,
    **labels: Any,
) -> DaeSystem:
    """Builds a system (1)-(3) from expressions of `pydrake.symbolic`.

    These share no subexpressions, so repeated subexpressions are translated repeatedly.

    Args:
        state: The variables x, in order.
        f, g, h, k, l, m: The functions of (1)-(3): an Expression, Variable or number, or a list or
            array of these, of lists for a matrix, row by row. Without constraints leave out g, k
            and m; without controls h; without controlled outputs l and m.
        parameters: Variable -> default.
        labels: The remaining fields of `DaeSystem`; the states are named as their variables.

    Raises:
        ModelError: A variable is neither a state nor a parameter; an expression is not smooth, such
            as abs, or not known, such as an uninterpreted function; or the functions form no valid
            system, see `DaeSystem`.
    """
    owner = labels.get("name", "system")
    defaults = dict(parameters or {})
    symbols: dict[int, ca.SX] = {}
    for variable in [*state, *defaults]:
        if not (isinstance(variable, Variable) and variable.get_type() == _CONTINUOUS):
            raise ModelError(
                f"{owner}: states and parameters must be continuous Variables of "
                f"pydrake.symbolic, got {variable!r}"
            )
        if variable.get_id() in symbols:
            raise ModelError(
                f"{owner}: the variable {variable} occurs twice among the states and parameters"
            )
        symbols[variable.get_id()] = ca.SX.sym(variable.get_name())

    def translate(letter: str, value: Any) -> Any:
        if isinstance(value, np.ndarray):
            value = value.tolist()
        if isinstance(value, (list, tuple)):
            return [translate(letter, item) for item in value]
        try:
            return to_casadi(value, symbols)
        except ModelError as error:
            raise ModelError(f"{owner}: {letter} cannot hold {value}: {error}") from None

    functions = {"f": f, "g": g, "h": h, "k": k, "l": l, "m": m}
    return DaeSystem(
        state=ca.vertcat(ca.SX(0, 1), *[symbols[variable.get_id()] for variable in state]),
        **{
            letter: ca.SX(0, 0) if value is None else translate(letter, value)
            for letter, value in functions.items()
        },
        parameters=tuple(
            Parameter(variable.get_name(), value, symbol=symbols[variable.get_id()])
            for variable, value in defaults.items()
        ),
        **{"state_signals": tuple(Signal(v.get_name()) for v in state), **labels},
    )


def to_casadi(expression: Any, symbols: Mapping[int, ca.SX], smooth: bool = True) -> ca.SX:
    """A scalar expression of `pydrake.symbolic`, a Formula in it, or a number, in CasADi."""
    if isinstance(expression, Variable):
        if expression.get_id() not in symbols:
            raise ModelError(
                f"the variable {expression} is neither a state nor a parameter; pass it in "
                "'parameters' or put its number in"
            )
        return symbols[expression.get_id()]
    if isinstance(expression, Real):
        return ca.SX(float(numbers("it", expression)))
    if not isinstance(expression, Expression | Formula):
        raise ModelError(
            f"it is no expression of pydrake.symbolic, but {type(expression).__name__}"
        )
    kind = expression.get_kind()
    name, function = _NOT_SMOOTH.get(kind, ("", None))
    if smooth and name:
        raise ModelError(
            f"{name} has no derivatives everywhere, and the theory differentiates; use a smooth "
            "function instead"
        )
    function = function or (_RELATIONS if isinstance(expression, Formula) else _FUNCTIONS).get(kind)
    if function is None:
        raise ModelError(f"nothing is known of the function {expression}")
    _, parts = expression.Unapply()
    return function(*[to_casadi(part, symbols, smooth) for part in parts])


def symbolic_block(system: System) -> Block | None:
    """A system of Drake, or a LeafSystem templated on the scalar type; None if it is no block."""
    if system not in _KNOWN:
        _KNOWN[system] = _traced(system)
    return _KNOWN[system]


_KNOWN: WeakKeyDictionary[System, Block | None] = WeakKeyDictionary()
"""The blocks of systems that were asked for, since a conversion takes long."""


def _traced(system: System) -> Block | None:
    default = system.CreateDefaultContext()
    is_abstract = default.num_abstract_states() or default.num_abstract_parameters()
    if is_abstract or isinstance(system, MultibodyPlant):  # Whose conversion takes seconds.
        return None
    try:
        return _converted(system, system.ToSymbolic())
    except (RuntimeError, ModelError, SystemExit):
        return None


def _converted(system: System, other: Any) -> Block | None:
    default, context = system.CreateDefaultContext(), other.CreateDefaultContext()
    known: dict[int, ca.SX] = {}

    def variables(column: ca.SX) -> np.ndarray:
        """New variables of Drake, each with its CasADi symbol."""
        own = [Variable(f"x{i}") for i in range(column.numel())]
        known.update({v.get_id(): column[i] for i, v in enumerate(own)})
        return np.array([Expression(v) for v in own], dtype=object)

    def traced(values: Any) -> ca.SX:
        rows = [to_casadi(value, known, smooth=False) for value in np.atleast_1d(values)]
        return ca.densify(stacked(rows))

    context.SetTime(variables(TIME)[0])
    state = ca.SX.sym("state", default.num_continuous_states())
    if state.numel():
        context.SetContinuousState(variables(state))
    groups = range(default.num_discrete_state_groups())
    now = [default.get_discrete_state(i).CopyToVector() for i in groups]
    held = [ca.SX.sym(f"held{i}", now[i].size) for i in groups]
    for i in groups:
        context.SetDiscreteState(i, variables(held[i]))
    counts = range(default.num_numeric_parameter_groups())
    numbers = [default.get_numeric_parameter(i).CopyToVector() for i in counts]
    parameters = [ca.SX.sym(f"parameter{i}", each.size) for i, each in enumerate(numbers)]
    for i, column in enumerate(parameters):
        context.get_mutable_numeric_parameter(i).SetFromVector(variables(column))
    inputs = {}
    for i in range(system.num_input_ports()):
        port = system.get_input_port(i)
        if port.get_data_type() != PortDataType.kVectorValued:
            return None
        inputs[port.get_name()] = column = ca.SX.sym(port.get_name(), port.size())
        other.get_input_port(i).FixValue(context, variables(column))
    outputs = {}
    for i in range(system.num_output_ports()):
        port = system.get_output_port(i)
        if port.get_data_type() == PortDataType.kVectorValued:
            outputs[port.get_name()] = traced(other.get_output_port(i).Eval(context))
    derivative, updated = NOTHING, {}
    if state.numel():
        derivative = traced(other.EvalTimeDerivatives(context).CopyToVector())
    if held:
        event = system.GetUniquePeriodicDiscreteUpdateAttribute()
        if event is None:
            return None
        after = other.EvalUniquePeriodicDiscreteUpdate(context)
        rate = event.period_sec(), event.offset_sec(), False
        updated = {f"held{i}": Held(held[i], traced(after.value(i)), now[i], *rate) for i in groups}
    return Block(
        system.get_name(),
        inputs,
        outputs,
        state,
        derivative,
        updated,
        stacked(parameters),
        {
            "state": default.get_continuous_state_vector().CopyToVector(),
            "parameters": np.concatenate([np.zeros(0), *numbers]),
        },
    )
