"""An estimator of state, disturbance and friction from measured positions."""

from dataclasses import replace

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, numbers
from drake_dae.blocks.block import TIME, Held, where_finite
from drake_dae.blocks.lifetime import SHARED_DICTIONARY
from drake_dae.dae import TrackingLaw
from drake_dae.errors import ModelError
from drake_dae.systems.observing.estimator_functions import EstimatorFunctions, state_filters
from drake_dae.systems.observing.observer_rates import Observing
from drake_dae.systems.observing.observing_system import (
    ObservingSystem,
    check_timing,
    columns,
    observer_block,
)


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
        period = check_timing(sample_period, control_lag, control_delay)
        system, count = law.system, law.system.num_states // 2
        noise = [
            _each(name, given, count)
            for name, given in (
                ("position_deviation", position_deviation),
                ("velocity_deviation", velocity_deviation),
            )
        ]
        filters = state_filters(observing, period, *noise)
        timing = period, control_lag, control_delay, plant_step
        functions = EstimatorFunctions(law, observing, *timing, filters, noise[0])
        sizes = dict(zip(functions.now.input_names, functions.now.sizes, strict=True))
        memory, p = ca.SX.sym("held", sizes["held"]), system.parameter_symbol
        inputs = columns(law, "measured_state", with_force=functions.measures)
        read = [inputs[name] for name in functions.reads]
        now, _, *checks = functions.now.function(inputs["measured_state"], memory, *read, TIME, p)
        estimate = functions.estimate
        names = ("sample", "state", "disturbance", "friction", "force", "slides")
        ends = np.cumsum([0, *(getattr(estimate, name).numel() for name in names)]).tolist()
        now = where_finite(now, checks[-1])
        _, x, disturbance, friction, by_model, _ = ca.vertsplit(now, ends)
        force = inputs["measured_force"] if functions.measures else by_model
        reference = inputs["reference"]
        signals, *valid = functions.exogenous.function(x, now, force, reference, p)
        outputs = {
            "estimated_state": x,
            "exogenous": where_finite(signals, valid[-1]),
            "disturbance": disturbance,
            "friction": friction,
        }
        if not functions.measures:
            outputs["estimated_force"] = by_model
        start = np.zeros(sizes["held"])
        start[0] = -1.0
        after = ca.vertcat(now, inputs["control"], force, reference)
        held, place = Held(memory, after, start, period), ends[3]
        block = observer_block(
            "state_estimator", law, functions, inputs, outputs, force, held, place
        )
        moving = functions.observation.moving.function(x, p)[0]
        block = replace(block, defaults={**block.defaults, "reference": moving})
        if not functions.measures:
            named = {**block.signals, "estimated_force": system.constraint_input_signals}
            block = replace(block, signals=named)
        super().__init__(law, observing, period, functions, block, place)


def _each(name: str, given: ArrayLike, count: int) -> FloatArray:
    """One number for each position."""
    deviations = numbers(name, given)
    if deviations.shape not in ((), (count,)) or not np.all(deviations >= 0.0):
        raise ModelError(f"{name} must be 0 or more, a number or shape ({count},), got {given!r}")
    return np.broadcast_to(deviations, (count,))
