"""One estimator of what a law does not know: state, disturbance, friction and parameters."""

from collections.abc import Iterable, Sequence

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, positive
from drake_dae.blocks.block import TIME, Block, Held, stacked, where_finite
from drake_dae.blocks.lifetime import SHARED_DICTIONARY
from drake_dae.dae import Lags, Observation, Signal, TrackingLaw
from drake_dae.dae.disturbance import (
    DISTURBANCE,
    estimated_within,
    filter_gain,
    orthogonal_part,
    shares,
)
from drake_dae.errors import ModelError
from drake_dae.systems.break_away import Contacts, ContactTerms, Observing, slowed
from drake_dae.systems.estimator_parameters import MEMORY, NOISY_MEMORY, ParameterFilter, Regressor
from drake_dae.systems.plant import ParameterizedSystem
from drake_dae.systems.sensors import one_each
from drake_dae.trace.factorization import PositiveDefiniteFactorization

_PARAMETER_PERIOD, _NOISY_PERIOD = 0.01, 0.002
"""The time in s, in whole samples, between samples of the filter of parameters; and where the state
is estimated: slower samples would take its noise for slopes."""

_SAME = 1e-9
"""Times that differ by less than this, in periods, count as equal."""

Memory = dict[str, ca.SX]
"""What is held between samples, as columns by name, some of them empty."""


@checked(ModelError)
class StateEstimator(ParameterizedSystem):
    """Estimates what a law does not know: disturbance, friction, parameters, and the state.

    **Disturbance** r, in E x' = f + S d + g v + h u, by the momentum p = S^T E x that the model did
    not predict over a sample T: r_k = r_(k-1) + gain (p_k - predicted p_k) / T, with
    gain = 1 - e^(-k_o T), and k_n along the constrained directions.

    **State.** With exact velocities x is as measured. With a `state_rate` (rigid joints) it is
    predicted by the model with r, control and measured force, and corrected by

        q = q + K_1 e,    v = v + K_2 e,    r = r + M K_3 e,    e = qm - q,

    with the gains of the stationary Kalman filter of each position, `filter_gain`.

    **Friction** takes its share of r, mu' = k_f (c . r) / (c . c) with c = S^T dg/dmu v. Parameters
    that `with_disturbance` made exogenous, and friction beside them, follow by `ParameterFilter`.

    Input ports:
        measured_state: x, shape (n,). With a state_rate velocities count if they have noise.
        control, measured_force: The applied u, shape (p,), and v, shape (m,).
        hold: Not 0 while a drive is at its limit: mu and parameters then rest.
        reference: R of the controller; the current outputs and rates without a wire.

    Output ports:
        estimated_state: x, shape (n,); with a state_rate.
        exogenous: Disturbance, mu and parameters with the derivatives that the law needs.
        disturbance, friction: r, shape (k,), and mu, shape (c,).
        hold: 1 while the input `hold` is not 0 or a frictional contact is lost, else 0.
        identified, identified_deviation: Parameters with friction, and their deviations.

    Args:
        law, observing, sample_period: Of a system that `with_disturbance` made; the rates; T in s.
        control_lag: The share of T for which the previous control acts, at most 1.
        control_delay, plant_step: The mean time until a control acts, and a plant's step, in s.
        position_deviation, velocity_deviation: Of measurements; 0 for velocities not measured.
        is_ideal: Whether contacts are ideal, with the friction of the model.

    Raises:
        ModelError: The law's system has no disturbance, or no rigid joints with a state_rate.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(
        self,
        law: TrackingLaw,
        observing: Observing,
        sample_period: float,
        control_lag: float = 0.0,
        control_delay: float = 0.0,
        plant_step: float = 0.0,
        position_deviation: ArrayLike = 0.0,
        velocity_deviation: ArrayLike = 0.0,
        is_ideal: bool = False,
    ) -> None:
        if not 0.0 <= control_lag <= 1.0:
            raise ModelError(f"control_lag must be from 0 to 1, got {control_lag:g}")
        if not control_delay >= 0.0:
            raise ModelError(f"control_delay must be 0 s or more, got {control_delay:g} s")
        period = positive("sample_period", sample_period)
        sample = EstimatorSample(
            law,
            observing,
            period,
            control_lag,
            control_delay,
            plant_step,
            (
                one_each("position_deviation", position_deviation, law.system.num_states // 2),
                one_each("velocity_deviation", velocity_deviation, law.system.num_states // 2),
            ),
            is_ideal,
        )
        self.observing, self.sample_period = observing, period
        self.observation = sample.observation
        super().__init__(law.system, sample.block(), degrees=(), sees_steps=False)

    @property
    def further_signals(self) -> dict[str, Sequence[Signal]]:
        """Name of an output port in a record -> names and units of its entries."""
        recorded = ("disturbance", "friction", "identified", "identified_deviation")
        signals = {name: self.block.signals[name] for name in recorded}
        return {name: own for name, own in signals.items() if own and name in self.block.outputs}


class EstimatorSample:
    """The estimate at a sample.

    Held are the index k of the `sample` t_k = k T, -1 before the first; the estimated `state`; the
    `disturbance` r, its `rates` r', ..., r^(n), and the inputs of the `lags` before r; `friction`
    mu; the samples for which each contact has `slid`, while they are few; `momentum` p and `drift`,
    its rate without inputs, if the state is exact; `control` and `measured_force` of the sample
    before; and the parameters `theta`.
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
        self._law, self._observing, self._period = law, observing, period
        self._system = law.system
        self._lag, self._step = lag, step
        system, k, c = law.system, len(observation.rows), len(observation.frictions)
        estimates, degree = observing.state_rate is not None, disturbance_degree(law)
        rates = observing.rate, observing.force_rate or observing.rate
        if observing.state_rate is not None:
            _check_rigid(law, observation.rows)
            self._gains = _gains(observing.state_rate, rates, period, *deviations)
        self._lags = [Lags.of(rate, period, degree) for rate in rates]
        self._breaks_away = bool(c) and observation.wanted is not None and not degree
        identified, theta = observation.identified, observation.identified.parameters
        places = np.arange(system.parameter_values.size)
        self._places = [i for p in theta for i in places[system.parameter_slice(p.name)].tolist()]
        if self._places and degree:
            raise ModelError(
                f"{system.name}: parameters are estimated for rigid joints; behind springs "
                "and motors only coefficients of friction are"
            )
        ports = {
            "measured_state": system.num_states,
            "control": system.num_controls,
            "hold": 1,
            "reference": law.layout.reference_size,
            "measured_force": system.num_constraints,
        }
        self.inputs = {name: ca.SX.sym(name, size) for name, size in ports.items()}
        self._measured, self._control = self.inputs["measured_state"], self.inputs["control"]
        self._measured_force = self.inputs["measured_force"]
        signals = self.inputs["reference"], self.inputs["hold"]
        is_ideal = is_ideal and not estimates
        self._contacts = Contacts(
            observation, observing, period, delay, is_ideal, deviations[0], *signals
        )

        values = system.parameter_values
        frictions = [values[system.parameter_slice(name)][0] for name in observation.frictions]
        exact = [0.0] * (0 if estimates else k)
        start = {
            "sample": [-1.0],
            "state": [0.0] * (system.num_states if estimates else 0),
            "disturbance": [0.0] * k,
            "rates": [0.0] * (degree * k),
            "lags": [0.0] * (degree * k),
            "friction": frictions,
            "slid": [0.0] * c,
            "momentum": exact,
            "drift": exact,
            "control": [0.0] * system.num_controls,
            "measured_force": [0.0] * (self._measured_force.numel() if estimates else 0),
            "theta": values[self._places].tolist(),
        }
        self._memory = {name: ca.SX.sym(name, len(value)) for name, value in start.items()}
        wanted, lasting = (
            (_NOISY_PERIOD, NOISY_MEMORY) if estimates else (_PARAMETER_PERIOD, MEMORY)
        )
        slower = max(round(wanted / period), 1) * period
        within, most = estimated_within(theta, observing.ranges), observing.largest_friction
        self._filter = ParameterFilter(identified, within, c, most, rates[0], slower, lasting)
        self._ratio = round(slower / period)
        self._regressor = Regressor(system, observation, rates, slower, self._ratio, not estimates)
        self._before = self._adopted()

        sample = ca.floor(TIME / period + _SAME)
        after = self._estimated() if estimates else self._observed(sample)
        # What blocks share is found again later; once here saves a fifth of the operations.
        column, memory = ca.cse(stacked([*after.values()])), stacked([*self._memory.values()])
        self.shown, self.state = self._memory, self._measured
        if estimates:  # Outputs depend on this sample.
            # The state before the first sample is zero, where a contact may have no direction.
            given = {"state": self._measured, "control": self._control}
            first = self._memory | given | {"measured_force": self._measured_force}
            is_old = self._memory["sample"] >= 0
            begun = ca.if_else(is_old, column, stacked([*first.values()]))
            fresh = ca.vertcat(sample, begun[1:])
            column = ca.if_else(ca.eq(self._memory["sample"], sample), memory, fresh)
            ends = np.cumsum([0, *(value.numel() for value in after.values())])
            self.shown = dict(zip(after, ca.vertsplit(column, ends.tolist()), strict=True))
            self.state = self.shown["state"]
        self.held = {"memory": Held(memory, column, np.concatenate([*start.values()]), period)}
        if self._places:
            parts = ca.vertcat(self._filter.held, self._regressor.held)
            begin = np.zeros(parts.numel())
            begin[: self._filter.start.size] = self._filter.start
            self.held["parameters"] = Held(parts, self._filtered(), begin, slower)
        lost = self._contacts.is_lost(self._measured_force)
        self.hold = ca.fmax(self.inputs["hold"] != 0, ca.mmax(lost) if c else 0)

    def block(self) -> Block:
        """The block; see `StateEstimator`."""
        system, observation, shown = self._system, self.observation, self.shown
        frictions = tuple(Signal(name) for name in observation.frictions)
        theta = (*observation.identified.signals, *frictions)
        outputs = {
            **({"estimated_state": self.state} if shown["state"].numel() else {}),
            "exogenous": self._compensated(self.state, self._measured_force),
            "disturbance": shown["disturbance"],
            "friction": shown["friction"],
        }
        if self._places:
            outputs["identified"] = ca.vertcat(shown["theta"], shown["friction"])
            outputs["identified_deviation"] = self._filter.deviations
        rows = (system.state_signals[i].name for i in observation.rows)
        rates = observation.moving.function(self.state, system.parameter_symbol)[0]
        return Block(
            "state_estimator",
            self.inputs,
            {**outputs, "hold": self.hold},
            parameters=system.parameter_symbol,
            start={"parameters": system.parameter_values},
            held=self.held,
            defaults={"hold": ca.SX.zeros(1), "reference": rates},
            signals={
                "estimated_state": system.state_signals,
                "measured_state": system.state_signals,
                "control": system.control_signals,
                "measured_force": system.constraint_input_signals,
                "disturbance": tuple(Signal(f"disturbance of {name}") for name in rows),
                "friction": frictions,
                "identified": theta,
                "identified_deviation": theta,
                "parameters": system.parameter_signals,
            },
        )

    def _parameters(self, friction: ca.SX | None = None, theta: ca.SX | None = None) -> ca.SX:
        """The model's parameters with estimates, and with given or no friction."""
        parameters = ca.SX(self._system.parameter_symbol)
        parameters[self._places] = self._before["theta"] if theta is None else theta
        for j, name in enumerate(self.observation.frictions):
            value = 0 if friction is None else friction[j]
            parameters[self._system.parameter_slice(name)] = value
        return parameters

    # The exact state.

    def _observed(self, sample: ca.SX) -> Memory:
        """What is held after a sample of the exact state."""
        old, x, v, u = self._before, self._measured, self._measured_force, self._control
        mu, slid, acted = old["friction"], old["slid"], self._acted()
        parameters = self._parameters()
        momentum = self.observation.momentum.function(x, acted, v, parameters)
        contact = self._contacts.terms(x, v, parameters)
        p, drift, inputs = momentum[:3]
        d = (p - old["momentum"]) / self._period - (old["drift"] + drift) / 2.0 - inputs
        d -= ca.mtimes(contact.friction, mu)

        # Each lag is a column.
        size = len(self.observation.rows)
        chain = ca.horzcat(ca.reshape(old["lags"], size, -1), old["disturbance"])
        chain = self._passed(contact, chain, d)
        chain, change = self._shared(chain, contact)
        if self._breaks_away:  # Springs answer jumps by swings.
            early, slid = self._contacts.early(slid, contact, x, v, parameters, d)
            change += early
        moves, (fast, slow) = ca.mtimes(contact.free, chain), self._lags
        rates = fast.derivatives(moves) + slow.derivatives(chain - moves)
        valid = momentum[-1] + contact.valid
        after = {
            "sample": sample if self._places else ca.SX(1.0),
            "disturbance": chain[:, -1],
            "rates": ca.vec(rates),
            "lags": ca.vec(chain[:, :-1]),
            "friction": self._bounded(mu + change),
            "slid": slid,
            "momentum": p,
            "drift": drift,
            "control": u,
        }
        return old | {name: where_finite(value, valid) for name, value in after.items()}

    def _acted(self) -> ca.SX:
        """The control that has acted since the last sample."""
        is_late = self._lag * (self._before["sample"] >= 0)
        return is_late * self._before["control"] + (1.0 - is_late) * self._control

    def _passed(self, contact: ContactTerms, chain: ca.SX, signal: ca.SX) -> ca.SX:
        """The lags of a signal after a sample; what a sticking contact may hide does not enter."""
        by_fast, by_slow = (
            orthogonal_part(
                contact.held,
                contact.metric,
                (self._before["sample"] >= 0) * (lags.after(chain, signal) - chain),
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
        mu = self._before["friction"]
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
        memory, known = self._memory, len(self._places)
        if not known:
            return memory
        rest = memory["sample"] / self._ratio
        is_new = ca.eq(rest, ca.floor(rest))  # Whole exactly after a sample of the filter.
        change = self._filter.change
        moves = {"theta": change[:known], "friction": change[known:], **self._regressor.jumps}
        return memory | {
            name: memory[name] + ca.if_else(is_new, move, 0) for name, move in moves.items()
        }

    def _filtered(self) -> ca.SX:
        """What the filter of parameters holds after a sample of its own, and its regressor."""
        old, system, rows = self._before, self._system, list(self.observation.rows)
        identified, begun = self.observation.identified, old["sample"] >= 0
        x, v, u = self._measured, self._measured_force, self._acted()
        if old["state"].numel():
            x, u = ca.if_else(begun, old["state"], x), old["control"]
            v = old["measured_force"]
        parameters = self._parameters()
        contact = self._contacts.terms(x, v, parameters)
        values = identified.slopes.function(x, u, v, parameters)
        rests = ca.mmax(contact.sticks) if contact.sticks.numel() else ca.SX(0)
        slides = ca.mtimes(contact.friction, ca.diag(contact.slides))
        is_used = ca.logic_and(begun, ca.logic_not(rests))
        Y = self._regressor.after(x, parameters, values[:3], slides, contact.free, is_used)
        mass = ca.Function("M", [system.state, system.parameter_symbol], [system.mass_matrix])
        forces = v[list(identified.pressed), :]
        excused = ca.logic_or(self.inputs["hold"] != 0, rests)
        filtered = self._filter.after(
            ca.vertcat(old["theta"], old["friction"]),
            old["disturbance"],
            Y,
            ca.diag(mass(x, parameters)[rows, rows]),
            values[3:6],
            forces,
            forces >= self._observing.least_force,
            ca.logic_and(begun, ca.logic_not(excused)),
        )
        held = self._regressor.held_after(x, Y, values[:3], filtered[: Y.shape[1]])
        return where_finite(ca.vertcat(filtered, held), contact.valid)

    # The state from encoders.

    def _estimated(self) -> Memory:
        """What is held after a sample of measured positions."""
        system, old, period, measured = self._system, self._before, self._period, self._measured
        u, count = self._control, len(self.observation.rows)
        acted = self._acted()

        # Prediction over a sample, from the middle of it; a discrete plant steps from its start.
        q, qd = old["state"][:count], old["state"][count:]
        r, mu, slid = old["disturbance"], old["friction"], old["slid"]
        middle = ca.vertcat(q + (period - self._step) / 2.0 * qd, qd)
        parameters = self._parameters()
        # A discrete plant's force is that of its step.
        v, share = self._measured_force, (1.0 + self._step / period) / 2.0
        force = share * v + (1.0 - share) * old["measured_force"]
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
        moved = qd + period * stepping.solve(push - friction_force)
        impulses = period * mu * self._contacts.pressing(v)
        moved = slowed(moved, contact.planes, impulses, stepping.solve)
        unused = ca.logic_or(self._contacts.is_lost(v), self.inputs["hold"] != 0)
        if self._breaks_away:  # What has not slid yet sticks, with any friction that this needs.
            sticks = ca.logic_not(ca.logic_or(unused, slid > 0))
            stuck = self._contacts.side_by_side(contact.planes, sticks)
            momentum = ca.mtimes(mass, moved)
            stopped = momentum - orthogonal_part(stuck, factors.solve, momentum)
            moved -= factors.solve(stopped)
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
        new_r = r + orthogonal_part(contact.held, contact.metric, jump)

        # Friction and parameters take their share of the disturbance.
        state = ca.vertcat(new_q, new_v)
        new_r, change = self._shared(new_r, contact)
        if self._breaks_away:
            pushed_by = ca.mtimes(mass, errors[0]), errors[0], factors
            usual = [float(gain[0, 0]) for gain in self._gains[0][:2]]
            early, slid, jumps, is_early = self._contacts.slipped(
                slid, contact, middle, new_v, v, parameters, *pushed_by, unused, usual
            )
            forces = self._contacts.developed(ca.vertcat(q, new_v), v, parameters)
            terms = forces, contact.planes, new_v, contact.metric
            taken = ca.mtimes(contact.free, forces)
            new_r -= ca.mtimes(taken, is_early * shares(*terms, new_r - r))
            change += early
            state += jumps
        mu = self._bounded(mu + change)
        after = {"state": state, "disturbance": new_r, "friction": mu, "slid": slid, "control": u}
        after["measured_force"] = v
        return old | {name: where_finite(value, contact.valid) for name, value in after.items()}

    def _balance(self) -> ca.Function:
        """(x, u, v, parameters) -> M, the total force without M v', and the joints' damping."""
        system, rows = self._system, list(self.observation.rows)
        u, v = (ca.SX.sym("u", n) for n in (system.num_controls, system.num_constraints))
        push = system.f + ca.mtimes(system.g, v) + ca.mtimes(system.h, u)
        speed, force, dry = system.state[rows], system.f[rows], self._proportional_to(system.dry)
        smooth, turning = (
            ca.vertcat(*(-ca.jacobian(part[i], speed[i]) for i in range(len(rows))))
            for part in (force - dry, dry)
        )
        damping = ca.substitute(smooth, speed, 0 * speed) + turning  # Without Coriolis forces.
        inputs = [system.state, u, v, system.parameter_symbol]
        outputs = [system.mass_matrix[rows, rows], push[rows], ca.sparsify(ca.simplify(damping))]
        return ca.Function("balance", inputs, outputs)

    def _proportional_to(self, names: Iterable[str]) -> ca.SX:
        """The part of the generalized force that is proportional to parameters, shape (k, 1)."""
        system, rows = self._system, list(self.observation.rows)
        symbols = [p.symbol for p in system.parameters if p.name in names]
        if not symbols:
            return ca.SX(len(rows), 1)
        return ca.jtimes(system.f[rows], ca.vertcat(*symbols), ca.vertcat(*symbols))

    # What the law takes.

    def _compensated(self, x: ca.SX, v: ca.SX) -> ca.SX:
        """The signals for the law: disturbance, coefficients of friction and their derivatives.

        Friction of contacts is that of the wanted motion, and so are Coulomb and estimated viscous
        friction of joints: a law that compensated too much of them at the actual velocities would
        be unstable.
        """
        observation, system, mu = self.observation, self._system, self.shown["friction"]
        parameters, valid = self._parameters(mu, self.shown["theta"]), ca.SX(0)
        r, rates = self.shown["disturbance"], self.shown["rates"]
        if mu.numel() or system.dry:
            goal = x
            if observation.wanted is not None:
                goal, valid = self._contacts.goal(x, parameters)
            estimated = {p.name for p in observation.identified.parameters}
            viscous = {f"{name.rpartition('.')[0]}.viscous" for name in system.dry}
            friction = self._proportional_to({*system.dry, *(viscous & estimated)})
            joints = ca.Function("joints", [system.state, system.parameter_symbol], [friction])
            contact = observation.friction.function
            now, wanted = (
                ca.mtimes(contact(faster, v, parameters)[0], mu) + joints(state, parameters)
                for state, faster in ((x, x), (goal, self._contacts.faster(goal)))
            )
            r = r + wanted - now
        parameters[system.parameter_slice(DISTURBANCE)] = r
        stacked_signals, degrees = list[ca.SX](), iter(self._law.exogenous_degrees)
        for p in system.exogenous.moving:
            for i, value in enumerate(parameters[system.parameter_slice(p.name)].elements()):
                degree = next(degrees)
                own = rates[i :: r.numel()] if p.name == DISTURBANCE else ca.SX(0, 1)
                others = ca.vertcat(own, ca.SX.zeros(degree))[:degree]  # Others are constant.
                stacked_signals += [value, others]
        return where_finite(stacked(stacked_signals), valid)


def disturbance_degree(law: TrackingLaw) -> int:
    """The number of derivatives of the disturbance that a law needs."""
    degrees = iter(law.exogenous_degrees)
    own = {
        p.name: [next(degrees) for _ in range(p.value.size)] for p in law.system.exogenous.moving
    }
    return max(own[DISTURBANCE])


def _check_rigid(law: TrackingLaw, rows: tuple[int, ...]) -> None:
    system, count = law.system, len(rows)
    is_rigid = rows == tuple(range(count, 2 * count)) and system.num_states == 2 * count
    if not is_rigid or disturbance_degree(law):
        raise ModelError(
            f"{system.name}: a state_rate is for robots with rigid joints, whose states are "
            "positions and velocities; behind springs, motors or valves measure the velocities, "
            "or let the encoders form differences by a velocity_bandwidth"
        )
    unknown = [c.force for c in system.contacts if c.friction and c.sliding is None]
    if unknown:
        raise ModelError(
            f"{system.name}: a state_rate needs the velocity with which '{unknown[0]}' slides, "
            "UnilateralInput.sliding"
        )
    if not ca.simplify(system.f[:count] - system.state[count:]).is_zero():
        raise ModelError(
            f"{system.name}: a state_rate needs q' = v, and this robot has a body with "
            "q' = N(q) v; measure its velocities"
        )


def _gains(
    state_rate: float, rates: Sequence[float], period: float, *deviations: FloatArray
) -> list[list[ca.DM]]:
    """For each rate of disturbances the gains of q, v and a, shape (k, 2) each."""
    found = np.zeros((len(rates), 3, deviations[0].size, 2))
    for which, rate in enumerate(rates):
        for i, (q, v) in enumerate(zip(*deviations, strict=True)):
            ratio = v / q if v > 0.0 and q > 0.0 else None
            own = filter_gain(state_rate, rate, period, ratio)
            found[which, :, i, : own.shape[1]] = own
    return [[ca.DM(each) for each in gains] for gains in found]
