"""The computations of a `StateEstimator` at its samples, as traced functions."""

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae import TrackingLaw
from drake_dae.dae.beyond.chain_filter import ChainFilter
from drake_dae.dae.beyond.disturbance import DISTURBANCE
from drake_dae.dae.beyond.friction_share import beside, shares
from drake_dae.errors import ModelError
from drake_dae.systems.observing.break_away import BreakAway, SampledContacts, Slides
from drake_dae.systems.observing.estimate import Estimate
from drake_dae.systems.observing.observed import ContactTerms, Observed, disturbance_degree
from drake_dae.systems.observing.observer_rates import Observing
from drake_dae.trace.factorization import PositiveDefiniteFactorization
from drake_dae.trace.functions import TracedFunction


class EstimatorFunctions(Observed):
    """The functions of a `StateEstimator`, whose class has the equations.

    Attributes:
        estimate: The symbols of an estimate.
        size: The number of entries of an estimate.
        now: (xm, held, u, v, hold, time, parameters) -> the estimate of the present sample;
            held is the estimate of a sample before, with u, v and R of that sample. It has no
            argument u where the plant uses the previous control alone, and no v if the law measures
            no force.
        measures: Whether the constraint force is measured, or there is none.
        reads: The names of the ports of its arguments u, v and hold.
        exogenous: (x, estimate, v, R, parameters) -> the disturbance to compensate, mu, and their
            derivatives.

    Args:
        law, observing: The arguments of the estimator.
        period, lag, delay, step: Its `sample_period`, `control_lag`, `control_delay` and
            `plant_step`.
        filters: Its filters along the free and the constrained directions, one for each position.
        deviations: The standard deviations of measured positions, shape (k,), or 0.

    Raises:
        ModelError: The law's system has no disturbance, or is no robot with rigid joints.
    """

    def __init__(
        self,
        law: TrackingLaw,
        observing: Observing,
        period: float,
        lag: float,
        delay: float,
        step: float,
        filters: tuple[list[ChainFilter], list[ChainFilter]],
        deviations: FloatArray | float = 0.0,
    ) -> None:
        super().__init__(law, observing, period)
        system = self._system
        _check_rigid(law, self.observation.rows)
        if self.observation.identified.parameters:
            raise ModelError(
                f"{system.name}: with a state_rate only coefficients of friction of contacts are "
                "estimated; for other parameters leave it out, and measure the velocities or let "
                "the encoders form differences by a velocity_bandwidth"
            )
        self._lag, self._step, self._delay, self._filters = lag, step, delay, filters
        each = np.broadcast_to(deviations, (len(self.observation.rows),))
        self._first = BreakAway(self.observation, observing, period, each)
        self._breaks_away = bool(self.observation.frictions) and (
            self.observation.wanted is not None
        )
        self._reference = ca.SX.sym("R before", law.layout.reference_size)
        self.measures = law.measured_force is not None or not system.num_constraints
        forces = 0 if self.measures else system.num_constraints
        self.estimate = Estimate.of(system.num_states, len(self.observation.frictions), forces)
        self.size = self.estimate.column.numel()
        elimination = law.structure.elimination
        self._model_force = elimination.alpha, elimination.beta
        named = {"control": lag < 1.0, "measured_force": self.measures}
        named |= {"hold": True}
        self.reads = tuple(name for name, is_read in named.items() if is_read)
        self.now = self._estimated()
        self.exogenous = self.compensated(law, delay, self.estimate.column, self.estimate)

    def _estimated(self) -> TracedFunction:
        """The estimate of the present sample."""
        system, old, period = self._system, self.estimate, self._period
        measured, v, count = system.state, self._force, len(self.observation.rows)
        u = ca.SX.sym("control", system.num_controls)
        time, limited = ca.SX.sym("time"), ca.SX.sym("hold", 1)
        hold = ca.ne(limited, 0)
        last_u, last_v = (ca.SX.sym("before", symbol.numel()) for symbol in (u, v))
        acted = self._lag * last_u + (1.0 - self._lag) * u
        share = (1.0 + self._step / period) / 2.0  # A discrete plant's force is that of its step.
        force = share * v + (1.0 - share) * last_v

        # Prediction over a sample, from the middle of it; a discrete plant steps from its start.
        q, qd = old.state[:count], old.state[count:]
        r, mu = old.disturbance, old.friction
        middle = ca.vertcat(q + (period - self._step) / 2.0 * qd, qd)
        none = self._parameters(ca.SX.zeros(mu.numel()))
        contact = self.contact(middle, none)
        if not self.measures:
            force = v
        friction_force = ca.mtimes(contact.friction, mu)
        none[system.parameter_slice(DISTURBANCE)] = r + friction_force
        mass, push, damping = self._balance()(middle, acted, force, none)
        factors = stepping = PositiveDefiniteFactorization(mass)
        moves = mass
        if not damping.is_zero():  # Implicit, as in Drake's discrete plants: a light link is stiff.
            moves = mass + period * ca.diag(damping)
            stepping = PositiveDefiniteFactorization(moves)
        # A measured force has the reaction of the constraints to the friction that acts, and a
        # force of the model that to the friction of a contact that slides.
        through = ca.SX.eye(count) if self.measures else contact.free
        moved = qd + period * stepping.solve(push - ca.mtimes(through, friction_force))
        moved += self._rubbed(q, moved, stepping, through, none)
        is_unused, slides = ca.logic_or(self._is_lost, hold), Slides.of(old.slides)
        if self._breaks_away:
            stuck = self._side_by_side(contact.planes, self._first.is_stuck(slides, is_unused))
            metric = factors.solve if self.measures else contact.metric
            momentum = ca.mtimes(mass, moved)
            stopped = momentum - beside(stuck, metric, momentum)
            moved -= factors.solve(ca.mtimes(through, stopped))
        ahead = q + period * qd + (period + self._step) / 2.0 * (moved - qd)

        # Correction by the measurements, along the free and the constrained directions.
        steps = [
            by_position * (measured[:count] - ahead) + by_velocity * (measured[count:] - moved)
            for by_position, by_velocity in self._gains()
        ]
        free, constrained = steps[:3], steps[3:]
        difference = ca.horzcat(*free) - ca.horzcat(*constrained)
        turned = factors.solve(ca.mtimes(contact.free, ca.mtimes(mass, difference[:, :2])))
        new_q = ahead + constrained[0] + turned[:, 0]
        new_v = moved + constrained[1] + turned[:, 1]
        jump = ca.mtimes(moves, constrained[2])
        jump += ca.mtimes(contact.free, ca.mtimes(moves, difference[:, 2]))
        new_r = r + beside(contact.held, contact.metric, jump)

        # Friction takes its share of the disturbance, and all of it at the first break-away.
        change = self.change(contact, mu, new_r, hold)
        new_r -= ca.mtimes(contact.friction, change)
        if self._breaks_away:
            error = measured[:count] - ahead
            forces = self._developed(ca.vertcat(q, new_v), none)
            freed = ca.mtimes(contact.free, forces)
            along = factors.solve(freed)
            goal, contacts = self._contacts(
                middle, push - friction_force, forces, along, contact, is_unused, none
            )
            slide = self._first.corrected((middle, goal), error, contacts, v, none, slides)
            terms = forces, contact.planes, new_v, contact.metric
            late = slide.is_early * shares(*terms, ca.mtimes(mass, error))
            usual = self._filters[0][0].gain[:, 0]
            new_q += ca.mtimes(along, late * (slide.displacement - usual[0]))
            new_v += ca.mtimes(along, late * (slide.speed - usual[1]))
            new_r -= ca.mtimes(freed, slide.is_early * shares(*terms, new_r - r))
            b = -ca.sum1(forces * along).T / contacts.pressing
            change += slide.rise + slide.friction * b * late
            mu = ca.if_else(slide.begins, slide.start, mu)
            slides = slide.slides
        new_mu = ca.fmin(ca.fmax(mu + change, 0.0), self._observing.largest_friction)
        corrected = ca.vertcat(new_q, new_v, new_r, new_mu)
        start = ca.vertcat(measured, r, old.friction)
        known, valid = slides.column, contact.valid
        if not self.measures:
            by_model = self._forces(middle, r, old.friction, acted)
            given = [corrected, known, valid]
            corrected, known, valid = ca.substitute(given, [v], [by_model])
            ends = [0, 2 * count, 3 * count, corrected.numel()]
            state, new_r, new_mu = ca.vertsplit(corrected, ends)
            corrected = ca.vertcat(corrected, self._forces(state, new_r, new_mu, acted))
            start = ca.vertcat(start, ca.SX.zeros(v.numel()))  # No control has acted yet.
        corrected = ca.vertcat(corrected, known)
        start = ca.vertcat(start, old.slides)
        sample = ca.floor(time / period + _SAME)
        is_corrected = ca.logic_and(old.sample >= 0, ca.ne(old.sample, sample))
        fresh = ca.vertcat(sample, ca.if_else(old.sample >= 0, corrected, start))
        estimate = ca.if_else(ca.eq(old.sample, sample), old.column, fresh)
        symbols = {"control": u, "measured_force": v, "hold": limited}
        inputs = {name: symbols[name] for name in self.reads} | {"time": time}
        return system.trace(
            "estimate of the state",
            {"estimate": estimate, "valid": ca.if_else(is_corrected, valid, 0)},
            {"held": ca.vertcat(old.column, last_u, last_v, self._reference), **inputs},
        )

    def _developed(self, state: ca.SX, parameters: ca.SX) -> ca.SX:
        """The friction force per unit of each coefficient, fully developed, shape (k, c)."""
        friction = self.observation.friction.function
        return friction(self._faster(state), self._force, parameters)[0]

    def _rubbed(
        self,
        q: ca.SX,
        moved: ca.SX,
        mass: PositiveDefiniteFactorization,
        through: ca.SX,
        parameters: ca.SX,
    ) -> ca.SX:
        """The change of velocities by friction over a sample.

        It is implicit: against the velocity that there would be without it, which it at most stops.
        Otherwise it would turn a light tool about from sample to sample.
        """
        forces = self._developed(ca.vertcat(q, moved), parameters)
        made = self._period * mass.solve(ca.mtimes(through, forces))
        stopping = -ca.mtimes(forces.T, moved) / ca.fmax(ca.sum1(forces * made).T, _LITTLE)
        # The noise of a force sensor may be less than zero.
        return ca.mtimes(made, ca.fmin(self.estimate.friction, ca.fmax(stopping, 0.0)))

    def _contacts(
        self,
        x: ca.SX,
        push: ca.SX,
        forces: ca.SX,
        accelerations: ca.SX,
        contact: ContactTerms,
        is_unused: ca.SX,
        parameters: ca.SX,
    ) -> tuple[ca.SX, SampledContacts]:
        """The state with the wanted velocities, and the contacts for their first break-away."""
        wanted, frictions = self.observation.wanted, self.observation.frictions.values()
        assert wanted is not None
        goal = wanted.function(x, self._reference, self._delay, parameters)[0]
        towards = self._developed(goal, parameters)
        terms = towards, contact.planes, goal[list(self.observation.rows)], contact.metric
        pressing = ca.fmax(ca.fabs(self._force[list(frictions)]), _LITTLE)
        needed = ca.fmin(-shares(*terms, push), self._observing.largest_friction)
        mu, planes = self.estimate.friction, contact.planes
        moves = forces, accelerations, towards
        return goal, SampledContacts(planes, *moves, mu, needed, pressing, is_unused)

    def _forces(self, state: ca.SX, r: ca.SX, mu: ca.SX, control: ca.SX) -> ca.SX:
        """v = alpha(x) + beta(x) u (25) with the observed disturbance and friction."""
        system, (alpha, beta) = self._system, self._model_force
        parameters = self._parameters(mu)
        parameters[system.parameter_slice(DISTURBANCE)] = r
        inputs = [system.state, system.parameter_symbol]
        function = ca.Function("force", inputs, [alpha, ca.densify(beta)])
        alpha, beta = function(state, parameters)
        return alpha + ca.mtimes(beta, control)

    def _balance(self) -> ca.Function:
        """(x, u, v, parameters) -> M, the total force without M v', and the joints' damping."""
        system, rows = self._system, list(self.observation.rows)
        u, v, speed = ca.SX.sym("u", system.num_controls), self._force, self._system.state[rows]
        push = system.f + ca.mtimes(system.g, v) + ca.mtimes(system.h, u)
        dry = self._dry(system.state, system.parameter_symbol)
        smooth, turning = (
            [-ca.jacobian(force[i], speed[i]) for i in range(len(rows))]
            for force in (system.f[rows] - dry, dry)
        )
        damping = ca.substitute(ca.vertcat(*smooth), speed, 0 * speed)  # Without Coriolis forces.
        damping += ca.vertcat(*turning)
        inputs = [system.state, u, v, system.parameter_symbol]
        outputs = [system.mass_matrix[rows, rows], push[rows], ca.sparsify(ca.simplify(damping))]
        return ca.Function("balance", inputs, outputs)

    def _gains(self) -> list[tuple[ca.DM, ca.DM]]:
        """The gains of q, v and a by errors of positions and velocities; free, constrained."""
        pairs = []
        for filters in self._filters:
            gains = np.zeros((len(filters), 3, 2))
            for i, chain_filter in enumerate(filters):
                gains[i, :, : chain_filter.gain.shape[1]] = chain_filter.gain
            pairs += [tuple(ca.DM(gains[:, j, e]) for e in range(2)) for j in range(3)]
        return pairs


_LITTLE = 1e-9
"""The least normal force, in N, by which is divided."""

_SAME = 1e-9
"""Times that differ by less than this, in periods, count as equal."""


def _check_rigid(law: TrackingLaw, rows: tuple[int, ...]) -> None:
    system, count = law.system, len(rows)
    is_rigid = rows == tuple(range(count, 2 * count)) and system.num_states == 2 * count
    if not is_rigid or disturbance_degree(law):
        raise ModelError(
            f"{system.name}: a state_rate is for robots with rigid joints, whose states are "
            "positions and velocities; behind springs, motors or valves measure the velocities, "
            "or let the encoders form differences by a velocity_bandwidth"
        )
    slope = system.f[:count] - system.state[count:]
    if not ca.simplify(slope).is_zero():
        raise ModelError(
            f"{system.name}: a state_rate needs q' = v, and this robot has a body with "
            "q' = N(q) v; measure its velocities"
        )


def state_filters(
    observing: Observing, period: float, position: FloatArray, velocity: FloatArray
) -> tuple[list[ChainFilter], list[ChainFilter]]:
    """The filters of positions along the free and along the constrained directions.

    Args:
        observing: The rates, with a state_rate.
        period: T in s.
        position: The standard deviations of measured positions, shape (k,).
        velocity: Those of measured velocities, 0 where none is measured, shape (k,).

    Raises:
        ModelError: A rate is too high for the samples.
    """
    ratios = [
        v / q if v > 0.0 and q > 0.0 else None for q, v in zip(position, velocity, strict=True)
    ]
    rates, fast = (observing.rate, observing.force_rate or observing.rate), observing.state_rate
    if fast is None:
        raise ModelError("a StateEstimator needs the state_rate of its Observing, got None")
    free, constrained = (
        [ChainFilter.of(fast, rate, period, ratio) for ratio in ratios] for rate in rates
    )
    return free, constrained
