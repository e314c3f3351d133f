"""Python functions of (1)-(3), called once with symbols."""

from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import casadi as ca
from numpy.typing import ArrayLike

from drake_dae.arrays import numbers, unknown_name
from drake_dae.dae.system.expressions import as_signals, call
from drake_dae.dae.system.signals import Parameter, Signal
from drake_dae.errors import ModelError


def called_functions(
    state: Sequence[Signal | str] | int,
    functions: Mapping[str, Any],
    parameters: Mapping[str, ArrayLike],
    labels: Mapping[str, Any],
    fields: Sequence[str],
) -> dict[str, Any]:
    """Returns the fields of a `DaeSystem` from Python functions; see `from_functions`."""
    owner = labels.get("name", "system")
    fixed = {"state", "parameters", "state_signals", *"fghklm"}
    allowed = [item for item in fields if item not in fixed]
    for label in labels:
        if label not in allowed:
            raise ModelError(f"{owner}: {unknown_name('field', label, allowed)}")
    bad = [name for name in parameters if not name.isidentifier()]
    if bad:
        raise ModelError(
            f"parameter names must be Python identifiers, for use as p.name, got {bad}"
        )
    names = [f"x{i}" for i in range(state)] if isinstance(state, int) else state
    named = as_signals(f"{owner}: the states", names)
    if not named:
        raise ModelError(f"{owner}: a system needs at least one state")
    x = ca.vertcat(*[ca.SX.sym(signal.name) for signal in named])
    defined = tuple(
        Parameter(name, numbers(f"parameter '{name}'", value)) for name, value in parameters.items()
    )
    arguments: list[Any] = [x]
    if defined:
        arguments.append(SimpleNamespace(**{p.name: p.symbol for p in defined}))
    values = {key: call(owner, key, function, arguments) for key, function in functions.items()}
    if values["h"].shape[0] == 1 and x.numel() != 1:
        values["h"] = values["h"].T
    return {"state": x, **values, "parameters": defined, "state_signals": named, **labels}
