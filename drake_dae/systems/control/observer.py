"""An observer of what a model lacks: a disturbance, and coefficients of friction."""

from collections.abc import Sequence

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import BasicVector, Context, EventStatus, State

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, numbers, positive
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.errors import ModelError
from drake_dae.systems.blocks.block import ParameterizedSystem
from drake_dae.systems.blocks.formulas import Formula
from drake_dae.systems.blocks.lifetime import SHARED_DICTIONARY, weakly
from drake_dae.systems.blocks.traced import HELD, PARAMETERS, Block, Computation, Update
from drake_dae.systems.control.observer_functions import ObserverFunctions
from drake_dae.systems.control.observer_rates import Observing

_READ = ("estimated_state", "measured_force", "reference")


@checked(ModelError)
class DisturbanceObserver(ParameterizedSystem):
    """Observes the disturbance d of E x' = f + S d + g v + h u, and identifies friction.

    At each sample, T apart, the momentum p = S^T E x tells what acted besides what is known,

        d_k = (p_k - p_(k-1)) / T - mean((S^T E)' x + S^T f) - S^T (h u + g v),

    of which r is low-passed with the rate k_o, r_k = e^(-k_o T) r_(k-1) + (1 - e^(-k_o T)) d_k: a
    constant d is found as 1 - e^(-k_o t), and noise n of the velocities, with M the mass, leaves
    about k_o M n of noise in r. That part of d which the constraints answer, d - Q d with Q of
    `Observation`, is found with the rate k_n = `force_rate`: it makes no motion, but its noise
    makes force.

    Behind springs, motors or valves a law needs n derivatives of d, of which the differences of
    d_k would be noise. There r is what n + 1 such lags leave, one behind the other, r =
    (k_o / (s + k_o))^(n+1) d, which has them exactly; see `Lags`.

    A coefficient of friction takes the share that r has of the force of friction c = S^T dg/dmu v,

        mu' = k_f (c . r) / (c . c),    r' = k_o (d - r) - c mu',

    in the metric of kinetic energy, in the directions that the constraint leaves. So r + c mu
    follows what acts with the rate k_o, whatever k_f is, and no motion tells when the share is
    handed over: nor do the derivatives that are told, r', r'', ... without the share and mu' = 0,
    of whose errors c mu' and -c mu' the sum is zero. Friction that is identified acts at once where
    the force or the direction changes; r is late by 1 / k_o. mu stays between 0 and
    `largest_friction`, and stands still where the contact is pressed by less than `least_force`;
    also while the input `hold` is not 0. r needs no hold: it has the control that acts, also at its
    limits, and the force that is measured, also where a contact is open.

    Below `least_speed` a contact may stick, and its friction is a reaction like the constraint's:
    no motion tells it, nor its coefficient. Then mu stands still, and so does r in the directions
    in which the contact slides; in the others it goes on. Else r would take up what holds a tool
    that turns, 2 mu lambda within a sample or two, and give it back for 1 / k_o. The integrals of
    the law go on, so that what friction holds off its place comes there in the end.

    Friction acts against the motion that the reference wants, c_w = c(x_w), where x_w is x with the
    velocities that follow from the reference and the constraints: where a motion turns or begins
    the contact sticks, and its own velocity tells no direction. It is that motion at the time at
    which the control acts, tau = `control_delay` later: r' + tau r''. A reference has no noise, and
    what slides slowly is not believed; so c_w, and c where d is observed, are those of ten times
    the velocity: full from v_s / 10 on. Since the law's model has mu c(x), what it is told to
    cancel is r + mu (c_w - c(x)), of one and the same x. Where outputs and constraints do not
    determine the velocities, or `reference` has no wire, x_w = x. The speed of sliding is that by
    the power of friction, for surfaces that stand still.

    Input ports:
        estimated_state: x, shape (n,).
        control: u as it acts, shape (p,).
        measured_force: v, shape (m,).
        hold: Not 0 while a drive is at its limit, shape (1,); 0 without a wire.
        reference: R, as that of the controller; may be without a wire.

    Output ports:
        exogenous: What to cancel, and mu, each with the derivatives that the law needs, for the
            port of a `TrackingController` with the same law, in the order of its system's.
        disturbance: r, shape (k,).
        friction: mu, shape (c,).
        hold: 1 while the input `hold` is not 0 or a contact that rubs is lost, else 0, shape (1,):
            for the integrals of the controller.

    `disturbance` and `friction` are held between samples; r starts at 0, and mu at the model's
    coefficients.

    Args:
        law: The law, for a system that `with_disturbance` made.
        observing: The rates, and when friction is believed.
        sample_period: T in s.
        control_lag: For which part of T the plant goes on with the control that the port had at a
            sample, from 0 to 1: all of it for a discrete plant of that step, none for a
            `ControlHold` without delay before a continuous one.
        control_delay: tau in s, how much later than its sample a control acts in the mean: the
            delay, and half of T, for which it is held.

    Attributes:
        observation, observing, sample_period: What is observed, and the arguments.
        disturbance_signals, friction_signals: Names and units of the output ports.

    Raises:
        ModelError: The law's system has no disturbance, or a number makes no sense.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(
        self,
        law: TrackingLaw,
        observing: Observing,
        sample_period: float,
        control_lag: float = 0.0,
        control_delay: float = 0.0,
    ) -> None:
        system = law.system
        signals = {
            "state": system.state_signals,
            "control": system.control_signals,
            "constraint_input": system.constraint_input_signals,
        }
        super().__init__(system, system.parameter_values, signals, sees_steps=False)
        self.set_name("disturbance_observer")
        self.observing, self.sample_period = observing, positive("sample_period", sample_period)
        if not 0.0 <= control_lag <= 1.0:
            raise ModelError(f"control_lag must be from 0 to 1, got {control_lag:g}")
        if not control_delay >= 0.0:
            raise ModelError(f"control_delay must be 0 s or more, got {control_delay:g} s")
        self._functions = found = ObserverFunctions(
            law, observing, sample_period, control_lag, control_delay
        )
        self.observation = observation = found.observation
        size, names = len(observation.rows), list(observation.frictions)
        self.disturbance_signals = tuple(
            Signal(f"disturbance of {system.state_signals[i].name}") for i in observation.rows
        )
        self.friction_signals = tuple(Signal(name) for name in names)
        self._mu = slice(size, size + len(names))
        sizes = {
            "estimated_state": system.num_states,
            "control": system.num_controls,
            "measured_force": system.num_constraints,
            "hold": 1,
            "reference": law.layout.reference_size,
        }
        self._ports = {name: self.DeclareVectorInputPort(name, n) for name, n in sizes.items()}
        start = np.zeros(found.memory.column.numel())
        for j, name in enumerate(names, size):
            start[j : j + 1] = system.parameter_values[system.parameter_slice(name)]
        self._held = self.DeclareDiscreteState(start)
        # Unrestricted, as the step of a discrete MultibodyPlant: so all see one instant.
        self.DeclarePeriodicUnrestrictedUpdateEvent(sample_period, 0.0, weakly(self._sample))
        sources = {self.discrete_state_ticket(self._held), self.all_parameters_ticket()}
        for name, calc, count, read in (
            ("exogenous", self._calc_exogenous, found.exogenous.outputs[0].size, _READ),
            ("disturbance", self._calc_disturbance, size, ()),
            ("friction", self._calc_friction, len(names), ()),
            ("hold", self._calc_hold, 1, ("measured_force", "hold")),
        ):
            tickets = {self.input_port_ticket(self._ports[port].get_index()) for port in read}
            self.DeclareVectorOutputPort(name, count, weakly(calc), sources | tickets)

    @property
    def further_signals(self) -> dict[str, Sequence[Signal]]:
        """Name of an output port that a record has -> names and units of its entries."""
        known = {"disturbance": self.disturbance_signals, "friction": self.friction_signals}
        return {name: signals for name, signals in known.items() if signals}

    def set_friction(self, context: Context, friction: ArrayLike) -> None:
        """Starts the coefficients of friction at values, shape (c,), or a number for all.

        Raises:
            ModelError: The shape is wrong, or a value is negative or above the largest.
        """
        self.check_context(context)
        given, most = numbers("friction", friction), self.observing.largest_friction
        count = len(self.friction_signals)
        if given.shape not in ((), (count,)) or not np.all((given >= 0) & (given <= most)):
            raise ModelError(
                f"friction must be from 0 to {most:g}, a number or shape ({count},), got "
                f"{friction!r}"
            )
        values = context.get_discrete_state(self._held).CopyToVector()
        values[self._mu] = given
        context.SetDiscreteState(self._held, values)

    def _given(self, context: Context, *names: str) -> list[FloatArray]:
        return [self._ports[name].Eval(context) for name in names]

    def _holds(self, context: Context) -> FloatArray:
        """What the input port `hold` has; 0 without a wire."""
        port = self._ports["hold"]
        return np.asarray(port.Eval(context)) if port.HasValue(context) else np.zeros(1)

    def _sample(self, context: Context, state: State) -> EventStatus:
        x, u, force = self._given(context, "estimated_state", "control", "measured_force")
        held = context.get_discrete_state(self._held).value()
        given = held, u, force, self._holds(context)
        found = self._checked(self._functions.sample, context, x, *given)[0]
        state.get_mutable_discrete_state().set_value(self._held, found)
        return EventStatus.Succeeded()

    def _calc_exogenous(self, context: Context, output: BasicVector) -> None:
        x, force = self._given(context, "estimated_state", "measured_force")
        held, port = context.get_discrete_state(self._held).value(), self._ports["reference"]
        if port.HasValue(context):
            reference = port.Eval(context)
        else:
            (reference,) = self._checked(self.observation.moving, context, x)
        function = self._functions.exogenous
        output.SetFromVector(self._checked(function, context, x, held, force, reference)[0])

    def _calc_disturbance(self, context: Context, output: BasicVector) -> None:
        held = context.get_discrete_state(self._held).value()
        output.SetFromVector(held[: self._mu.start])

    def _calc_friction(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state(self._held).value()[self._mu])

    def _calc_hold(self, context: Context, output: BasicVector) -> None:
        (force,) = self._given(context, "measured_force")
        output.SetFromVector(self._functions.hold.evaluate(force, self._holds(context))[0])

    def _formulas(self) -> dict[str, Formula]:
        raise ModelError(
            f"{self.get_name()} does not convert to AutoDiffXd: it samples, and a sample has no "
            "derivative by the time"
        )

    def traced(self) -> Block:
        functions, memory = self._functions, self._functions.memory
        read = ("estimated_state", HELD)
        told = (*read, "measured_force", "reference", PARAMETERS)
        sampled = (*read, "control", "measured_force", "hold", PARAMETERS)
        parts = [memory.disturbance, memory.friction]
        shown = ca.Function("shown", [memory.column], parts)
        moving = ("estimated_state", PARAMETERS)
        return Block(
            self,
            (
                Computation.of(functions.exogenous, told, ("exogenous",)),
                Computation.of(functions.hold, ("measured_force", "hold"), ("hold",)),
                Computation(shown, (HELD,), ("disturbance", "friction")),
            ),
            (
                Update(
                    Computation.of(functions.sample, sampled, (HELD,)),
                    self.sample_period,
                    is_unrestricted=True,
                ),
            ),
            unwired={
                "hold": Computation(ca.Function("none", [], [ca.SX.zeros(1)]), (), ("hold",)),
                "reference": Computation.of(self.observation.moving, moving, ("reference",)),
            },
            signals=self._signals,
            ports={"disturbance": self.disturbance_signals, "friction": self.friction_signals},
        )
