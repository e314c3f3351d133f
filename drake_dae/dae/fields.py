"""The fields of a `DaeSystem`, from expressions and functions of users: converted and checked.

CasADi's own messages do not say which function of (1)-(3) is wrong, or how to correct it.
"""

from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arrays import brief, number, numbers, unknown_name, vector
from drake_dae.dae.contacts import UnilateralInput
from drake_dae.dae.signals import Parameter, Signal, is_symbol, parameter_symbol
from drake_dae.errors import ModelError
from drake_dae.trace.compiled import check_choice
from drake_dae.trace.expressions import find_flaw


def checked_fields(given: Mapping[str, Any]) -> dict[str, Any]:
    """Checks the fields of a system and returns those that change, converted."""
    name, state = given["name"], given["state"]
    if not (is_symbol(state) and state.numel()):
        raise ModelError(
            f"{name}: 'state' must be a CasADi SX column of symbols, "
            f"for example casadi.SX.sym('x', 4); got {type(state).__name__}"
        )
    state = ca.vec(state)
    check_choice(name, given["compiled"])
    if not 1e-15 <= number(f"{name}: least_margin", given["least_margin"]) < 1.0:
        raise ModelError(
            f"{name}: least_margin must be from 1e-15, which is round-off, to below 1, got "
            f"{brief(given['least_margin'])}"
        )
    for key, kind in (("contacts", UnilateralInput), ("parameters", Parameter)):
        items = given[key]
        if not isinstance(items, (list, tuple)) or not all(isinstance(i, kind) for i in items):
            raise ModelError(
                f"{name}: {key} must be a list of {kind.__name__}s, got {brief(items)}"
            )
    parameters = tuple(given["parameters"])
    known = [p.name for p in parameters]
    _check_unique(name, "parameter", known)
    for contact in given["contacts"]:
        if contact.friction not in (None, *known):
            raise ModelError(f"{name}: {unknown_name('parameter', contact.friction, known)}")
    expressions = _expressions(name, given, state, parameter_symbol(parameters))
    fields = {"state": state, "parameters": parameters, **expressions}
    n, m = state.numel(), expressions["k"].numel()
    p, q = expressions["h"].shape[1], expressions["l"].numel()
    for key, count, letter in (
        ("state_signals", n, "x"),
        ("constraint_input_signals", m, "v"),
        ("constraint_output_signals", m, "y"),
        ("control_signals", p, "u"),
        ("output_signals", q, "z"),
    ):
        named = given[key] or [f"{letter}{i}" for i in range(count)]
        fields[key] = signals = _as_signals(f"{name}: {key}", named)
        if len(signals) != count:
            raise ModelError(f"{name}: {key} has {len(signals)} entries, expected {count}")
        _check_unique(name, key, [signal.name for signal in signals])
    for key, default in (("nominal_state", np.zeros(n)), ("state_scale", None)):
        value = default if given[key] is None else given[key]
        if value is not None:
            fields[key] = vector(f"{name}: {key}", value, n)
            fields[key].setflags(write=False)
    if np.any(fields.get("state_scale", 1.0) <= 0.0):
        raise ModelError(f"{name}: state_scale must be positive, got {brief(given['state_scale'])}")
    if "control_metric" not in expressions and "free_control" in expressions:
        raise ModelError(
            f"{name}: free_control needs a control_metric, which measures the distance from it"
        )
    if "control_metric" in expressions:
        if p <= q:
            raise ModelError(
                f"{name}: control_metric chooses among controls, but with {p} controls and {q} "
                "controlled outputs there is nothing to choose; leave it out"
            )
        fields.setdefault("free_control", ca.SX(p, 1))
    return fields


def fields_of_functions(
    state: Sequence[Signal | str] | int,
    functions: Mapping[str, Any],
    parameters: Mapping[str, ArrayLike],
    labels: Mapping[str, Any],
) -> dict[str, Any]:
    """Returns the fields of a `DaeSystem` from Python functions; see `from_functions`."""
    owner = labels.get("name", "system")
    bad = [name for name in parameters if not name.isidentifier()]
    if bad:
        raise ModelError(
            f"parameter names must be Python identifiers, for use as p.name, got {bad}"
        )
    names = [f"x{i}" for i in range(state)] if isinstance(state, int) else state
    named = _as_signals(f"{owner}: the states", names)
    if not named:
        raise ModelError(f"{owner}: a system needs at least one state")
    x = ca.vertcat(*[ca.SX.sym(signal.name) for signal in named])
    defined = tuple(
        Parameter(name, numbers(f"parameter '{name}'", value)) for name, value in parameters.items()
    )
    arguments: list[Any] = [x]
    if defined:
        arguments.append(SimpleNamespace(**{p.name: p.symbol for p in defined}))
    values = dict[str, ca.SX]()
    for letter, function in functions.items():
        if function is not None and not callable(function):
            raise ModelError(
                f"{owner}: {letter} must be a function of the state, got {brief(function)}; "
                "`DaeSystem(...)` takes expressions"
            )
        try:
            value = ca.SX(0, 0) if function is None else function(*arguments)
        except Exception as error:
            taken = "the state x and the parameters p" if defined else "the state x alone"
            raise ModelError(
                f"{owner}: function {letter} failed on a CasADi column of {x.numel()} states: "
                f"{error}. It is called with {taken}; use CasADi's own functions (casadi.sin) or "
                "plain operators. A condition, as in if, max or min, is not smooth: write the "
                "branch in which the state remains"
            ) from error
        values[letter] = as_expression(owner, letter, value)
    if values["h"].shape[0] == 1 and x.numel() != 1:
        values["h"] = values["h"].T
    return {"state": x, **values, "parameters": defined, "state_signals": named, **labels}


def as_expression(owner: str, key: str, value: Any) -> ca.SX:
    """Converts an SX, a number, an array, or a (nested) list of these to an SX matrix."""
    if isinstance(value, np.ndarray) and value.dtype == object:
        value = value.tolist()
    try:
        if isinstance(value, (list, tuple)):
            rows = [ca.horzcat(*row) if isinstance(row, (list, tuple)) else row for row in value]
            value = ca.vertcat(*rows) if rows else ca.SX(0, 1)
        return ca.SX(np.asarray(value, dtype=float) if not isinstance(value, ca.SX) else value)
    except Exception as error:
        raise ModelError(
            f"{owner}: {key} must be a CasADi SX expression, an array, or a list of these (of "
            f"lists of one length for a matrix), got {type(value).__name__}"
        ) from error


def _expressions(
    owner: str, given: Mapping[str, Any], state: ca.SX, parameters: ca.SX
) -> dict[str, ca.SX]:
    """Converts the functions of (1)-(3) to expressions of the right shapes, and checks them."""
    functions = {key: given[key] for key in "fghklm"} | {"mass_matrix": ca.SX.eye(state.numel())}
    for key in ("mass_matrix", "control_metric", "free_control"):
        if given[key] is not None:
            functions[key] = given[key]
    values = {key: as_expression(owner, key, value) for key, value in functions.items()}
    n, m, p = state.numel(), values["k"].numel(), values["h"].shape[1]
    q = values["l"].numel()
    shapes = {"f": (n, 1), "g": (n, m), "h": (n, p), "k": (m, 1), "l": (q, 1), "m": (q, m)}
    shapes |= {"mass_matrix": (n, n), "control_metric": (p, p), "free_control": (p, 1)}
    allowed = ca.vertcat(state, parameters)
    if len(ca.symvar(allowed)) != allowed.numel():
        raise ModelError(f"{owner}: a symbol occurs twice among the states and parameters")
    for key, value in values.items():
        shape = shapes[key]
        if value.numel() == 0 and 0 in shape:
            value = ca.SX(*shape)
        if value.shape != shape and value.shape == shape[::-1] and 1 in shape:
            value = value.T
        if value.shape != shape:
            raise ModelError(
                f"{owner}: {key} has shape {value.shape}, expected {shape} for n = {n} states, "
                f"m = {m} constraints, p = {p} controls, {q} controlled outputs"
            )
        unknown = [s.name() for s in ca.symvar(value) if not ca.depends_on(allowed, s)]
        if unknown:
            raise ModelError(
                f"{owner}: {key} depends on {', '.join(unknown)}, which is neither a "
                "state nor a parameter; pass it in 'parameters' or put its number in"
            )
        values[key] = ca.sparsify(value)  # Zeros of an array are structural, too.
    if find_flaw(ca.veccat(*values.values()), state, parameters):
        for key, value in values.items():
            for row, column in zip(*value.sparsity().get_triplet(), strict=True):
                if flaw := find_flaw(value[row, column], state, parameters, "the state"):
                    raise ModelError(
                        f"{owner}: {key}, entry [{row}, {column}] of shape {value.shape}, {flaw}"
                    )
    return values


def _check_unique(owner: str, kind: str, names: Sequence[str]) -> None:
    double = sorted({name for name in names if names.count(name) > 1})
    if double:
        raise ModelError(f"{owner}: {kind} names must be unique, twice: {', '.join(double)}")


def _as_signals(what: str, signals: Any) -> tuple[Signal, ...]:
    """Converts a list of signals, or of names of signals without unit, to signals."""
    is_list = isinstance(signals, Sequence) and not isinstance(signals, str)
    if not is_list or not all(isinstance(item, (Signal, str)) for item in signals):
        raise ModelError(f"{what} must be a list of names or Signals, got {brief(signals)}")
    return tuple(Signal(item) if isinstance(item, str) else item for item in signals)
