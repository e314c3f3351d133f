"""An estimator of state, disturbance and friction from measured positions."""

from collections.abc import Sequence
from itertools import pairwise

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, EventStatus, State, ValueProducer

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, numbers
from drake_dae.blocks.computations import HELD, PARAMETERS, TIME, Block, Computation
from drake_dae.blocks.lifetime import SHARED_DICTIONARY, port_value, weakly
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.errors import ModelError
from drake_dae.systems.observing.estimator_functions import EstimatorFunctions, state_filters
from drake_dae.systems.observing.observer_rates import Observing
from drake_dae.systems.observing.observing_system import ObservingSystem


@checked(ModelError)
class StateEstimator(ObservingSystem):
    """Estimates the state of a robot with rigid joints from its encoders, with model errors.

    Between samples the model predicts the state and the disturbance r,

        q' = v,    M v' = f + C mu + r + g lambda + h u,

    with the control u that acted and the measured force lambda; so velocities need no differences.
    Viscous friction D in joints, which makes light links stiff, is implicit: M + T D then replaces
    M in the prediction and before K_3.
    At a sample the error of the predicted positions, e = qm - q, corrects all of them,

        q = q + K_1 e,    v = v + K_2 e,    r = r + M K_3 e,

    where (K_1, K_2, K_3) is the gain of the stationary Kalman filter of each position; see
    `ChainFilter`. Since r is an acceleration there, M^-1 r, one gain serves all postures, and the
    errors of the estimate are those of a linear filter for any motion. Along the constrained
    directions, M^-1 J^T A^-1 J e, the gains are those of k_n in place of k_o. Measured velocities,
    if their noise is given, correct likewise. Friction takes its share of r as in a
    `DisturbanceObserver`, and so does a contact that sticks. In the prediction friction is
    implicit, and at most stops a contact; it is fully developed from v_s / 10 on also where
    contacts are ideal, since an estimate with the model's own friction grew without bound there. At
    its first break-away a contact has a filter of its own, `BreakAway`.

    Input ports:
        measured_state: (q, v) as encoders measure it, shape (n,). v is used at the first sample;
            later only if its noise is given.
        control: The applied u, shape (p,).
        measured_force: The constraint force, shape (m,); if the law measures it.
        hold, reference: As of a `DisturbanceObserver`.

    Output ports:
        estimated_state: The estimate of (q, v) at the present sample, shape (n,).
        exogenous, disturbance, friction, hold: As of a `DisturbanceObserver`, at the present
            sample.
        estimated_force: Only if the law measures no force: that of the model in the last sample, v
            = alpha(x) + beta(x) u (25) with the observed disturbance and friction, shape (m,). It
            has the model errors along the constrained directions.

    Args:
        law: The law, for a system that `with_disturbance` made.
        observing: The rates, and the thresholds for friction.
        sample_period: T in s.
        control_lag, control_delay: As of a `DisturbanceObserver`.
        plant_step: The step of a discrete plant in s; 0 for a continuous plant.
        position_deviation: The standard deviation of a measured position, in rad or m, a number or
            shape (k,).
        velocity_deviation: That of a measured velocity, likewise; 0 if none is measured.

    Attributes:
        observation: The observed functions.
        observing, sample_period: The arguments.
        disturbance_signals, friction_signals: Names and units of the output ports.

    Raises:
        ModelError: The law's system has no disturbance, is no robot with rigid joints, or a number
            is not valid.
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
    ) -> None:
        super().__init__(law, observing, sample_period, control_lag, control_delay)
        self.set_name("state_estimator")
        count = law.system.num_states // 2
        noise = [
            _each(name, given, count)
            for name, given in (
                ("position_deviation", position_deviation),
                ("velocity_deviation", velocity_deviation),
            )
        ]
        filters = state_filters(observing, sample_period, *noise)
        timing = sample_period, control_lag, control_delay, plant_step
        self._functions = functions = EstimatorFunctions(law, observing, *timing, filters, noise[0])
        start = np.zeros(functions.now.sizes[functions.now.input_names.index("held")])
        start[0] = -1.0
        self._declare(law, functions, "measured_state", start)
        self._read = functions.reads
        held = {self.discrete_state_ticket(self._held), self.all_parameters_ticket()}
        names = "measured_state", *self._read
        read = {self.input_port_ticket(self._ports[name].get_index()) for name in names}
        entry = self.DeclareCacheEntry(
            "estimate",
            ValueProducer(
                lambda: AbstractValue.Make(start[: functions.size].copy()), weakly(self._calc)
            ),
            held | read | {self.time_ticket()},
        )
        self._index = entry.cache_index()
        force = entry.ticket()
        if self._measures:
            force = self.input_port_ticket(self._ports["measured_force"].get_index())
        self._declare_hold(force)
        self.DeclarePeriodicUnrestrictedUpdateEvent(sample_period, 0.0, weakly(self._sample))
        sources = {entry.ticket(), self.all_parameters_ticket()}
        read = {force, self.input_port_ticket(self._ports["reference"].get_index())}
        exogenous = port_value(self._exogenous_values)
        state, disturbance, friction = (port_value(self._part, part) for part in self._parts[:3])
        for name, size, value, tickets in (
            ("estimated_state", law.system.num_states, state, sources),
            ("exogenous", functions.exogenous.outputs[0].size, exogenous, sources | read),
            ("disturbance", count, disturbance, sources),
            ("friction", len(self.friction_signals), friction, sources),
        ):
            self.DeclareVectorOutputPort(name, size, value, tickets)
        if not self._measures:
            size = law.system.num_constraints
            self.DeclareVectorOutputPort(_FORCE, size, port_value(self._force), {force})

    @property
    def _parts(self) -> tuple[slice, ...]:
        """The parts of an estimate: state, disturbance, friction, force and slides."""
        estimate = self._functions.estimate
        columns = (
            estimate.sample,
            estimate.state,
            estimate.disturbance,
            estimate.friction,
            estimate.force,
            estimate.slides,
        )
        ends = np.cumsum([column.numel() for column in columns]).tolist()
        return tuple(slice(*pair) for pair in pairwise(ends))

    @property
    def _measures(self) -> bool:
        return self._functions.measures

    @property
    def further_signals(self) -> dict[str, Sequence[Signal]]:
        """Name of an output port in a record -> names and units of its entries."""
        signals = dict(super().further_signals)
        if not self._measures:
            signals[_FORCE] = self.dae.constraint_input_signals
        return signals

    def _force(self, context: Context) -> FloatArray:
        if self._measures:
            return super()._force(context)
        return self._estimate(context)[self._parts[3]]

    @property
    def _mu(self) -> slice:
        return self._parts[2]

    def _calc(self, context: Context, value: AbstractValue) -> None:
        (x,) = self._inputs(context, "measured_state")
        held = context.get_discrete_state(self._held).value()
        read = [*self._inputs(context, *self._read[:-1]), self._held_up(context)]
        time = np.array([context.get_time()])
        (estimate, *_) = self._checked(self._functions.now, context, x, held, *read, time)
        value.set_value(estimate.copy())

    def _estimate(self, context: Context) -> FloatArray:
        estimate: FloatArray = self.get_cache_entry(self._index).Eval(context)
        return estimate

    def _part(self, part: slice, context: Context) -> FloatArray:
        return self._estimate(context)[part]

    def _sample(self, context: Context, state: State) -> EventStatus:
        estimate = self._estimate(context)
        (control,) = self._inputs(context, "control")
        reference = self._reference(context, estimate[self._parts[0]])
        held = [estimate, control, self._force(context), reference]
        state.get_mutable_discrete_state().set_value(self._held, np.concatenate(held))
        return EventStatus.Succeeded()

    def _exogenous_values(self, context: Context) -> FloatArray:
        estimate = self._estimate(context)
        x = estimate[self._parts[0]]
        inputs = estimate, self._force(context), self._reference(context, x)
        return self._checked(self._functions.exogenous, context, x, *inputs)[0]

    def traced(self) -> Block:
        functions, estimate = self._functions, self._functions.estimate
        sources = ("measured_state", HELD, *self._read, TIME, PARAMETERS)
        now = Computation.of(functions.now, sources, (_NOW,))
        force = "measured_force" if self._measures else _FORCE
        state = ("estimated_state", _NOW, force, "reference", PARAMETERS)
        parts = {
            "estimated_state": estimate.state,
            "disturbance": estimate.disturbance,
            "friction": estimate.friction,
        }
        parts |= {} if self._measures else {_FORCE: estimate.force}
        column = estimate.column
        shown = ca.Function("shown", [column], list(parts.values()))
        sizes = self.dae.num_controls, self.dae.num_constraints, self._ports["reference"].size()
        held = [column, *(ca.SX.sym("held", size) for size in sizes)]
        after = ca.Function("after", held, [ca.vertcat(*held)])
        computations = (
            now,
            Computation(shown, (_NOW,), tuple(parts)),
            Computation.of(functions.exogenous, state, ("exogenous",)),
        )
        sample = Computation(after, (_NOW, "control", force, "reference"), (HELD,))
        return self._block(computations, sample, force)


def _each(name: str, given: ArrayLike, count: int) -> FloatArray:
    """One number for each position."""
    deviations = numbers(name, given)
    if deviations.shape not in ((), (count,)) or not np.all(deviations >= 0.0):
        raise ModelError(f"{name} must be 0 or more, a number or shape ({count},), got {given!r}")
    return np.broadcast_to(deviations, (count,))


_NOW, _FORCE = "estimate", "estimated_force"
"""The name of the estimate among the computations of the block, and the port of the force."""
