"""Tolerances of errors: a run that exceeds them ends with the reason."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite

import numpy as np
from pydrake.systems.framework import Context, EventStatus, LeafSystem, State

from drake_dae.arguments import checked
from drake_dae.arrays import brief, number, positive, unknown_name
from drake_dae.dae.system.layout import Indices
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError, SimulationError
from drake_dae.systems.blocks.lifetime import SHARED_DICTIONARY, weakly


@checked(ModelError)
@dataclass(frozen=True)
class Tolerances:
    """The tolerated errors of a run. It fails if the recent error of an output,

        sqrt(s),    s' = ((z - r)^2 - s) / window,    s = 0 at the start,

    exceeds its tolerance. So a single bounce of a contact is allowed, but loss of contact or
    chattering is a failure.

    Attributes:
        outputs: Output name -> the largest recent error, in the output's unit, positive.
        after: The time from which errors are checked, in s.
        window: The time constant of recent errors, in s.

    Raises:
        ModelError: There are no outputs, or a number makes no sense.
    """

    outputs: Mapping[str, float]
    after: float = 0.0
    window: float = 0.1

    def __post_init__(self) -> None:
        if not self.outputs:
            raise ModelError("tolerances need an output, as {wall.force: 5.0}")
        for name, value in self.outputs.items():
            if not (isfinite(value) and value > 0.0):
                raise ModelError(f"the tolerance of {name} must be positive, got {brief(value)}")
        number("after", self.after)
        positive("window", self.window)

    def places(self, signals: Sequence[Signal]) -> Indices:
        """The indices of the outputs.

        Args:
            signals: Names and units of the controlled outputs.

        Raises:
            ModelError: There is no such output.
        """
        names = [signal.name for signal in signals]
        for name in self.outputs:
            if name not in names:
                raise ModelError(unknown_name("output", name, names))
        return np.array([names.index(name) for name in self.outputs], dtype=np.intp)


class ToleranceWatch(LeafSystem):
    """Ends a run that exceeds its `Tolerances`.

    Input ports:
        controlled_output: z, shape (p,).
        reference: R, whose entries at `lowest` are r, shape (p,).
        constraint_force: lambda, shape (m,), for the message.
        state: x, shape (n,), for the exception.

    Args:
        tolerances: The tolerances.
        outputs: Names and units of z.
        forces: Names and units of lambda.
        lowest: The indices of r in R.
        sizes: The sizes of R and x.
        period: The period of the checks, in s.

    Raises:
        SimulationError: During a run: an error is too large.
    """

    __slots__ = SHARED_DICTIONARY
    #: What a function of the time does not do: see `compile_diagram`.
    ends_runs = "tolerances"

    def __init__(
        self,
        tolerances: Tolerances,
        outputs: Sequence[Signal],
        forces: Sequence[Signal],
        lowest: Indices,
        sizes: tuple[int, int],
        period: float,
    ) -> None:
        super().__init__()
        self.set_name("tolerance_watch")
        self._tolerances, self._outputs, self._forces = tolerances, outputs, forces
        self._places, self._lowest = tolerances.places(outputs), lowest
        self._largest = np.array(list(tolerances.outputs.values()), dtype=float)
        self._share = -np.expm1(-period / tolerances.window)
        declared = {
            "controlled_output": len(outputs),
            "reference": sizes[0],
            "constraint_force": len(forces),
            "state": sizes[1],
        }
        self._ports = [self.DeclareVectorInputPort(*item) for item in declared.items()]
        self._recent = self.DeclareDiscreteState(self._places.size)
        # Unrestricted, as the step of a discrete MultibodyPlant, so that all are from the same
        # instant.
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, weakly(self._look))

    def _look(self, context: Context, state: State) -> EventStatus:
        z, reference = (port.Eval(context) for port in self._ports[:2])
        error = (z - reference[self._lowest])[self._places]
        recent = context.get_discrete_state(self._recent).CopyToVector()
        recent += self._share * (error**2 - recent)
        state.get_mutable_discrete_state().set_value(self._recent, recent)
        beyond = np.sqrt(recent) / self._largest
        if context.get_time() >= self._tolerances.after and np.max(beyond) > 1.0:
            raise self._failure(context, int(np.argmax(beyond)), np.sqrt(recent))
        return EventStatus.Succeeded()

    def _failure(self, context: Context, worst: int, recent: np.ndarray) -> SimulationError:
        force, state = (port.Eval(context) for port in self._ports[2:])
        signal, time = self._outputs[self._places[worst]], context.get_time()
        unit = f" {signal.unit}".rstrip()
        text = (
            f"the recent error of {signal.name} is {recent[worst]:.3g}{unit} at t = {time:.6g} s, "
            f"and {self._largest[worst]:.3g}{unit} is tolerated"
        )
        listed = [
            f"{one.name} = {value:.3g} {one.unit}"
            for one, value in zip(self._forces, force, strict=True)
        ]
        text += f"; then {', '.join(listed)}" if listed else ""
        return SimulationError(text, time, state)
