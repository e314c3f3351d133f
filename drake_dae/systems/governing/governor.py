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
from drake_dae.trace.functions import TracedFunction

PATH_SIGNALS = (Signal("s", "s"), Signal("s'", ""), Signal("s''", "1/s"), Signal("room", "1/s"))
"""Names and units of the port `path`."""


@checked(ReferenceSignalError)
class PathGovernor(ReferenceGenerator):
    """References whose time s slows down where a limit would be exceeded; see `Governing`.

    s starts at the start time with s' = 0, and s' returns to 1 if the limits allow it.

    Input ports:
        estimated_state: x, shape (n,).
        exogenous: The exogenous signals of the law, such as the estimates of an observer, shape
            (k,); only for a law that has any. The values of the sample before count, since an
            observer reads the reference.

    Output ports:
        reference: R of (28) for r(s(t)), shape (sum (mu_i + 1),).
        path: s, s', s'' and the range of s'' between its limits, shape (4,): the range is negative
            if no s'' is within all limits.

    The state is (s, s'), continuous, or with a sample period discrete, followed by the exogenous
    signals; s'' is then constant in a sample. Numeric parameter 0 is that of the law's function.
    The block does not convert to AutoDiffXd, since s'' has kinks.

    Args:
        references: The references, in the order of the outputs; expressions of time.
        law: The law that follows them.
        limits: The limits of controls, states, rates and forces.
        start_time: s at the start, in s.
        sample_period: The sample period in s; 0 for continuous s.

    Raises:
        ReferenceSignalError, ModelError: As of `Governing`; or a law with exogenous signals has no
            samples.
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
        self.law = law
        super().__init__(references, law.degrees)
        if self.reference_parameters:
            raise ModelError(
                "a governor takes references without parameters, these have "
                f"{', '.join(self.reference_parameters)}: write their numbers into the expressions"
            )
        self.governing = Governing(law, tuple(references), limits, sample_period)
        self.sample_period = sample_period
        self._steps = StepWatch(self)
        self.DeclareNumericParameter(BasicVector(law.all_parameters()))
        start, places = np.array([start_time, 0.0]), list[int]()
        if law.exogenous_degrees:
            if not sample_period:
                raise ReferenceSignalError(
                    "the time of references is governed beside exogenous signals, such as an "
                    "observer's estimates, only at samples: give a sample_period"
                )
            places = law.system.exogenous.places(law.exogenous_degrees)
            self._exogenous_port = self.DeclareVectorInputPort("exogenous", len(places))
        self._places = places
        if sample_period:
            known = law.system.parameter_values[places]
            self.DeclareDiscreteState(np.concatenate([start, known]))
            self.DeclarePeriodicUnrestrictedUpdateEvent(sample_period, 0.0, weakly(self._step))
        else:
            self.DeclareContinuousState(BasicVector(start))
        calculate = weakly(self._calc_path)
        self.DeclareVectorOutputPort("path", len(PATH_SIGNALS), calculate, self._read)

    @property
    def further_signals(self) -> dict[str, tuple[Signal, ...]]:
        """Name of an output port -> names and units of its entries, for a record."""
        return {"path": PATH_SIGNALS}

    def _declare_reference(self, sources: set[DependencyTicket]) -> None:
        # Not the port `exogenous`: an observer reads R.
        self._state_port = self.DeclareVectorInputPort(
            "estimated_state", self.law.system.num_states
        )
        read = self.input_port_ticket(self._state_port.get_index())
        self._read = {read, self.all_state_ticket(), self.all_parameters_ticket()}
        super()._declare_reference(self._read)

    def _path(self, context: Context) -> FloatArray:
        if self.sample_period:
            return context.get_discrete_state(0).value()[:2]
        return context.get_continuous_state_vector().CopyToVector()

    def _values(self, context: Context) -> tuple[FloatArray, ...]:
        function, path = self.governing.function, self._path(context)
        state = self._state_port.Eval(context)
        parameters = context.get_numeric_parameter(0).value()
        if self._places:
            parameters = parameters.copy()
            parameters[self._places] = context.get_discrete_state(0).value()[2:]
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
        known = self._exogenous_port.Eval(context) if self._places else []
        state.get_mutable_discrete_state().set_value(0, [*after, *known])
        return EventStatus.Succeeded()

    def traced(self) -> Block:
        memory = HELD if self.sample_period else STATE
        sources, count = (memory, "estimated_state", PARAMETERS), len(self._places)
        held, rate, room = ca.SX.sym("held", 2 + count), ca.SX.sym("rate", 2), ca.SX.sym("room")
        path, known = held[:2], held[2:]
        shown = ca.Function("path", [held, rate, room], [ca.vertcat(path, rate[1], room)])
        computations = [
            Computation.of(self._governed(held), sources, ("reference", "path_rate", "room")),
            Computation(shown, (memory, "path_rate", "room"), ("path",)),
        ]
        updates: tuple[Update, ...] = ()
        if self.sample_period:
            arguments, read = [held, rate], [HELD, "path_rate"]
            if count:
                known = ca.SX.sym("exogenous", count)
                arguments, read = [*arguments, known], [*read, "exogenous"]
            after = ca.vertcat(*_after(path, rate, self.sample_period), known)
            stepped = Computation(ca.Function("step", arguments, [after]), tuple(read), (HELD,))
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

    def _governed(self, held: ca.SX) -> TracedFunction:
        """The function of `Governing` with the discrete state in place of the path."""
        function = self.governing.function
        if not self._places:
            return function
        system = self.law.system
        numbers = self.law.inputs["parameters"]
        parameters = ca.SX(numbers)
        parameters[self._places] = held[2:]
        values = function.function.call([held[:2], system.state, parameters])
        return TracedFunction(
            function.name,
            {"held": held, "state": system.state, "parameters": numbers},
            dict(zip(function.output_names, values, strict=False)),
            compiled=system.compiled,
        )


def _after(path: FloatArray, rate: FloatArray, period: float) -> list[float]:
    """(s, s') after a sample with constant s''; s' does not become negative."""
    slower = path[1] + period * rate[1]
    return [path[0] + period * (path[1] + slower) / 2.0, slower]
