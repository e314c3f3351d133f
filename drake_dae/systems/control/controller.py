"""The tracking law as a LeafSystem."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import (
    BasicVector,
    Context,
    ContinuousState,
    DependencyTicket,
    EventStatus,
    State,
)

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, vector
from drake_dae.blocks.computations import Block
from drake_dae.blocks.lifetime import SHARED_DICTIONARY, port_value, weakly
from drake_dae.blocks.trials import state_tickets
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.tracking.gains import FeedbackGains, GainDesign
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.errors import ModelError
from drake_dae.systems.blocks.block import ParameterizedSystem
from drake_dae.systems.blocks.formulas import Formula, TracedFormula
from drake_dae.systems.control.contract import Controller, Derived
from drake_dae.systems.control.non_minimum_phase import warn_of_zero_dynamics
from drake_dae.systems.control.traced_law import traced_law
from drake_dae.trace.functions import TracedFunction


@checked(ModelError)
class TrackingController(ParameterizedSystem, Controller):
    """The law (28) of any `TrackingLaw`: u = B(x)^-1 (-a(x) + ubar(x, R)).

    Input ports:
        estimated_state: x, shape (n,).
        reference: R, output-major, r_i, ..., r_i^(mu_i); shape (sum (mu_i + 1),).
        measured_force: The constraint force from a sensor, shape (m,); if the law takes it.
        exogenous: The signals w with their derivatives, if the system has any; see
            `ParameterizedSystem`.

    Output ports:
        control: u, shape (p,).
        tracking_error: e = z - r (29) by the controller's own model, one entry per output.
        integral: The integrals of errors, shape (k,), if the law has any; its state. They start at
            zero, or at the values of `set_integral`. An integral is not updated while its entry of
            `hold` is not 0, or while it is at its limit and its error would increase it
            (anti-windup).

    A law with integrals also has an input port `hold`, shape (k,): an error is not integrated while
    its entry is not 0, for example while a drive is at its limit or a contact is lost. Without a
    wire it is 0.

    The first two output ports have direct feedthrough from all input ports except `hold`, and
    except `measured_force` if the law only integrates it. Numeric parameter 0 holds the model's
    parameters and then the gains. The block converts to AutoDiffXd.

    Args:
        law: The law.
        outputs: z at which its zero dynamics are judged, shape (p,); see `ZeroDynamics.stability`.
        integral_limits: The largest |integral| of each error in its unit times s, a number or shape
            (k,), positive. Converted to AutoDiffXd there are no limits and no `hold`, and an
            integrated force must come from a sensor.
        sample_period: The sample period of integrals in s, as for discrete plants; they then do
            not convert. 0 for continuous integrals.

    Warns:
        NonMinimumPhaseWarning: The zero dynamics (35) are unstable about that equilibrium.

    Raises:
        ModelError: A limit or period is not valid.
        SingularityError: A(x) or B(x) is singular on the way; the exception has time and state.
        NonFiniteError: A value is not finite on the way, likewise.
    """

    __slots__ = SHARED_DICTIONARY
    follows, shown = True, ("tracking_error",)

    def __init__(
        self,
        law: TrackingLaw,
        outputs: ArrayLike | None = None,
        integral_limits: ArrayLike = np.inf,
        *,
        sample_period: float = 0.0,
    ) -> None:
        dae = law.system
        signals = {
            "state": dae.state_signals,
            "reference": law.reference_signals,
            "measured_force": dae.constraint_input_signals,
        }
        super().__init__(dae, law.all_parameters(), signals)
        warn_of_zero_dynamics(law, outputs)
        self.law = law
        self.set_name("tracking_controller")
        sizes = {"estimated_state": dae.num_states, "reference": law.layout.reference_size}
        if law.measured_force:
            sizes["measured_force"] = dae.num_constraints
        self._evaluators = [self.DeclareVectorInputPort(*item).Eval for item in sizes.items()]
        self._declare_exogenous(law.exogenous_degrees)
        sources = {self.all_input_ports_ticket(), self.all_parameters_ticket()}
        self._integrates = bool(law.integral.outputs and not sample_period)
        if law.integral.outputs:
            sources = self._add_integrals(integral_limits, sample_period)
        self._is_plain = len(self._evaluators) == 2 and self._exogenous is None
        self.DeclareVectorOutputPort(
            "control", dae.num_controls, weakly(self._calc_control), sources
        )
        self.DeclareVectorOutputPort(
            "tracking_error", dae.num_outputs, weakly(self._calc_tracking_error), sources
        )

    def _add_integrals(self, limits: ArrayLike, sample_period: float) -> set[DependencyTicket]:
        """Declares the integrals, and returns the dependencies of the control."""
        count = len(self.law.integral.outputs)
        largest = np.asarray(limits, dtype=float)
        if largest.shape not in ((), (count,)) or not np.all(largest > 0.0):
            raise ModelError(
                f"integral_limits must be a positive number or shape ({count},), got {limits!r}"
            )
        if not sample_period >= 0.0:
            raise ModelError(f"sample_period must be 0 s or more, got {sample_period:g} s")
        self._limits, self.sample_period = np.broadcast_to(largest, (count,)), sample_period
        self._hold = self.DeclareVectorInputPort("hold", count)
        if sample_period:
            self.DeclareDiscreteState(count)
            # Unrestricted, as the step of a discrete MultibodyPlant, so that both see the same
            # instant.
            self.DeclarePeriodicUnrestrictedUpdateEvent(sample_period, 0.0, weakly(self._sum))
            tickets = {self.xd_ticket()}
        else:
            self.DeclareContinuousState(count)
            tickets = state_tickets(self)
        self._evaluators.append(weakly(self._integrals))
        self._rate_evaluators = list(self._evaluators)
        if self.law.measured_force and not self.law.control_takes_force:
            # Any value: reading it would close an algebraic loop.
            nothing = np.zeros(self.dae.num_constraints)
            self._evaluators[2] = lambda context: nothing
        self.DeclareVectorOutputPort("integral", count, port_value(self._integrals), tickets)
        read = ["estimated_state", "reference", "exogenous"]
        read += ["measured_force"] if self.law.control_takes_force else []
        ports = [self.GetInputPort(name) for name in read if self.HasInputPort(name)]
        tickets |= {self.input_port_ticket(port.get_index()) for port in ports}
        return tickets | {self.all_parameters_ticket()}

    def set_integral(self, context: Context, integral: ArrayLike) -> None:
        """Sets the initial integrals of the errors, shape (k,).

        Raises:
            ModelError: The shape is wrong, or the law has no integrals.
        """
        self.check_context(context)
        size = len(self.law.integral.outputs)
        if not size:
            raise ModelError(f"{self.get_name()}: its law has no integral action")
        values = vector("integral", integral, size)
        if self.sample_period:
            context.SetDiscreteState(values)
        else:
            context.SetContinuousState(values)

    def _sum(self, context: Context, state: State) -> EventStatus:
        summed = self._integrals(context) + self.sample_period * self._integral_rate(context)
        state.get_mutable_discrete_state().set_value(0, summed)
        return EventStatus.Succeeded()

    def DoCalcTimeDerivatives(self, context: Context, derivatives: ContinuousState) -> None:
        if self._integrates:  # Drake also calls this without a continuous state.
            derivatives.get_mutable_vector().SetFromVector(self._integral_rate(context))

    def _integral_rate(self, context: Context) -> FloatArray:
        inputs = [evaluate(context) for evaluate in self._rate_evaluators]
        rate = self._checked(self.law.function, context, *inputs)[2].copy()
        sigma = self._integrals(context)
        rate[(np.abs(sigma) >= self._limits) & (rate * sigma > 0.0)] = 0.0
        if self._hold.HasValue(context):
            rate[self._hold.Eval(context) != 0.0] = 0.0
        return rate

    def set_gains(self, context: Context, gains: GainDesign | FeedbackGains) -> None:
        """Changes the gains in a context.

        Args:
            context: The context of this system.
            gains: A design such as `poles(-8.0)`, or finished gains.

        Raises:
            GainError: The gains do not fit, are not Hurwitz, or couple outputs that the law does
                not.
        """
        values = self.law.all_parameters(self.parameters(context), gains)
        context.get_mutable_numeric_parameter(0).SetFromVector(values)

    def all_parameters(self, context: Context) -> FloatArray:
        """The parameters of the law's function: the model's at the context's time, and K."""
        self.check_context(context)
        return np.array(self._values(context))

    @property
    def further_signals(self) -> Mapping[str, Sequence[Signal]]:
        integral = self.law.integral
        return {"integral": integral.signals} if integral.outputs else {}

    def derived(
        self, context: Context | None, times: FloatArray, values: Mapping[str, FloatArray]
    ) -> Derived:
        """`desired_output` r and `tracking_error` z - r (29), from "reference" and z."""
        law = self.law
        desired, signals = values["reference"][..., law.layout.lowest], law.system.output_signals
        error = values["controlled_output"] - desired
        return {"desired_output": (desired, signals), "tracking_error": (error, signals)}

    def predicted_error(
        self, times: FloatArray, values: Mapping[str, FloatArray], parameters: FloatArray
    ) -> FloatArray:
        integral = values["integral"][0] if self.law.integral.outputs else None
        start = values["state"][0], values["reference"][0]
        return self.law.predicted_error(times - times[0], *start, parameters, integral)

    def _calc_control(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._evaluate(context)[0])

    def _calc_tracking_error(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._evaluate(context)[1])

    def _evaluate(self, context: Context) -> tuple[FloatArray, ...]:
        function = self.law.function
        if self._is_plain:  # The same as above, but without another call.
            of_state, of_reference = self._evaluators
            state, reference = of_state(context), of_reference(context)
            parameters = context.get_numeric_parameter(0).value()
            values = function.evaluate(state, reference, parameters)
            if function.is_valid:
                return values
        inputs = [evaluate(context) for evaluate in self._evaluators]
        return self._checked(function, context, *inputs)

    def _integrals(self, context: Context) -> FloatArray:
        if self.sample_period:
            return context.get_discrete_state(0).CopyToVector()
        return context.get_continuous_state_vector().CopyToVector()

    def traced(self) -> Block:
        limits, period = np.zeros(0), 0.0
        if self.law.integral.outputs:
            limits, period = self._limits, self.sample_period
        return traced_law(self, self.law, limits, period, self.exogenous_places, self._signals)

    def _formulas(self) -> dict[str, Formula]:
        function = self.law.function
        named = {"state": "estimated_state", "integral": "state"}
        sources = [named.get(name, name) for name in function.input_names]
        formulas: dict[str, Formula] = {
            name: TracedFormula(function, name, sources, self._signals)
            for name in ("control", "tracking_error")
        }
        if self.law.integral.outputs:
            if self.sample_period:
                raise ModelError(
                    f"{self.get_name()} does not convert to AutoDiffXd: its integrals are sampled, "
                    "and a sample has no derivative by the time. Give it no sample_period"
                )
            formulas["derivative"] = TracedFormula(
                function, "integral_rate", sources, self._signals
            )
            sigma = self.law.integral.symbol
            formulas["integral"] = TracedFormula(
                TracedFunction("integral", {"state": sigma}, {"value": sigma})
            )
        return formulas
