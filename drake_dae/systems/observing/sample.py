"""The equations of a `StateEstimator` at a sample, as expressions."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Self

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.blocks.block import TIME, where_finite
from drake_dae.dae import Lags, Observation, TrackingLaw
from drake_dae.dae.beyond.disturbance import DISTURBANCE, estimated_within
from drake_dae.dae.beyond.filters import ChainFilter
from drake_dae.dae.beyond.friction_share import beside, shares
from drake_dae.errors import ModelError
from drake_dae.systems.observing.contacts import LITTLE, Contacts, ContactTerms
from drake_dae.systems.observing.observing import Observing
from drake_dae.systems.observing.parameters import ParameterFilter
from drake_dae.trace.factorization import PositiveDefiniteFactorization

PARAMETER_PERIOD = 0.01
"""The time in s, in whole samples, between samples of the filter of parameters."""

_DEVELOPED = 0.9
"""A joint moves where its Coulomb friction has this share of its full size."""

_SAME = 1e-9
"""Times that differ by less than this, in periods, count as equal."""


@dataclass(frozen=True, eq=False)
class Memory:
    """What is held between samples, as columns that are stacked; some are empty.

    Attributes:
        sample: The index k of the sample t_k = k T; -1 before the first.
        state: The estimated x, if it is estimated.
        disturbance, rates, lags: r; r', ..., r^(n); the inputs of the lags before r.
        friction: mu.
        slid: The samples for which each contact has slid, while they are few.
        force: The constraint force of the model, if none is measured.
        momentum, drift: p and its rate without inputs, if the state is exact.
        control, measured_force: u and v of the sample before.
        theta, regressor: The parameters, and Y of the `ParameterFilter`, shape (k c,).
        momentum_slopes, drift_slopes: The derivatives of p and its rate with respect to theta.
        rests: Whether a contact sticks.
    """

    sample: ca.SX
    state: ca.SX
    disturbance: ca.SX
    rates: ca.SX
    lags: ca.SX
    friction: ca.SX
    slid: ca.SX
    force: ca.SX
    momentum: ca.SX
    drift: ca.SX
    control: ca.SX
    measured_force: ca.SX
    theta: ca.SX
    regressor: ca.SX
    momentum_slopes: ca.SX
    drift_slopes: ca.SX
    rests: ca.SX

    @classmethod
    def of(cls, column: ca.SX, sizes: dict[str, int]) -> Self:
        ends = [0, *accumulate(sizes[name] for name in cls.__dataclass_fields__)]
        return cls(*ca.vertsplit(column, ends))

    @property
    def column(self) -> ca.SX:
        return ca.vertcat(*vars(self).values())


def disturbance_degree(law: TrackingLaw) -> int:
    """The number of derivatives of the disturbance that a law needs."""
    degrees = iter(law.exogenous_degrees)
    own = {
        p.name: [next(degrees) for _ in range(p.value.size)] for p in law.system.exogenous.moving
    }
    return max(own[DISTURBANCE])


class EstimatorSample:
    """The estimate at a sample.

    Attributes:
        observation: The observed functions.
        inputs: The symbols of the input ports.
        filter: The filter of parameters.
        memory, sizes: What was held before, as symbols, and the sizes of its parts.
        start: Its initial value.
        now: What is held from this sample on. If the state is estimated, it is the same until the
            next one, so that outputs may depend on it.
        state, force: The state and the constraint force that the law takes.
        exogenous: The disturbance to compensate, mu and parameters, with derivatives.
        hold: 1 if integrals are not updated, otherwise 0.
    """

    def __init__(
        self,
        law: TrackingLaw,
        observing: Observing,
        period: float,
        lag: float,
        delay: float,
        step: float,
        deviations: tuple[FloatArray, FloatArray],
        is_ideal: bool,
    ) -> None:
        self.observation = observation = Observation.of(law.structure, law.layout)
        self._law, self._system, self._observing, self._period = law, law.system, observing, period
        self._lag, self._step = lag, step
        estimates = observing.state_rate is not None
        system, k, c = law.system, len(observation.rows), len(observation.frictions)
        degree, n = disturbance_degree(law), system.num_states
        if estimates:
            _check_rigid(law, observation.rows)
            self._gains = _gains(observing, period, *deviations)
        rates = observing.rate, observing.force_rate or observing.rate
        self._lags = [Lags.of(rate, period, degree) for rate in rates]
        self._breaks_away = bool(c) and observation.wanted is not None and not degree
        self.measures = (
            not estimates or law.measured_force is not None or not system.num_constraints
        )
        identified = observation.identified
        entries = (system.parameter_slice(p.name) for p in identified.parameters)
        self._places = [i for part in entries for i in range(part.start, part.stop)]
        if self._places and degree:
            raise ModelError(
                f"{system.name}: parameters are estimated for rigid joints; behind springs "
                "and motors only coefficients of friction are"
            )
        known, values = len(self._places), system.parameter_values
        self._ratio = max(round(PARAMETER_PERIOD / period), 1)
        self.filter = ParameterFilter(
            identified,
            estimated_within(identified.parameters, observing.ranges),
            c,
            observing.largest_friction,
            rates[0],
            self._ratio * period,
        )
        exact = 0 if estimates else k
        self.sizes = {
            "sample": 1,
            "state": n if estimates else 0,
            "disturbance": k,
            "rates": degree * k,
            "lags": degree * k,
            "friction": c,
            "slid": c,
            "force": 0 if self.measures else system.num_constraints,
            "momentum": exact,
            "drift": exact,
            "control": system.num_controls,
            "measured_force": system.num_constraints if estimates and self.measures else 0,
            "theta": known,
            "regressor": k * (known + c) if known else 0,
            "momentum_slopes": k * known,
            "drift_slopes": k * known,
            "rests": 1 if known else 0,
        }
        ports = {
            "measured_state": n,
            "control": system.num_controls,
            "hold": 1,
            "reference": law.layout.reference_size,
            "measured_force": system.num_constraints if self.measures else 0,
        }
        self.inputs = {name: ca.SX.sym(name, size) for name, size in ports.items()}
        if not self.measures:
            del self.inputs["measured_force"]
        self._contacts = Contacts(
            observation,
            observing,
            period,
            delay,
            is_ideal and not estimates,
            deviations[0],
            self.inputs["reference"],
            self.inputs["hold"],
        )
        self.memory = Memory.of(ca.SX.sym("held", sum(self.sizes.values())), self.sizes)
        self._before = self._adopted()
        self.start = np.zeros(sum(self.sizes.values()))
        self.start[0] = -1.0
        for name, value in zip(observation.frictions, range(c), strict=True):
            self.start[self.place("friction")][value] = values[system.parameter_slice(name)][0]
        self.start[self.place("theta")] = values[self._places]

        sample = ca.floor(TIME / period + _SAME)
        after = self._estimated() if estimates else self._observed(sample)
        # What blocks share is found again later; once here saves a fifth of the operations.
        after = Memory.of(ca.cse(after.column), self.sizes)
        if estimates:
            # The state before the first sample is zero, where a contact may have no direction.
            given = {"state": self._measured, "control": self.inputs["control"]}
            given |= {"measured_force": self._measured_force} if self.measures else {}
            first = Memory(**{**vars(self.memory), **given})
            begun = ca.if_else(self.memory.sample >= 0, after.column, first.column)
            fresh = ca.vertcat(sample, begun[1:])
            column = ca.if_else(ca.eq(self.memory.sample, sample), self.memory.column, fresh)
            self.now = Memory.of(column, self.sizes)
            self.state, known_now = self.now.state, self.now
        else:
            self.now, self.state, known_now = after, self._measured, self.memory
        self.force = self._measured_force if self.measures else known_now.force
        self.exogenous = self._compensated(self.state, self.force, known_now)
        lost = self._contacts.is_lost(self.force)
        self.hold = ca.fmax(self.inputs["hold"] != 0, ca.mmax(lost) if c else 0)

    def place(self, name: str) -> slice:
        """The place of a part of the memory."""
        end = sum(list(self.sizes.values())[: list(self.sizes).index(name) + 1])
        return slice(end - self.sizes[name], end)

    @property
    def _measured(self) -> ca.SX:
        return self.inputs["measured_state"]

    @property
    def _measured_force(self) -> ca.SX:
        return self.inputs["measured_force"]

    def _parameters(self, friction: ca.SX | None = None, theta: ca.SX | None = None) -> ca.SX:
        """The model's parameters with estimates, and with given or no friction."""
        parameters = ca.SX(self._system.parameter_symbol)
        parameters[self._places] = self._before.theta if theta is None else theta
        for j, name in enumerate(self.observation.frictions):
            value = 0 if friction is None else friction[j]
            parameters[self._system.parameter_slice(name)] = value
        return parameters

    # The exact state.

    def _observed(self, sample: ca.SX) -> Memory:
        """What is held after a sample of the exact state."""
        memory, x, v, u = self._before, self._measured, self._measured_force, self.inputs["control"]
        mu, has_sample = memory.friction, memory.sample >= 0
        parameters = self._parameters()
        late = self._lag * has_sample
        acted = late * memory.control + (1.0 - late) * u
        momentum = self.observation.momentum.function(x, acted, v, parameters)
        contact = self._contacts.terms(x, v, parameters)
        p, drift, inputs = momentum[:3]
        d = (p - memory.momentum) / self._period - (memory.drift + drift) / 2.0 - inputs
        d -= ca.mtimes(contact.friction, mu)

        # Each lag is a column.
        size = len(self.observation.rows)
        chain = ca.horzcat(ca.reshape(memory.lags, size, -1), memory.disturbance)
        chain = self._passed(contact, chain, d)
        chain, change = self._shared(chain, contact)
        early, slid = 0 * mu, memory.slid
        if self._breaks_away:  # Springs answer jumps by swings.
            early, slid = self._contacts.early(slid, contact, x, v, parameters, d)
        moves, (fast, slow) = ca.mtimes(contact.free, chain), self._lags
        rates = fast.derivatives(moves) + slow.derivatives(chain - moves)
        valid = momentum[-1] + contact.valid
        after = {
            "sample": sample if self._places else ca.SX(1.0),
            "disturbance": chain[:, -1],
            "rates": ca.vec(rates),
            "lags": ca.vec(chain[:, :-1]),
            "friction": self._bounded(mu + change + early),
            "slid": slid,
            "momentum": p,
            "drift": drift,
            "control": u,
            **self._regressed(x, v, acted, contact, parameters),
        }
        after = {name: where_finite(value, valid) for name, value in after.items()}
        return Memory(**{**vars(memory), **after})

    def _passed(self, contact: ContactTerms, chain: ca.SX, signal: ca.SX) -> ca.SX:
        """The lags of a signal after a sample; what a sticking contact may hide does not enter."""
        by_fast, by_slow = (
            beside(
                contact.held,
                contact.metric,
                (self.memory.sample >= 0) * (lags.after(chain, signal) - chain),
            )
            for lags in self._lags
        )
        return chain + by_slow + ca.mtimes(contact.free, by_fast - by_slow)

    def _bounded(self, mu: ca.SX) -> ca.SX:
        return ca.fmin(ca.fmax(mu, 0.0), self._observing.largest_friction)

    def _shared(self, chain: ca.SX, contact: ContactTerms) -> tuple[ca.SX, ca.SX]:
        """r with its lags without the share of friction, and the change of mu.

        With parameters friction is one of them.
        """
        mu = self._before.friction
        if self._places:
            return chain, 0 * mu
        gain = -np.expm1(-self._observing.friction_rate * self._period)
        terms = contact.friction, contact.planes, contact.velocity, contact.metric
        after = self._bounded(mu + contact.slides * gain * shares(*terms, chain[:, -1]))
        change = ca.if_else(self.inputs["hold"] != 0, 0, after - mu)
        share = ca.mtimes(contact.friction, change)
        return chain - ca.repmat(share, 1, chain.shape[1]), change

    # Parameters.

    def _adopted(self) -> Memory:
        """What was held, with the last change of the parameters, whose filter is slower."""
        memory, known, size = self.memory, len(self._places), len(self.observation.rows)
        if not known:
            return memory
        rest = memory.sample / self._ratio  # Whole exactly after a sample of the filter.
        is_new = ca.eq(rest, ca.floor(rest))
        change = ca.if_else(is_new, self.filter.change, 0)
        moves = {
            "disturbance": -ca.mtimes(ca.reshape(memory.regressor, size, -1), change),
            "friction": change[known:],
            "theta": change[:known],
        }
        if memory.momentum.numel():
            for name in ("momentum", "drift"):
                slopes = ca.reshape(vars(memory)[f"{name}_slopes"], size, -1)
                moves[name] = ca.mtimes(slopes, change[:known])
        moved = {name: vars(memory)[name] + move for name, move in moves.items()}
        return Memory(**{**vars(memory), **moved})

    def _regressed(
        self, x: ca.SX, v: ca.SX, acted: ca.SX, contact: ContactTerms, parameters: ca.SX
    ) -> dict[str, ca.SX]:
        """Y after a sample, low-pass filtered as r is, and what it is made of."""
        memory, size, known = self.memory, len(self.observation.rows), len(self._places)
        if not known:
            return {}
        slopes = self.observation.identified.slopes.function(x, acted, v, parameters)
        momentum, drift, inputs = slopes[:3]
        before, drifted = (
            ca.reshape(each, size, -1) for each in (memory.momentum_slopes, memory.drift_slopes)
        )
        own = (drift + drifted) / 2.0 + inputs - (momentum - before) / self._period
        for place in self._dry_places():  # A joint that rests may have any friction.
            own[:, place] *= ca.mmax(ca.fabs(drift[:, place])) > _DEVELOPED
        sliding = ca.mtimes(contact.friction, ca.diag(contact.slides))
        signal, old = ca.horzcat(own, sliding), ca.reshape(memory.regressor, size, -1)
        fast, slow = (float(lags.gain[0]) * (signal - old) for lags in self._lags)
        step = slow + ca.mtimes(contact.free, fast - slow)
        rests = ca.mmax(contact.sticks) if contact.sticks.numel() else ca.SX(0)
        is_used = ca.logic_and(memory.sample >= 0, ca.logic_not(rests))
        return {
            "regressor": ca.vec(ca.if_else(is_used, old + step, old)),
            "momentum_slopes": ca.vec(momentum),
            "drift_slopes": ca.vec(drift),
            "rests": rests,
        }

    def _dry_places(self) -> list[int]:
        """The indices in theta of Coulomb friction in joints."""
        names = [
            p.name for p in self.observation.identified.parameters for _ in range(p.value.size)
        ]
        return [i for i, name in enumerate(names) if name in self._system.dry]

    def filtered(self) -> ca.SX:
        """What the filter of parameters holds after a sample of its own."""
        memory, identified = self.memory, self.observation.identified
        estimates = memory.state.numel() > 0
        x = memory.state if estimates else self._measured
        v = self._measured_force
        if estimates:
            v = memory.measured_force if self.measures else memory.force
        rows, k = list(self.observation.rows), len(self.observation.rows)
        parameters = self._parameters()
        mass = self._system.mass_matrix[rows, rows]
        before, after = [self._system.state, self._system.parameter_symbol], [x, parameters]
        gaps = identified.slopes.function(x, memory.control, v, parameters)[3:6]
        forces = v[list(identified.pressed), :]
        excused = ca.logic_or(self.inputs["hold"] != 0, memory.rests)
        return self.filter.after(
            ca.vertcat(memory.theta, memory.friction),
            memory.disturbance,
            ca.reshape(memory.regressor, k, -1),
            ca.diag(ca.substitute([mass], before, after)[0]),
            gaps,
            forces,
            forces >= self._observing.least_force,
            ca.logic_and(memory.sample >= 0, ca.logic_not(excused)),
        )

    # The state from encoders.

    def _estimated(self) -> Memory:
        """What is held after a sample of measured positions."""
        system, old, period, measured = self._system, self._before, self._period, self._measured
        u, count = self.inputs["control"], len(self.observation.rows)
        acted = self._lag * old.control + (1.0 - self._lag) * u

        # Prediction over a sample, from the middle of it; a discrete plant steps from its start.
        q, qd, r, mu = old.state[:count], old.state[count:], old.disturbance, old.friction
        middle = ca.vertcat(q + (period - self._step) / 2.0 * qd, qd)
        parameters = self._parameters()
        if self.measures:  # A discrete plant's force is that of its step.
            v, share = self._measured_force, (1.0 + self._step / period) / 2.0
            force = share * v + (1.0 - share) * old.measured_force
        else:
            force = v = self._model_force(middle, r, mu, acted)
        contact = self._contacts.terms(middle, v, parameters)
        friction_force = ca.mtimes(contact.friction, mu)
        pushed = ca.SX(parameters)
        pushed[system.parameter_slice(DISTURBANCE)] = r + friction_force
        mass, push, damping = self._balance()(middle, acted, force, pushed)
        factors = stepping = PositiveDefiniteFactorization(mass)
        moves = mass
        if not damping.is_zero():  # Implicit, as in Drake's discrete plants: a light link is stiff.
            moves = mass + period * ca.diag(damping)
            stepping = PositiveDefiniteFactorization(moves)
        # A measured force has the reaction of the constraints to the friction that acts, and a
        # force of the model that to the friction of a contact that slides.
        through = ca.SX.eye(count) if self.measures else contact.free
        moved = qd + period * stepping.solve(push - ca.mtimes(through, friction_force))
        moved += self._rubbed(q, moved, v, stepping, through, parameters)
        unused = ca.logic_or(self._contacts.is_lost(v), self.inputs["hold"] != 0)
        if self._breaks_away:  # What has not slid yet sticks, with any friction that this needs.
            sticks = ca.logic_not(ca.logic_or(unused, old.slid > 0))
            stuck = self._contacts.side_by_side(contact.planes, sticks)
            metric = factors.solve if self.measures else contact.metric
            momentum = ca.mtimes(mass, moved)
            stopped = momentum - beside(stuck, metric, momentum)
            moved -= factors.solve(ca.mtimes(through, stopped))
        ahead = q + period * qd + (period + self._step) / 2.0 * (moved - qd)

        # Correction by the measurements, along the free and the constrained directions.
        errors = measured[:count] - ahead, measured[count:] - moved
        free, constrained = (
            ca.horzcat(*(own[:, 0] * errors[0] + own[:, 1] * errors[1] for own in gains))
            for gains in self._gains
        )
        difference = free - constrained
        turned = factors.solve(ca.mtimes(contact.free, ca.mtimes(mass, difference[:, :2])))
        new_q = ahead + constrained[:, 0] + turned[:, 0]
        new_v = moved + constrained[:, 1] + turned[:, 1]
        jump = ca.mtimes(moves, constrained[:, 2])
        jump += ca.mtimes(contact.free, ca.mtimes(moves, difference[:, 2]))
        new_r = r + beside(contact.held, contact.metric, jump)

        # Friction and parameters take their share of the disturbance.
        state = ca.vertcat(new_q, new_v)
        new_r, change = self._shared(new_r, contact)
        slid = old.slid
        if self._breaks_away:
            early, slid, jumps, is_early = self._contacts.slipped(
                old.slid,
                contact,
                middle,
                new_v,
                v,
                parameters,
                ca.mtimes(mass, errors[0]),
                errors[0],
                factors,
                unused,
                [float(gain[0, 0]) for gain in self._gains[0][:2]],
            )
            forces = self._contacts.developed(ca.vertcat(q, new_v), v, parameters)
            terms = forces, contact.planes, new_v, contact.metric
            taken = ca.mtimes(contact.free, forces)
            new_r -= ca.mtimes(taken, is_early * shares(*terms, new_r - r))
            change += early
            state += jumps
        mu = self._bounded(mu + change)
        after = {
            "state": state,
            "disturbance": new_r,
            "friction": mu,
            "slid": slid,
            "control": u,
            **self._regressed(state, v, acted, contact, parameters),
        }
        if self.measures:
            after["measured_force"] = v
        else:
            after["force"] = self._model_force(state, new_r, mu, acted)
        after = {name: where_finite(value, contact.valid) for name, value in after.items()}
        return Memory(**{**vars(old), **after})

    def _rubbed(
        self,
        q: ca.SX,
        moved: ca.SX,
        v: ca.SX,
        mass: PositiveDefiniteFactorization,
        through: ca.SX,
        parameters: ca.SX,
    ) -> ca.SX:
        """The change of velocities by friction over a sample.

        It is implicit: against the velocity that there would be without it, which it at most stops.
        Otherwise it would turn a light tool about from sample to sample.
        """
        forces = self._contacts.developed(ca.vertcat(q, moved), v, parameters)
        made = self._period * mass.solve(ca.mtimes(through, forces))
        stopping = -ca.mtimes(forces.T, moved) / ca.fmax(ca.sum1(forces * made).T, LITTLE)
        # The noise of a force sensor may be less than zero.
        return ca.mtimes(made, ca.fmin(self._before.friction, ca.fmax(stopping, 0.0)))

    def _model_force(self, state: ca.SX, r: ca.SX, mu: ca.SX, control: ca.SX) -> ca.SX:
        """v = alpha(x) + beta(x) u (25) with the observed disturbance and friction."""
        system, elimination = self._system, self._law.structure.elimination
        parameters = self._parameters(mu)
        parameters[system.parameter_slice(DISTURBANCE)] = r
        terms = [elimination.alpha, ca.densify(elimination.beta)]
        function = ca.Function("force", [system.state, system.parameter_symbol], terms)
        alpha, beta = function(state, parameters)
        return alpha + ca.mtimes(beta, control)

    def _balance(self) -> ca.Function:
        """(x, u, v, parameters) -> M, the total force without M v', and the joints' damping."""
        system, rows = self._system, list(self.observation.rows)
        u, v = (ca.SX.sym("u", n) for n in (system.num_controls, system.num_constraints))
        push = system.f + ca.mtimes(system.g, v) + ca.mtimes(system.h, u)
        dry = self._made_by(system.dry, system.state, system.parameter_symbol)
        speed = system.state[rows]
        smooth, turning = (
            [-ca.jacobian(force[i], speed[i]) for i in range(len(rows))]
            for force in (system.f[rows] - dry, dry)
        )
        damping = ca.substitute(ca.vertcat(*smooth), speed, 0 * speed)  # Without Coriolis forces.
        damping += ca.vertcat(*turning)
        inputs = [system.state, u, v, system.parameter_symbol]
        outputs = [system.mass_matrix[rows, rows], push[rows], ca.sparsify(ca.simplify(damping))]
        return ca.Function("balance", inputs, outputs)

    # What the law takes.

    def _compensated(self, x: ca.SX, v: ca.SX, known: Memory) -> ca.SX:
        """The signals for the law: disturbance, coefficients of friction and their derivatives."""
        observation, mu = self.observation, known.friction
        parameters, r, valid = self._parameters(mu, known.theta), known.disturbance, ca.SX(0)
        if mu.numel() or self._system.dry:
            goal = x
            if observation.wanted is not None:
                goal, valid = self._contacts.goal(x, parameters)
            friction, goal_friction = (
                observation.friction.function(state, v, parameters)[0]
                for state in (x, self._contacts.faster(goal))
            )
            r = r + ca.mtimes(goal_friction - friction, mu)
            r = r + self._rubbing(goal, parameters) - self._rubbing(x, parameters)
        size, rates = r.numel(), known.rates
        rows = {DISTURBANCE: [[r[i], *rates[i::size].elements()] for i in range(size)]}
        for name, value in zip(observation.frictions, mu.elements(), strict=True):
            rows[name] = [[value]]
        values = iter(known.theta.elements())
        for p in observation.identified.parameters:
            rows[p.name] = [[next(values)] for _ in range(p.value.size)]
        stacked, degrees = list[ca.SX](), iter(self._law.exogenous_degrees)
        for p in self._system.exogenous.moving:
            for row in rows[p.name]:
                degree = next(degrees)
                stacked += [*row, *[ca.SX(0.0)] * degree][: 1 + degree]  # Others are constant.
        return where_finite(ca.vertcat(*stacked), valid)

    def _rubbing(self, state: ca.SX, parameters: ca.SX) -> ca.SX:
        """The generalized force of Coulomb and of estimated viscous friction in joints.

        A law that compensated too much of them at the actual velocities would be unstable.
        """
        estimated = {p.name for p in self.observation.identified.parameters}
        viscous = (f"{name.rpartition('.')[0]}.viscous" for name in self._system.dry)
        names = (*self._system.dry, *(name for name in viscous if name in estimated))
        return self._made_by(names, state, parameters)

    def _made_by(self, names: Sequence[str], state: ca.SX, parameters: ca.SX) -> ca.SX:
        """The part of the generalized force that is zero without these parameters, shape (k, 1)."""
        rows = list(self.observation.rows)
        if not names:
            return ca.SX(len(rows), 1)
        without = ca.SX(parameters)
        for name in names:
            without[self._system.parameter_slice(name)] = 0.0
        symbols = [self._system.state, self._system.parameter_symbol]
        f = ca.Function("f", symbols, [self._system.f[rows]])
        return f(state, parameters) - f(state, without)


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


def _gains(
    observing: Observing, period: float, position: FloatArray, velocity: FloatArray
) -> list[list[ca.DM]]:
    """Along the free and the constrained directions: the gains of q, v and a, shape (k, 2) each."""
    assert observing.state_rate is not None
    found = np.zeros((2, 3, position.size, 2))
    for which, rate in enumerate((observing.rate, observing.force_rate or observing.rate)):
        for i, (q, v) in enumerate(zip(position, velocity, strict=True)):
            ratio = v / q if v > 0.0 and q > 0.0 else None
            own = ChainFilter.of(observing.state_rate, rate, period, ratio).gain
            found[which, :, i, : own.shape[1]] = own
    return [[ca.DM(each) for each in gains] for gains in found]
