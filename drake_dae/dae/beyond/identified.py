"""Parameters of a model that an observer estimates: how momentum and distances depend on them."""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.signals import Parameter, Signal
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import ModelError
from drake_dae.trace.functions import TracedFunction


def check_bounded(system: DaeSystem, parameters: Sequence[Parameter]) -> None:
    """Raises ModelError if a parameter has no bounds, from which its estimation starts."""
    for parameter in parameters:
        if parameter.bounds is None or not np.all(parameter.low < parameter.high):
            raise ModelError(
                f"{system.name}: '{parameter.name}' has no bounds. Besides a disturbance and "
                "coefficients of friction of contacts, an observer estimates parameters with a "
                "lowest and a highest value, which differ (`bounds`)"
            )


@dataclass(frozen=True, eq=False)
class IdentifiedTerms:
    """The parameters theta of a system that an observer estimates, c numbers.

    An error delta = theta* - theta leaves the disturbance d = -G delta in the balance of the
    momentum p, where G is the derivative of p' - S^T (E' x + f + g v + h u) with respect to theta.
    An error of a surface leaves a distance phi(x) that is not zero in contact.
    `slopes` is (x, u, v, parameters) -> the derivatives by theta of p, of its rate without inputs
    and of the part from the inputs, (k, c) each; the distances phi that depend on theta, (j,), with
    derivatives, (j, c), and second derivatives, one below the other, (j c, c). `pressed` are
    the constraint inputs of these distances, `places` the indices in theta that they depend on.
    """

    parameters: tuple[Parameter, ...]
    slopes: TracedFunction
    pressed: tuple[int, ...]
    places: tuple[int, ...]

    @classmethod
    def of(
        cls,
        system: DaeSystem,
        parameters: tuple[Parameter, ...],
        momentum: dict[str, ca.SX],
        inputs: dict[str, ca.SX],
    ) -> "IdentifiedTerms":
        """Derives the functions from p, its rate without inputs, and the part from the inputs."""
        check_bounded(system, parameters)
        theta = ca.vertcat(ca.SX(0, 1), *(parameter.symbol for parameter in parameters))
        pressed = tuple(i for i in range(system.k.numel()) if ca.depends_on(system.k[i], theta))
        if pressed and system.sharing is not None:
            raise ModelError(
                f"{system.name}: no surface is estimated where constraints are redundant"
            )
        gaps = system.k[list(pressed), :]
        outputs = {name: ca.jacobian(value, theta) for name, value in momentum.items()}
        bends = [ca.hessian(gap, theta)[0] for gap in ca.vertsplit(gaps)] if pressed else []
        bend = ca.vertcat(ca.SX(0, theta.numel()), *bends)
        outputs |= {"gaps": gaps, "gap slopes": ca.jacobian(gaps, theta), "gap bends": bend}
        dense = {name: ca.densify(value) for name, value in outputs.items()}
        slopes = system.trace("slopes of parameters", dense, inputs, often=False)
        places = tuple(i for i in range(theta.numel()) if ca.depends_on(gaps, theta[i]))
        return cls(parameters, slopes, pressed, places)

    @property
    def signals(self) -> tuple[Signal, ...]:
        """Names and units of theta."""
        return tuple(signal for parameter in self.parameters for signal in parameter.signals)

    @property
    def low(self) -> FloatArray:
        """The lowest values, shape (c,)."""
        return np.concatenate([np.zeros(0), *(p.low for p in self.parameters)])

    @property
    def high(self) -> FloatArray:
        """The highest values, shape (c,)."""
        return np.concatenate([np.zeros(0), *(p.high for p in self.parameters)])
