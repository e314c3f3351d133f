"""Expressions, names and functions from users: converted and checked.

CasADi's own messages do not say which function of (1)-(3) is wrong, or how to correct it.
"""

from collections.abc import Callable, Mapping, Sequence
from inspect import signature
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError
from drake_dae.trace.given import numpy_explained
from drake_dae.trace.smoothness import find_flaw


def as_expression(owner: str, key: str, value: Any) -> ca.SX:
    """Converts an SX, a number, an array, or a (nested) list of these to an SX matrix."""
    if isinstance(value, ca.MX):
        raise ModelError(f"{owner}: {key} is a CasADi MX; use SX symbols and expressions")
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


def as_functions(
    owner: str, functions: Mapping[str, Any], state: ca.SX, parameters: ca.SX
) -> dict[str, ca.SX]:
    """Converts the functions of (1)-(3) to expressions of the right shapes, and checks them."""
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
            raise ModelError(f"{owner}: {_misshapen(key, value, shape, (n, m, p, q))}")
        unknown = [s.name() for s in ca.symvar(value) if not ca.depends_on(allowed, s)]
        if unknown:
            raise ModelError(
                f"{owner}: {key} depends on {', '.join(unknown)}, which is neither a "
                "state nor a parameter; pass it in 'parameters' or put its number in"
            )
        values[key] = ca.sparsify(value)  # Zeros of an array are structural, too.
    _check_smoothness(owner, values, state, parameters)
    return values


def _misshapen(
    key: str, value: ca.SX, shape: tuple[int, int], sizes: tuple[int, int, int, int]
) -> str:
    n, m, p, q = sizes
    if value.numel() == 0 and m and key in "gm":
        return f"k is given, so g and m are needed; {key} is missing, with shape {shape}"
    return (
        f"{key} has shape {value.shape}, expected {shape} for n = {n} states, m = {m} constraints, "
        f"p = {p} controls, {q} controlled outputs"
    )


def _check_smoothness(owner: str, values: Mapping[str, ca.SX], state: ca.SX, other: ca.SX) -> None:
    """Checks that expressions are smooth; CasADi also evaluates those that are not."""
    if find_flaw(ca.veccat(*values.values()), state, other) is None:
        return
    for key, value in values.items():
        for row, column in zip(*value.sparsity().get_triplet(), strict=True):
            flaw = find_flaw(value[row, column], state, other)
            if flaw:
                raise ModelError(
                    f"{owner}: {key}, entry [{row}, {column}] of shape {value.shape}, "
                    f"{flaw.describe('the state')}"
                )


def check_unique(owner: str, kind: str, names: Sequence[str]) -> None:
    """Checks that no name occurs twice."""
    double = sorted({name for name in names if names.count(name) > 1})
    if double:
        raise ModelError(f"{owner}: {kind} names must be unique, twice: {', '.join(double)}")


def as_signals(what: str, signals: Any) -> tuple[Signal, ...]:
    """Converts a list of signals, or of names of signals without unit, to signals."""
    items = [signals] if isinstance(signals, str) or not isinstance(signals, Sequence) else signals
    bad = [item for item in items if not isinstance(item, (Signal, str))]
    if items is not signals or bad:
        raise ModelError(f"{what} must be a list of names or Signals, got {(bad or items)[0]!r}")
    return tuple(Signal(item) if isinstance(item, str) else item for item in items)


def call(
    owner: str, letter: str, function: Callable[..., Any] | None, arguments: list[Any]
) -> ca.SX:
    """Calls a user's function with symbols and returns its expression; empty without a function."""
    if function is None:
        return ca.SX(0, 0)
    if not callable(function):
        raise ModelError(
            f"{owner}: {letter} must be a function of the state, got "
            f"{type(function).__name__}; `DaeSystem(...)` takes expressions"
        )
    with numpy_explained(f"{owner}: function {letter}"):
        try:
            value = function(*arguments)
        except Exception as error:
            raise ModelError(
                f"{owner}: function {letter} failed on a CasADi column of {arguments[0].numel()} "
                f"states: {_explained(error, function, arguments)}"
            ) from error
    if value is None:
        raise ModelError(f"{owner}: function {letter} returned nothing")
    return as_expression(owner, letter, value)


def _explained(error: Exception, function: Callable[..., Any], arguments: Sequence[Any]) -> str:
    """Explains an error in a user's function."""
    text = str(error)
    try:
        signature(function).bind(*arguments)
    except TypeError:
        called = "the state x and the parameters p" if len(arguments) > 1 else "the state x alone"
        return f"{text}. It is called with {called}"
    except ValueError:
        pass  # Built-in functions have no signature.
    if "truth value" in text:
        return (
            "it asks whether a condition on the state is true, as in if, max or min. Conditions "
            "are not smooth, and the theory differentiates: write the branch in which the state "
            "remains, or a smooth function"
        )
    if isinstance(error, AttributeError) and isinstance(error.obj, SimpleNamespace):
        return f"no parameter '{error.name}'; there are {', '.join(vars(error.obj))}"
    text = text.removeprefix("...").split(": ", 1)[-1] if text.startswith(".../casadi") else text
    if isinstance(error, NotImplementedError):
        text += ". Use CasADi's own functions (casadi.sin, casadi.vertcat) or plain operators"
    return text
