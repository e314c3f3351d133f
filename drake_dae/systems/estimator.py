"""One estimator of what a law does not know: state, disturbance, friction and parameters."""

from collections.abc import Sequence

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, numbers, positive
from drake_dae.blocks.block import Block
from drake_dae.blocks.lifetime import SHARED_DICTIONARY
from drake_dae.dae import Signal, TrackingLaw
from drake_dae.errors import ModelError
from drake_dae.systems.break_away import Observing
from drake_dae.systems.estimator_sample import EstimatorSample
from drake_dae.systems.plant import ParameterizedSystem


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
        control, measured_force: The applied u, shape (p,); v, shape (m,), if the law measures it.
        hold: Not 0 while a drive is at its limit: mu and parameters then rest.
        reference: R of the controller; the current outputs and rates without a wire.

    Output ports:
        estimated_state: x, shape (n,); with a state_rate.
        exogenous: Disturbance, mu and parameters with the derivatives that the law needs.
        disturbance, friction: r, shape (k,), and mu, shape (c,).
        hold: 1 while the input `hold` is not 0 or a frictional contact is lost, else 0.
        identified, identified_deviation: Parameters with friction, and their deviations.
        estimated_force: v by the model (25), shape (m,); with a state_rate, if none is measured.

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
                _each("position_deviation", position_deviation, law),
                _each("velocity_deviation", velocity_deviation, law),
            ),
            is_ideal,
        )
        self.observing, self.sample_period = observing, period
        self.observation, self._place = sample.observation, sample.friction_place
        super().__init__(law.system, _block(law, sample, period), degrees=(), sees_steps=False)

    @property
    def friction_signals(self) -> Sequence[Signal]:
        """Names and units of `friction`."""
        return self.block.signals["friction"]

    @property
    def further_signals(self) -> dict[str, Sequence[Signal]]:
        """Name of an output port in a record -> names and units of its entries."""
        named = {name: self.block.signals.get(name, ()) for name in self.block.outputs}
        others = ("estimated_state", "exogenous", "hold")
        return {name: signals for name, signals in named.items() if signals and name not in others}

    def set_friction(self, context: Context, friction: ArrayLike) -> None:
        """Sets the initial coefficients of friction, shape (c,), or a number for all.

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
        values = context.get_discrete_state(0).CopyToVector()
        values[self._place] = given
        context.SetDiscreteState(0, values)


def _each(name: str, given: ArrayLike, law: TrackingLaw) -> FloatArray:
    """One number for each velocity."""
    deviations, count = numbers(name, given), law.system.num_states // 2
    if deviations.shape not in ((), (count,)) or not np.all(deviations >= 0.0):
        raise ModelError(f"{name} must be 0 or more, a number or shape ({count},), got {given!r}")
    return np.broadcast_to(deviations, (count,))


def _block(law: TrackingLaw, sample: EstimatorSample, period: float) -> Block:
    """The block of an estimator."""
    system, observation, names = law.system, sample.observation, list(sample.observation.frictions)
    shown = sample.shown
    outputs = {
        "exogenous": sample.exogenous,
        "disturbance": shown["disturbance"],
        "friction": shown["friction"],
    }
    frictions = tuple(Signal(name) for name in names)
    signals: dict[str, Sequence[Signal]] = {
        "estimated_state": system.state_signals,
        "measured_state": system.state_signals,
        "control": system.control_signals,
        "measured_force": system.constraint_input_signals,
        "disturbance": tuple(
            Signal(f"disturbance of {system.state_signals[i].name}") for i in observation.rows
        ),
        "friction": frictions,
        "parameters": system.parameter_signals,
    }
    if shown["state"].numel():
        outputs = {"estimated_state": sample.state, **outputs}
    if not sample.measures:
        outputs["estimated_force"] = sample.force
        signals["estimated_force"] = system.constraint_input_signals
    identified = observation.identified.signals
    if identified:
        outputs["identified"] = ca.vertcat(shown["theta"], shown["friction"])
        outputs["identified_deviation"] = sample.deviations
        signals |= dict.fromkeys(("identified", "identified_deviation"), (*identified, *frictions))
    rates = observation.moving.function(sample.state, system.parameter_symbol)[0]
    return Block(
        "state_estimator",
        sample.inputs,
        {**outputs, "hold": sample.hold},
        parameters=system.parameter_symbol,
        start={"parameters": system.parameter_values},
        held=sample.held,
        defaults={"hold": ca.SX.zeros(1), "reference": rates},
        signals=signals,
    )
