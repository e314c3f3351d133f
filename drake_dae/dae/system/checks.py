"""The fields of a `DaeSystem`, checked when it is made: shapes, symbols, names, numbers."""

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray, brief, numbers, vector
from drake_dae.dae.system.contacts import UnilateralInput
from drake_dae.dae.system.expressions import as_functions, as_signals, check_unique
from drake_dae.dae.system.parameters import parameter_slice, parameter_symbol
from drake_dae.dae.system.signals import Parameter, Signal, is_symbol
from drake_dae.errors import ModelError
from drake_dae.trace.compiled import check_choice


def checked_fields(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Checks the fields of a system and returns them converted."""
    name = arguments["name"]
    if not isinstance(name, str):
        raise ModelError(f"the name of a system must be text, got {name!r}")
    state = arguments["state"]
    if not (is_symbol(state) and state.numel()):
        raise ModelError(
            f"{name}: 'state' must be a CasADi SX column of symbols, "
            f"for example casadi.SX.sym('x', 4); got {type(state).__name__}"
        )
    check_choice(name, arguments["compiled"])
    for key in ("least_margin", "negligible"):
        number = numbers(f"{name}: {key}", arguments[key])
        if number.ndim or not 1e-15 <= number < 1.0:
            raise ModelError(
                f"{name}: {key} must be from 1e-15, which is round-off, to below 1, got "
                f"{brief(arguments[key])}"
            )
    contacts = arguments["contacts"]
    if not isinstance(contacts, (list, tuple)) or not all(
        isinstance(contact, UnilateralInput) for contact in contacts
    ):
        raise ModelError(f"{name}: contacts must be a list of Contacts, got {brief(contacts)}")
    state = ca.vec(state)
    parameters = _parameters(name, arguments["parameters"])
    for contact in contacts:
        if contact.friction is not None:
            parameter_slice(name, parameters, contact.friction)
    expressions = _expressions(arguments, state, parameters)
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
        fields[key] = _signals(name, key, arguments[key], count, letter)
    fields |= _numbers(name, arguments, n)
    fields |= _choice(name, arguments, p, q)
    return fields


def _parameters(name: str, argument: Any) -> tuple[Parameter, ...]:
    parameters: Any = argument if isinstance(argument, (list, tuple)) else [None]
    if not all(isinstance(parameter, Parameter) for parameter in parameters):
        raise ModelError(f"{name}: parameters must be a list of Parameters, got {brief(argument)}")
    check_unique(name, "parameter", [p.name for p in parameters])
    return tuple(parameters)


def _expressions(
    arguments: Mapping[str, Any], state: ca.SX, parameters: Sequence[Parameter]
) -> dict[str, ca.SX]:
    """The functions of (1)-(3), E, the control metric and u_0, as expressions of right shapes."""
    functions = {key: arguments[key] for key in ("f", "g", "h", "k", "l", "m")}
    mass = arguments["mass_matrix"]
    functions["mass_matrix"] = ca.SX.eye(state.numel()) if mass is None else mass
    chosen = {key: arguments[key] for key in ("control_metric", "free_control")}
    functions |= {key: value for key, value in chosen.items() if value is not None}
    return as_functions(arguments["name"], functions, state, parameter_symbol(parameters))


def _signals(
    name: str, key: str, argument: Sequence[Any], count: int, letter: str
) -> tuple[Signal, ...]:
    """Names and units of a vector, with default names such as x0, x1."""
    signals = as_signals(f"{name}: {key}", argument or [f"{letter}{i}" for i in range(count)])
    if len(signals) != count:
        raise ModelError(f"{name}: {key} has {len(signals)} entries, expected {count}")
    check_unique(name, key, [signal.name for signal in signals])
    return signals


def _numbers(name: str, arguments: Mapping[str, Any], size: int) -> dict[str, FloatArray]:
    """The nominal state, and the scale of the states if there is one."""
    start = np.zeros(size) if arguments["nominal_state"] is None else arguments["nominal_state"]
    arrays = {"nominal_state": vector(f"{name}: nominal_state", start, size)}
    if arguments["state_scale"] is not None:
        scale = vector(f"{name}: state_scale", arguments["state_scale"], size)
        if not np.all(scale > 0.0):
            raise ModelError(f"{name}: state_scale must be positive, got {brief(scale)}")
        arrays["state_scale"] = scale
    for array in arrays.values():
        array.setflags(write=False)
    return arrays


def _choice(
    name: str, arguments: Mapping[str, Any], controls: int, outputs: int
) -> dict[str, ca.SX]:
    """The default of u_0; refuses u_0 without a metric, and a metric that is not needed."""
    has_metric, has_free = (
        arguments[key] is not None for key in ("control_metric", "free_control")
    )
    if has_free and not has_metric:
        raise ModelError(
            f"{name}: free_control needs a control_metric, which measures the distance from it"
        )
    if has_metric and controls <= outputs:
        raise ModelError(
            f"{name}: control_metric chooses among controls, but with "
            f"{controls} controls and {outputs} controlled outputs there is "
            "nothing to choose; leave it out"
        )
    return {"free_control": ca.SX(controls, 1)} if has_metric and not has_free else {}
