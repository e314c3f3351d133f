"""The order of the parameters of a system in one vector."""

from collections.abc import Sequence

import casadi as ca

from drake_dae.arrays import unknown_name
from drake_dae.dae.system.signals import Parameter
from drake_dae.errors import ModelError


def parameter_symbol(parameters: Sequence[Parameter]) -> ca.SX:
    """Returns the symbols of all parameters in one column, then w', w'', ... of exogenous ones."""
    rates = [rate for p in parameters if p.exogenous for rate in p.derivatives]
    return ca.vertcat(ca.SX(0, 1), *[p.symbol for p in parameters], *rates)


def parameter_slice(owner: str, parameters: Sequence[Parameter], name: str) -> slice:
    """Returns the slice of a parameter in the parameter vector."""
    start = 0
    for parameter in parameters:
        if parameter.name == name:
            return slice(start, start + parameter.value.size)
        start += parameter.value.size
    raise ModelError(f"{owner}: {unknown_name('parameter', name, [p.name for p in parameters])}")
