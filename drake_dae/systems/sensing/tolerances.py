"""Tolerances of errors: a run that exceeds them ends with the reason."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite

import casadi as ca
import numpy as np
from pydrake.systems.framework import Context, EventStatus, LeafSystem, State

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, brief, number, positive
from drake_dae.dae.system.layout import Indices
from drake_dae.dae.system.signals import Signal, outputs_named
from drake_dae.errors import ModelError, SimulationError
from drake_dae.systems.blocks.failures import simulation_error
from drake_dae.systems.blocks.lifetime import SHARED_DICTIONARY, weakly
from drake_dae.systems.blocks.traced import HELD, TIME, Block, Computation, Update
from drake_dae.trace.functions import FailureKind, TracedFunction


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
        ModelError: There are no outputs, or a number is not valid.
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
    ends_runs = True
    """It is part of a compiled diagram although no output depends on it."""

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
        self._places: Indices = np.array(outputs_named(tolerances.outputs, outputs), dtype=np.intp)
        self._lowest = lowest
        self._largest = np.array(list(tolerances.outputs.values()), dtype=float)
        self._period = period
        input_sizes = {
            "controlled_output": len(outputs),
            "reference": sizes[0],
            "constraint_force": len(forces),
            "state": sizes[1],
        }
        self._ports = [self.DeclareVectorInputPort(*item) for item in input_sizes.items()]
        self._recent = self.DeclareDiscreteState(self._places.size)
        self._function = self._traced(input_sizes)
        # Unrestricted, as the step of a discrete MultibodyPlant, so that all are from the same
        # instant.
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, weakly(self._check))

    def _traced(self, sizes: Mapping[str, int]) -> TracedFunction:
        """s after a sample; not valid if an error is too large."""
        time, recent = ca.SX.sym("time"), ca.SX.sym("recent", self._places.size)
        inputs = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
        desired = inputs["reference"][self._lowest.tolist()]
        error = (inputs["controlled_output"] - desired)[self._places.tolist()]
        share = -np.expm1(-self._period / self._tolerances.window)
        after = recent + share * (error**2 - recent)
        beyond = ca.mmax(ca.sqrt(after) / self._largest)
        # Forces and state are only for messages.
        return TracedFunction(
            "the watch of tolerances",
            {**inputs, "recent": recent, "time": time},
            {"recent": after},
            doubt=ca.if_else(time >= self._tolerances.after, 1.0 - beyond, 1.0),
            outside="an error is too large",
        )

    def _check(self, context: Context, state: State) -> EventStatus:
        inputs = [port.Eval(context) for port in self._ports]
        recent, time = context.get_discrete_state(self._recent).value(), context.get_time()
        after = self._function.evaluate(*inputs, recent, np.array([time]))[0]
        if not self._function.is_valid:
            raise self._failure(time, [*inputs, recent])
        state.get_mutable_discrete_state().set_value(self._recent, after)
        return EventStatus.Succeeded()

    def traced(self) -> Block:
        sources = (*(port.get_name() for port in self._ports), HELD, TIME)
        update = Update(Computation.of(self._function, sources, (HELD,)), self._period, 0.0, True)
        return Block(self, (), (update,), failure=self._failure)

    def _failure(self, time: float, arguments: Sequence[FloatArray]) -> SimulationError:
        force, state = (values + 0.0 for values in arguments[2:4])  # Without -0.
        function = self._function
        recent = np.sqrt(function.evaluate(*arguments[:5], np.array([time]))[0])
        if function.failure().fault is not FailureKind.OUTSIDE:
            return simulation_error(function.failure(), time, state, {})
        worst = int(np.argmax(recent / self._largest))
        signal = self._outputs[self._places[worst]]
        unit = f" {signal.unit}".rstrip()
        text = (
            f"the recent error of {signal.name} is {recent[worst]:.3g}{unit} at t = {time:.6g} s, "
            f"and {self._largest[worst]:.3g}{unit} is tolerated"
        )
        forces = [
            f"{signal.name} = {value:.3g} {signal.unit}"
            for signal, value in zip(self._forces, force, strict=True)
        ]
        text += f"; then {', '.join(forces)}" if forces else ""
        return SimulationError(text, time, state)
