"""An observer of model errors: a disturbance, and coefficients of friction."""

from collections.abc import Sequence

import casadi as ca
import numpy as np
from pydrake.systems.framework import Context, EventStatus, State

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.blocks.computations import HELD, PARAMETERS, Block, Computation
from drake_dae.blocks.lifetime import SHARED_DICTIONARY, port_value, weakly
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.errors import ModelError
from drake_dae.systems.observing.observer_functions import ObserverFunctions
from drake_dae.systems.observing.observer_rates import Observing
from drake_dae.systems.observing.observing_system import ObservingSystem
from drake_dae.trace.functions import TracedFunction

_ESTIMATES = ("identified", "identified_deviation")
"""The ports of estimated parameters and of their standard deviations."""

_READ = ("estimated_state", "measured_force", "reference")


@checked(ModelError)
class DisturbanceObserver(ObservingSystem):
    """Observes the disturbance d of E x' = f + S d + g v + h u, and identifies friction.

    With the momentum p = S^T E x a sample of d is, for samples T apart,

        d_k = (p_k - p_(k-1)) / T - mean((S^T E)' x + S^T f) - S^T (h u + g v),

    whose low-pass r with the rate k_o is the estimate; its part along the constrained directions
    has the rate k_n. A constant d is reached as 1 - e^(-k_o t); velocity noise n leaves noise of
    about k_o M n in r. With flexible joints or motors the law needs derivatives of r: then r is
    the output of several lags in series, see `Lags`. With c = S^T dg/dmu v, friction takes its
    share of r,

        mu' = k_f (c . r) / (c . c),    r' = k_o (d - r) - c mu',

    so that r + c mu follows d with the rate k_o for any k_f, without a jump when the share moves.

    Input ports:
        estimated_state: x, shape (n,).
        control: The applied u, shape (p,).
        measured_force: v, shape (m,).
        hold: Not 0 while a drive is at its limit, shape (1,); 0 without a wire. Then mu is not
            updated; r is, since it depends on the applied u.
        reference: R of the controller; without a wire the current outputs and rates.

    Output ports:
        exogenous: The disturbance to compensate, and mu, each with the derivatives that the law
            needs, for the port of a `TrackingController` with the same law.
        disturbance: r, shape (k,).
        friction: mu, shape (c,).
        hold: 1 while the input `hold` is not 0 or a frictional contact is lost, else 0, shape (1,):
            for the integrals of the controller.
        identified, identified_deviation: All estimated parameters with friction, and their standard
            deviations, shape (c,) each; only with such parameters.

    If the law's system has other parameters that `with_disturbance` made exogenous, all of them and
    friction are estimated together, by a Kalman filter of r; see `ParameterFilter`.

    `disturbance` and `friction` are held between samples; r starts at 0, and mu at the model's
    coefficients.

    Args:
        law: The law, for a system that `with_disturbance` made.
        observing: The rates, and the thresholds for friction.
        sample_period: T in s.
        control_lag: The fraction of T for which the plant uses the previous control, from 0 to 1: 1
            for a discrete plant of that step, 0 for a `ControlHold` without delay before a
            continuous plant.
        control_delay: tau in s, the mean time from a sample until its control acts: the delay, and
            half of T, for which it is held.
        is_ideal: Whether the contacts of the plant are ideal, with the friction of the model. On a
            contact that gives way friction is fully developed at a tenth of the speed.

    Attributes:
        observation: The observed functions.
        observing, sample_period: The arguments.
        disturbance_signals, friction_signals, identified_signals: Names and units of the output
            ports.

    Raises:
        ModelError: The law's system has no disturbance, or a number is not valid.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(
        self,
        law: TrackingLaw,
        observing: Observing,
        sample_period: float,
        control_lag: float = 0.0,
        control_delay: float = 0.0,
        is_ideal: bool = False,
    ) -> None:
        super().__init__(law, observing, sample_period, control_lag, control_delay)
        self.set_name("disturbance_observer")
        self._functions = functions = ObserverFunctions(
            law, observing, sample_period, control_lag, control_delay, is_ideal
        )
        start = np.zeros(functions.memory.column.numel())
        start[start.size - functions.filter.start.size :] = functions.filter.start
        self._declare(law, functions, "estimated_state", start)
        self._declare_hold(self.input_port_ticket(self._ports["measured_force"].get_index()))
        # Unrestricted, as the step of a discrete MultibodyPlant: so all see one instant.
        self.DeclarePeriodicUnrestrictedUpdateEvent(sample_period, 0.0, weakly(self._sample))
        sources = {self.discrete_state_ticket(self._held), self.all_parameters_ticket()}
        reads = {self.input_port_ticket(self._ports[port].get_index()) for port in _READ}
        count = functions.exogenous.outputs[0].size
        value = port_value(self._exogenous_values)
        self.DeclareVectorOutputPort("exogenous", count, value, sources | reads)
        for name, part in (("disturbance", slice(0, self._mu.start)), ("friction", self._mu)):
            value = port_value(self._part, part)
            self.DeclareVectorOutputPort(name, part.stop - part.start, value, sources)
        identified = self.observation.identified.signals
        self.identified_signals = (*identified, *self.friction_signals) if identified else ()
        self._estimates = dict[str, ca.SX]()
        if count := len(self.identified_signals):
            memory, filtered = functions.memory, functions.filter
            parts = filtered.values(memory.friction), filtered.deviations
            self._estimates = dict(zip(_ESTIMATES, parts, strict=True))
            held = {"held": memory.column}
            self._estimated = TracedFunction("estimates", held, self._estimates, often=False)
            for index, name in enumerate(_ESTIMATES):
                value = port_value(self._estimate, index)
                self.DeclareVectorOutputPort(name, count, value, sources)

    @property
    def _mu(self) -> slice:
        memory = self._functions.memory
        first = memory.disturbance.numel()
        return slice(first, first + memory.friction.numel())

    @property
    def further_signals(self) -> dict[str, Sequence[Signal]]:
        signals = dict(super().further_signals)
        if self.identified_signals:
            signals |= dict.fromkeys(_ESTIMATES, self.identified_signals)
        return signals

    def _estimate(self, index: int, context: Context) -> FloatArray:
        held = context.get_discrete_state(self._held).value()
        values: FloatArray = self._estimated.evaluate(held)[index]
        return values

    def _sample(self, context: Context, state: State) -> EventStatus:
        x, u, force = self._inputs(context, "estimated_state", "control", "measured_force")
        inputs = (
            context.get_discrete_state(self._held).value(),
            u,
            force,
            self._held_up(context),
            self._reference(context, x),
        )
        after = self._checked(self._functions.sample, context, x, *inputs)[0]
        state.get_mutable_discrete_state().set_value(self._held, after)
        return EventStatus.Succeeded()

    def _exogenous_values(self, context: Context) -> FloatArray:
        x, force = self._inputs(context, "estimated_state", "measured_force")
        held = context.get_discrete_state(self._held).value()
        inputs = x, held, force, self._reference(context, x)
        return self._checked(self._functions.exogenous, context, *inputs)[0]

    def _part(self, part: slice, context: Context) -> FloatArray:
        return context.get_discrete_state(self._held).value()[part]

    def traced(self) -> Block:
        functions, memory = self._functions, self._functions.memory
        read = ("estimated_state", HELD)
        needed = (*read, "measured_force", "reference", PARAMETERS)
        sampled = (*read, "control", "measured_force", "hold", "reference", PARAMETERS)
        parts = {"disturbance": memory.disturbance, "friction": memory.friction}
        parts |= self._estimates
        shown = ca.Function("shown", [memory.column], list(parts.values()))
        computations = (
            Computation.of(functions.exogenous, needed, ("exogenous",)),
            Computation(shown, (HELD,), tuple(parts)),
        )
        return self._block(computations, Computation.of(functions.sample, sampled, (HELD,)))
