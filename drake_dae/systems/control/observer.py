"""An observer of model errors: a disturbance, and coefficients of friction."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import BasicVector, Context, EventStatus, State

from drake_dae.arguments import checked
from drake_dae.arrays import Booleans, FloatArray, numbers, positive
from drake_dae.dae.beyond.disturbance import DISTURBANCE, Observation, beside, shares
from drake_dae.dae.beyond.lags import Lags
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.errors import ModelError
from drake_dae.systems.blocks.block import ParameterizedSystem
from drake_dae.systems.blocks.failures import simulation_error
from drake_dae.systems.blocks.formulas import Formula
from drake_dae.systems.blocks.lifetime import SHARED_DICTIONARY, weakly
from drake_dae.systems.blocks.traced import Block, not_traced
from drake_dae.systems.control.observer_rates import Observing
from drake_dae.trace.functions import TracedFunction

_SHARP = 10.0
"""Friction is evaluated at this multiple of the velocity: it is full from v_s / 10 on."""


@checked(ModelError)
class DisturbanceObserver(ParameterizedSystem):
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
        reference: R, as that of the controller; may be without a wire.

    Output ports:
        exogenous: The disturbance to compensate, and mu, each with the derivatives that the law
            needs, for the port of a `TrackingController` with the same law.
        disturbance: r, shape (k,).
        friction: mu, shape (c,).
        hold: 1 while the input `hold` is not 0 or a frictional contact is lost, else 0, shape (1,):
            for the integrals of the controller.

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

    Attributes:
        observation: The observed functions.
        observing, sample_period: The arguments.
        disturbance_signals, friction_signals: Names and units of the output ports.

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
        self._lag, self._delay = control_lag, control_delay
        self.observation = found = Observation.of(law.structure)
        size, names = len(found.rows), list(found.frictions)
        rates = observing.rate, observing.force_rate or observing.rate
        self._lags, self._force_lags = (
            Lags.of(rate, sample_period, max(law.exogenous_degrees)) for rate in rates
        )
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
        # r, mu, the derivatives of r, 0, and the lags before r; then p, its rate without inputs and
        # u of the previous sample.
        start = [system.parameter_values[place] for place in self._mu]
        count = self._lags.degree * size
        self._estimate = self.DeclareDiscreteState(
            np.concatenate([np.zeros(size), *start, np.zeros(count + 1 + count)])
        )
        self._before = self.DeclareDiscreteState(np.full(2 * size + system.num_controls, np.nan))
        # Unrestricted, as the step of a discrete MultibodyPlant, so that all see the same instant.
        self.DeclarePeriodicUnrestrictedUpdateEvent(sample_period, 0.0, weakly(self._sample))
        sources = {self.discrete_state_ticket(self._estimate)}
        read = (self._ports[0], self._ports[2], self._reference)
        self.DeclareVectorOutputPort(
            "exogenous",
            len(self._order),
            weakly(self._calc_exogenous),
            sources | {self.input_port_ticket(port.get_index()) for port in read},
        )
        for name, places_of in (
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

    @property
    def further_signals(self) -> dict[str, Sequence[Signal]]:
        """Name of an output port in a record -> names and units of its entries."""
        known = {"disturbance": self.disturbance_signals, "friction": self.friction_signals}
        return {name: signals for name, signals in known.items() if signals}

    def _told(self, names: Sequence[str], degrees: Sequence[int]) -> list[int]:
        """The indices of the estimate for the entries of the port `exogenous`."""
        size = len(self.observation.rows)
        following = size + len(names)
        still = following + self._lags.degree * size
        heads = {DISTURBANCE: list(range(size))}
        heads |= {name: [size + j] for j, name in enumerate(names)}
        order, left = list[int](), iter(degrees)
        for p in self.dae.exogenous.moving:
            for i, head in enumerate(heads[p.name]):
                of_d = [following + j * size + i for j in range(self._lags.degree)]
                known = of_d if p.name == DISTURBANCE else [still] * self._lags.degree
                order += [head, *known[: next(left)]]
        return order

    def set_friction(self, context: Context, friction: ArrayLike) -> None:
        """Sets the initial coefficients of friction, shape (c,), or a number for all.

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
        count = self._lags.degree * size
        head = size + len(self._mu)
        r, mu, rates, _, lags = np.split(estimate, [size, head, head + count, head + count + 1])
        chain = np.vstack([lags.reshape(-1, size), r])
        parameters = self._parameters(context, 0.0 * mu)
        before = context.get_discrete_state(self._before).CopyToVector()
        p_0, rate_0, u_0 = np.split(before, [size, 2 * size])
        is_first = np.isnan(p_0[0])
        acted = u if is_first else self._lag * u_0 + (1.0 - self._lag) * u
        p, rate, inputs = self._run(observation.momentum, context, x, acted, force, parameters)
        frictional, speeds = self._friction(context, self._faster(x), force, parameters)
        is_slow, is_lost = speeds < _SHARP * observing.least_speed, self._is_lost(force)
        found = self._run(observation.directions, context, x, force, parameters)
        metric, free, planes = (one.reshape((size, -1), order="F").copy() for one in found)
        if not is_first:
            d = (p - p_0) / period - (rate_0 + rate) / 2.0 - inputs - frictional @ mu
            steps = [one.after(chain, d) - chain for one in (self._lags, self._force_lags)]
            # A sticking contact has any friction: r is not updated in its directions, or it would
            # take up that reaction and release it at the next motion.
            sticks = is_slow & ~is_lost
            if sticks.any():
                held = planes[:, np.repeat(sticks, size)]
                steps = [beside(held, metric, step.T).T for step in steps]
            fast, slow = steps
            chain += slow + (fast - slow) @ free.T
        if mu.size and not self._is_limited(context):
            is_sure = ~(is_slow | is_lost)
            part = -np.expm1(-observing.friction_rate * period) * shares(
                frictional, metric, chain[-1]
            )
            change = np.clip(mu + is_sure * part, 0.0, observing.largest_friction) - mu
            mu += change
            chain -= frictional @ change
        lags[:], r[:] = chain[:-1].ravel(), chain[-1]
        moves = chain @ free.T
        lagged = self._lags.derivatives(moves) + self._force_lags.derivatives(chain - moves)
        rates[:] = lagged.ravel()
        discrete = state.get_mutable_discrete_state()
        discrete.set_value(self._estimate, estimate)
        discrete.set_value(self._before, np.concatenate([p, rate, u]))
        return EventStatus.Succeeded()

    def _parameters(self, context: Context, friction: FloatArray) -> FloatArray:
        """The model's parameters with other coefficients of friction."""
        parameters = context.get_numeric_parameter(0).CopyToVector()
        for place, value in zip(self._mu, friction, strict=True):
            parameters[place] = value
        return parameters

    def _friction(
        self, context: Context, state: FloatArray, force: FloatArray, parameters: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """The friction of coefficients of 1 at a state, and the sliding speeds."""
        forces, speeds = self._run(self.observation.friction, context, state, force, parameters)
        return forces.reshape(len(self.observation.rows), -1).copy(), speeds.copy()

    def _faster(self, state: FloatArray) -> FloatArray:
        """The state with velocities so large that regularized friction is full."""
        found, rows = state.copy(), list(self.observation.rows)
        found[rows] *= _SHARP
        return found

    def _wanted(self, context: Context, state: FloatArray, parameters: FloatArray) -> FloatArray:
        """The state with the velocities of the reference at the time when the control acts.

        They have no noise, and at a reversal or start the contact sticks, so that its own velocity
        has no direction yet. The state itself without a reference, or if it does not determine
        the velocities.
        """
        function = self.observation.wanted
        if function is None or not self._reference.HasValue(context):
            return state
        wanted, delay = self._reference.Eval(context), np.array([self._delay])
        return self._run(function, context, state, wanted, delay, parameters)[0]

    def _run(
        self, function: TracedFunction, context: Context, state: FloatArray, *inputs: FloatArray
    ) -> tuple[FloatArray, ...]:
        """The values of a function.

        Raises:
            SingularityError, NonFiniteError: They are not valid, at this time and state.
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

    def _calc_exogenous(self, context: Context, output: BasicVector) -> None:
        values = context.get_discrete_state(self._estimate).CopyToVector()
        size = len(self.observation.rows)
        r, mu, _ = np.split(values, [size, size + len(self._mu)])
        if mu.any():
            x, force = self._ports[0].Eval(context), self._ports[2].Eval(context)
            parameters = self._parameters(context, mu)
            own, _ = self._friction(context, x, force, parameters)
            goal = self._faster(self._wanted(context, x, parameters))
            wanted, _ = self._friction(context, goal, force, parameters)
            r += (wanted - own) @ mu  # The law's model has mu c at the present velocity.
        output.SetFromVector(values[self._order])

    def _copy(self, places: list[int], context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state(self._estimate).value()[places])

    def _formulas(self) -> dict[str, Formula]:
        raise ModelError(
            f"{self.get_name()} does not convert to AutoDiffXd: it samples, and a sample has no "
            "derivative by the time"
        )

    def traced(self) -> Block:
        raise not_traced("an observer of disturbances")
