"""An observer of what a model lacks: a disturbance, and coefficients of friction."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import BasicVector, Context, EventStatus, State

from drake_dae.arguments import checked
from drake_dae.arrays import Booleans, FloatArray, numbers, positive
from drake_dae.dae.disturbance import DISTURBANCE, Observation
from drake_dae.dae.lags import Lags
from drake_dae.dae.signals import Signal
from drake_dae.dae.tracking import TrackingLaw
from drake_dae.errors import ModelError
from drake_dae.systems.block import ParameterizedSystem
from drake_dae.systems.failures import simulation_error
from drake_dae.systems.formulas import Formula
from drake_dae.systems.lifetime import SHARED_DICTIONARY, weakly
from drake_dae.trace.functions import TracedFunction


@checked(ModelError)
@dataclass(frozen=True)
class Observing:
    """How fast a `DisturbanceObserver` observes, and when it believes what it sees of friction.

    Attributes:
        rate: k_o in 1/s, at which a disturbance is found.
        friction_rate: k_f in 1/s, at which coefficients of friction take their share of it.
        largest_friction: Above which no coefficient of friction goes.
        least_speed: The speed of sliding, in m/s, below which a coefficient stands still.
        least_force: The force, in N, below which a contact is lost: its coefficient stands still,
            and so do integrals.

    Raises:
        ModelError: A number is not positive.
    """

    rate: float
    friction_rate: float = 3.0
    largest_friction: float = 1.0
    least_speed: float = 0.01
    least_force: float = 1.0

    def __post_init__(self) -> None:
        for name in ("rate", "friction_rate", "largest_friction", "least_speed", "least_force"):
            positive(name, getattr(self, name))


class _Friction(NamedTuple):
    """What friction does in a state: see `Observation.friction`."""

    forces: FloatArray
    shares: FloatArray
    speeds: FloatArray


@checked(ModelError)
class DisturbanceObserver(ParameterizedSystem):
    """Observes the disturbance d of E x' = f + S d + g v + h u, and identifies friction.

    At each sample, T apart, the momentum p = S^T E x tells what acted besides what is known,

        d_k = (p_k - p_(k-1)) / T - mean((S^T E)' x + S^T f) - S^T (h u + g v),

    of which r is low-passed with the rate k_o, r_k = e^(-k_o T) r_(k-1) + (1 - e^(-k_o T)) d_k: a
    constant d is found as 1 - e^(-k_o t), and noise n of the velocities, with M the mass, leaves
    about k_o M n of noise in r.

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
    `largest_friction`, and stands still where the contact slides by less than `least_speed`, or is
    pressed by less than `least_force`, since then friction does not tell its coefficient; also
    while the input `hold` is not 0. r needs no hold: it has the control that acts, also at its
    limits, and the force that is measured, also where a contact is open.

    Friction acts against the motion that the reference wants, c = c(x_w), where x_w is x with the
    velocities that follow from the reference and the constraints: where a motion turns or begins
    the contact sticks, and its own velocity tells no direction. So r is what is left beside
    mu c(x_w), and since the law's model has mu c(x), what it is told to cancel is
    r + mu (c(x_w) - c(x)). Where outputs and constraints do not determine the velocities, or
    `reference` has no wire, x_w = x. The speed of sliding is that by the power of friction, for
    surfaces that stand still.

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

    All but the last are held between samples; r starts at 0, and mu at the model's coefficients.

    Args:
        law: The law, for a system that `with_disturbance` made.
        observing: The rates, and when friction is believed.
        sample_period: T in s.
        control_lag: For which part of T the plant goes on with the control that the port had at a
            sample, from 0 to 1: all of it for a discrete plant of that step, none for a
            `ControlHold` without delay before a continuous one.

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
        self._lag = control_lag
        self.observation = found = Observation.of(law.structure)
        size, names = len(found.rows), list(found.frictions)
        self._lags = Lags.of(observing.rate, sample_period, max(law.exogenous_degrees))
        self.disturbance_signals = tuple(
            Signal(f"disturbance of {system.state_signals[i].name}") for i in found.rows
        )
        self.friction_signals = tuple(Signal(name) for name in names)
        self._mu = [system.parameter_slice(name) for name in names]
        self._contacts = list(found.frictions.values())
        self._order = self._told(names, law.exogenous_degrees)
        self._ports = [
            self.DeclareVectorInputPort("estimated_state", system.num_states),
            self.DeclareVectorInputPort("control", system.num_controls),
            self.DeclareVectorInputPort("measured_force", system.num_constraints),
        ]
        self._hold = self.DeclareVectorInputPort("hold", 1)
        self._reference = self.DeclareVectorInputPort("reference", law.layout.reference_size)
        # r, mu, what is to cancel, its derivatives, 0, and what r lags behind; then, of the sample
        # before, p, its rate without inputs, u.
        start = [system.parameter_values[place] for place in self._mu]
        count = self._lags.degree * size
        self._estimate = self.DeclareDiscreteState(
            np.concatenate([np.zeros(size), *start, np.zeros(size + count + 1 + count)])
        )
        self._before = self.DeclareDiscreteState(np.full(2 * size + system.num_controls, np.nan))
        # Unrestricted, as the step of a discrete MultibodyPlant: so all see one instant.
        self.DeclarePeriodicUnrestrictedUpdateEvent(sample_period, 0.0, weakly(self._sample))
        sources = {self.discrete_state_ticket(self._estimate)}
        for name, places_of in (
            ("exogenous", self._order),
            ("disturbance", list(range(size))),
            ("friction", list(range(size, size + len(names)))),
        ):
            calc = weakly(self._copy, places_of)
            self.DeclareVectorOutputPort(name, len(places_of), calc, sources)
        ports = (self._ports[2], self._hold)
        self.DeclareVectorOutputPort(
            "hold",
            1,
            weakly(self._calc_hold),
            {self.input_port_ticket(port.get_index()) for port in ports},
        )

    def _told(self, names: Sequence[str], degrees: Sequence[int]) -> list[int]:
        """Where the estimate has what the port `exogenous` tells."""
        size = len(self.observation.rows)
        last, following = size + len(names), 2 * size + len(names)
        still = following + self._lags.degree * size
        heads = {DISTURBANCE: list(range(last, last + size))}
        heads |= {name: [size + j] for j, name in enumerate(names)}
        order, left = list[int](), iter(degrees)
        for p in self.dae.exogenous.moving:
            for i, head in enumerate(heads[p.name]):
                of_d = [following + j * size + i for j in range(self._lags.degree)]
                known = of_d if p.name == DISTURBANCE else [still] * self._lags.degree
                order += [head, *known[: next(left)]]
        return order

    def set_friction(self, context: Context, friction: ArrayLike) -> None:
        """Starts the coefficients of friction at values, shape (c,), or a number for all.

        Raises:
            ModelError: The shape is wrong, or a value is negative or above the largest.
        """
        self.check_context(context)
        given, most = numbers("friction", friction), self.observing.largest_friction
        if given.shape not in ((), (len(self._mu),)) or not np.all((given >= 0) & (given <= most)):
            raise ModelError(
                f"friction must be from 0 to {most:g}, a number or shape ({len(self._mu)},), got "
                f"{friction!r}"
            )
        values = context.get_discrete_state(self._estimate).CopyToVector()
        size = len(self.observation.rows)
        values[size : size + len(self._mu)] = given
        context.SetDiscreteState(self._estimate, values)

    def _sample(self, context: Context, state: State) -> EventStatus:
        observation, observing, period = self.observation, self.observing, self.sample_period
        size = len(observation.rows)
        x, u, force = (port.Eval(context) for port in self._ports)
        estimate = context.get_discrete_state(self._estimate).CopyToVector()
        head, count = 2 * size + len(self._mu), self._lags.degree * size
        parts = [size, size + len(self._mu), head, head + count, head + count + 1]
        r, mu, cancelled, rates, _, lags = np.split(estimate, parts)
        chain = np.vstack([lags.reshape(-1, size), r])
        parameters = context.get_numeric_parameter(0).CopyToVector()
        for place, value in zip(self._mu, mu, strict=True):
            parameters[place] = value
        before = context.get_discrete_state(self._before).CopyToVector()
        p_0, rate_0, u_0 = np.split(before, [size, 2 * size])
        is_first = np.isnan(p_0[0])
        acted = u if is_first else self._lag * u_0 + (1.0 - self._lag) * u
        p, rate, inputs = self._run(observation.momentum, context, x, acted, force, parameters)
        turned = np.zeros(size)
        if mu.size:
            goal = self._wanted(context, x, parameters)
            moved, wanted = (self._friction(context, y, force, parameters) for y in (x, goal))
            turned = (wanted.forces - moved.forces) @ mu
        if not is_first:
            d = (p - p_0) / period - (rate_0 + rate) / 2.0 - inputs - turned
            chain = self._lags.after(chain, d)
        if mu.size and not self._is_limited(context):
            speeds = np.minimum(moved.speeds, wanted.speeds)
            is_sure = (speeds >= observing.least_speed) & ~self._is_lost(force)
            step = -np.expm1(-observing.friction_rate * period) * (moved.shares @ chain[-1])
            step = np.clip(mu + is_sure * step, 0.0, observing.largest_friction) - mu
            mu += step
            chain -= wanted.forces @ step
        lags[:], r[:] = chain[:-1].ravel(), chain[-1]
        cancelled[:] = r + turned
        rates[:] = self._lags.derivatives(chain).ravel()
        discrete = state.get_mutable_discrete_state()
        discrete.set_value(self._estimate, estimate)
        discrete.set_value(self._before, np.concatenate([p, rate, u]))
        return EventStatus.Succeeded()

    def _friction(
        self, context: Context, state: FloatArray, force: FloatArray, parameters: FloatArray
    ) -> "_Friction":
        """What friction does where the state is another one."""
        found = self._run(self.observation.friction, context, state, force, parameters)
        forces, shares, speeds = (np.array(one) for one in found)
        return _Friction(forces.reshape(len(self.observation.rows), -1), shares, speeds)

    def _wanted(self, context: Context, state: FloatArray, parameters: FloatArray) -> FloatArray:
        """The state with the velocities that the reference wants, as far as it is told."""
        function = self.observation.wanted
        if function is None or not self._reference.HasValue(context):
            return state
        return self._run(function, context, state, self._reference.Eval(context), parameters)[0]

    def _run(
        self, function: TracedFunction, context: Context, state: FloatArray, *inputs: FloatArray
    ) -> tuple[FloatArray, ...]:
        """The values of a function.

        Raises:
            SingularityError, NonFiniteError: There are none, at this time and state.
        """
        values = function.evaluate(state, *inputs)
        if function.is_valid:
            return values
        time, found = context.get_time(), function.failure()
        raise simulation_error(found, time, state.copy(), self._signals)

    def _is_limited(self, context: Context) -> bool:
        return bool(self._hold.HasValue(context) and self._hold.Eval(context).any())

    def _is_lost(self, force: FloatArray) -> Booleans:
        return np.asarray(force[self._contacts] < self.observing.least_force)

    def _calc_hold(self, context: Context, output: BasicVector) -> None:
        is_lost = bool(self._is_lost(self._ports[2].Eval(context)).any())
        output.SetFromVector([float(is_lost or self._is_limited(context))])

    def _copy(self, places: list[int], context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state(self._estimate).value()[places])

    def _formulas(self) -> dict[str, Formula]:
        raise ModelError(
            f"{self.get_name()} does not convert to AutoDiffXd: it samples, and a sample has no "
            "derivative by the time"
        )
