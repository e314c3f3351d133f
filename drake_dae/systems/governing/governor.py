"""References that slow down where limits require it, as a LeafSystem."""

from collections.abc import Sequence

import casadi as ca
import numpy as np
from pydrake.systems.framework import (
    BasicVector,
    Context,
    ContinuousState,
    DependencyTicket,
    EventStatus,
    State,
)

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.dae.governing.governing import Governing
from drake_dae.dae.references import Reference
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.timing.motion_limits import MotionLimits
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.errors import ModelError, ReferenceSignalError
from drake_dae.systems.blocks.failures import simulation_error
from drake_dae.systems.blocks.lifetime import weakly
from drake_dae.systems.blocks.traced import (
    DERIVATIVE,
    HELD,
    PARAMETERS,
    STATE,
    Block,
    Computation,
    Update,
)
from drake_dae.systems.blocks.trials import StepWatch
from drake_dae.systems.control.references import ReferenceGenerator

PATH_SIGNALS = (Signal("s", "s"), Signal("s'", ""), Signal("s''", "1/s"), Signal("room", "1/s"))
"""Names and units of the port `path`."""


@checked(ReferenceSignalError)
class PathGovernor(ReferenceGenerator):
    """References whose time s slows down where a limit would be exceeded; see `Governing`.

    s starts at the start time with s' = 0, and s' returns to 1 if the limits allow it.

    Input port:
        estimated_state: x, shape (n,).

    Output ports:
        reference: R of (28) for r(s(t)), shape (sum (mu_i + 1),).
        path: s, s', s'' and the range of s'' between its limits, shape (4,): the range is negative
            if no s'' is within all limits.

    The state is (s, s'), continuous, or with a sample period discrete; s'' is then constant in a
    sample. Numeric parameter 0 is that of the law's function. The block does not convert to
    AutoDiffXd, since s'' has kinks.

    Args:
        references: The references, in the order of the outputs; expressions of time.
        law: The law that follows them.
        limits: The limits of controls, states, rates and forces.
        start_time: s at the start, in s.
        sample_period: The sample period in s; 0 for continuous s.

    Raises:
        ReferenceSignalError, ModelError: As of `Governing`.
    """

    no_gradient = "the rate of its references has kinks where limits are reached"

    def __init__(
        self,
        references: Sequence[Reference],
        law: TrackingLaw,
        limits: MotionLimits,
        start_time: float = 0.0,
        sample_period: float = 0.0,
    ) -> None:
        super().__init__(references, law.degrees)
        if self.reference_parameters:
            raise ModelError(
                "a governor takes references without parameters, these have "
                f"{', '.join(self.reference_parameters)}: write their numbers into the expressions"
            )
        self.law, self.governing = law, Governing(law, tuple(references), limits)
        self.sample_period = sample_period
        self._steps = StepWatch(self)
        self.DeclareNumericParameter(BasicVector(law.all_parameters()))
        size = law.system.num_states
        self._state_port = self.DeclareVectorInputPort("estimated_state", size)
        start = np.array([start_time, 0.0])
        if sample_period:
            self.DeclareDiscreteState(start)
            self.DeclarePeriodicUnrestrictedUpdateEvent(sample_period, 0.0, weakly(self._step))
        else:
            self.DeclareContinuousState(BasicVector(start))
        self.DeclareVectorOutputPort("path", len(PATH_SIGNALS), weakly(self._calc_path))

    @property
    def further_signals(self) -> dict[str, tuple[Signal, ...]]:
        """Name of an output port -> names and units of its entries, for a record."""
        return {"path": PATH_SIGNALS}

    def _sources(self) -> set[DependencyTicket]:
        return {self.all_sources_ticket()}

    def _path(self, context: Context) -> FloatArray:
        if self.sample_period:
            return context.get_discrete_state(0).CopyToVector()
        return context.get_continuous_state_vector().CopyToVector()

    def _values(self, context: Context) -> tuple[FloatArray, ...]:
        function, path = self.governing.function, self._path(context)
        state = self._state_port.Eval(context)
        parameters = context.get_numeric_parameter(0).value()
        values = function.evaluate(path, state, parameters)
        if function.is_finite:
            return values
        names = {"state": self.law.system.state_signals}
        time = context.get_time()
        self._steps.tolerate(context, simulation_error(function.failure(), time, state, names))
        return function.nowhere()

    def _calc_reference(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._values(context)[0])

    def _calc_path(self, context: Context, output: BasicVector) -> None:
        path, (_, rate, room) = self._path(context), self._values(context)
        output.SetFromVector([*path, rate[1], room[0]])

    def DoCalcTimeDerivatives(self, context: Context, derivatives: ContinuousState) -> None:
        if not self.sample_period:
            derivatives.get_mutable_vector().SetFromVector(self._values(context)[1])

    def _step(self, context: Context, state: State) -> EventStatus:
        rate = self._values(context)[1]
        after = _after(self._path(context), rate, self.sample_period)
        state.get_mutable_discrete_state().set_value(0, after)
        return EventStatus.Succeeded()

    def traced(self) -> Block:
        function = self.governing.function
        memory = HELD if self.sample_period else STATE
        sources = (memory, "estimated_state", PARAMETERS)
        path, rate, room = ca.SX.sym("path", 2), ca.SX.sym("rate", 2), ca.SX.sym("room")
        shown = ca.Function("path", [path, rate, room], [ca.vertcat(path, rate[1], room)])
        computations = [
            Computation.of(function, sources, ("reference", "path_rate", "room")),
            Computation(shown, (memory, "path_rate", "room"), ("path",)),
        ]
        updates: tuple[Update, ...] = ()
        if self.sample_period:
            after = ca.vertcat(*_after(path, rate, self.sample_period))
            step = ca.Function("step", [path, rate], [after])
            stepped = Computation(step, (HELD, "path_rate"), (HELD,))
            updates = (Update(stepped, self.sample_period, 0.0, True),)
        else:
            same = ca.Function("rate", [rate], [rate])
            computations.append(Computation(same, ("path_rate",), (DERIVATIVE,)))
        return Block(
            self,
            tuple(computations),
            updates,
            model=self.law.system,
            signals={"state": self.law.system.state_signals},
            ports={"reference": tuple(self.law.reference_signals), "path": PATH_SIGNALS},
        )


def _after(path: FloatArray, rate: FloatArray, period: float) -> list[float]:
    """(s, s') after a sample with constant s''; s' does not become negative."""
    slower = path[1] + period * rate[1]
    return [path[0] + period * (path[1] + slower) / 2.0, slower]
