"""The observer of a closed loop, and its connections."""

import numpy as np
from pydrake.systems.framework import DiagramBuilder, OutputPort

from drake_dae.arrays import FloatArray
from drake_dae.errors import ModelError, WiringError
from drake_dae.systems.control.contract import Controller
from drake_dae.systems.control.limits import ControlLimits
from drake_dae.systems.control.sampling import Sampling
from drake_dae.systems.observing.estimator import StateEstimator
from drake_dae.systems.observing.observing import Observing
from drake_dae.systems.plants.contract import Plant
from drake_dae.systems.sensing.encoders import Encoders


def add_observer(
    builder: DiagramBuilder,
    plant: Plant,
    controller: Controller,
    observing: Observing,
    state: OutputPort,
    sampling: Sampling | None,
    control: OutputPort,
    reference: OutputPort,
    limits: ControlLimits | None,
    encoders: Encoders | None,
) -> StateEstimator:
    """Adds the observer and connects it to the controller's exogenous port.

    If it estimates the state, it is connected to the controller's state port as well. Its port
    `measured_force` is left open: `add_force_feedback` connects it.

    Args:
        builder: The builder of the diagram, with the other blocks in it.
        plant: The plant.
        controller: The controller.
        observing: The rates of the observer.
        state: The measured state.
        sampling: The sampling of the hold after the controller.
        control: The control at the plant.
        reference: R(t).
        limits: What keeps the limits of the drives; None if nothing does.
        encoders: What measures the state; None if it is exact.

    Raises:
        WiringError: There is no sampling, the law uses no measured force, or a state is to be
            estimated that no encoders measure.
        ModelError: The law has no disturbance, or is not for rigid joints where the state is to
            be estimated.
    """
    step = plant.time_step
    period = step if sampling is None else sampling.period
    if not period:
        raise WiringError(
            "an observer observes at samples: give the loop a sampling=Sampling(period), or a "
            "ContactPlant"
        )
    estimates = observing.state_rate is not None
    if plant.dae.num_constraints and not (controller.law.measured_force or estimates):
        raise WiringError(
            "an observer needs the measured force: make the law with measured_force=True, or give "
            "the observer a state_rate and the loop encoders, by which the model's force serves"
        )
    if controller.HasOutputPort("contact_reference") and not controller.law.measured_force:
        raise WiringError(
            "the observer of a task needs the measured force, since the model's force is that of a "
            "closed contact: make the law with measured_force=True (in a scenario: sensors.force: "
            "{sample_period: ...})"
        )
    late = 0.0 if sampling is None else sampling.delay + step
    lag, delay = control_lag(plant, sampling), late + period / 2.0
    noise = np.zeros(()), np.zeros(())
    if estimates:
        noise = _check_encoders(encoders)
    try:
        observer = builder.AddSystem(
            StateEstimator(
                controller.law, observing, period, lag, delay, step, *noise, plant.is_ideal
            )
        )
    except ModelError as error:
        raise WiringError(str(error)) from None
    builder.Connect(state, observer.GetInputPort("measured_state"))
    if estimates:
        state = observer.GetOutputPort("estimated_state")
    builder.Connect(state, controller.GetInputPort("estimated_state"))
    builder.Connect(control, observer.GetInputPort("control"))
    builder.Connect(reference, observer.GetInputPort("reference"))
    builder.Connect(observer.GetOutputPort("exogenous"), controller.GetInputPort("exogenous"))
    if not plant.dae.num_constraints:
        none = plant.GetOutputPort("constraint_force")
        builder.Connect(none, observer.GetInputPort("measured_force"))
    if limits is not None:
        builder.Connect(limits.GetOutputPort("is_limited"), observer.GetInputPort("hold"))
    return observer


def control_lag(plant: Plant, sampling: Sampling | None) -> float:
    """The fraction of a sample for which a plant uses the previous control.

    Args:
        plant: The plant.
        sampling: The sampling of the hold after the controller.
    """
    step = plant.time_step
    period = step if sampling is None else sampling.period
    rest = 0.0 if sampling is None else sampling.rest
    return min((rest + step) / period, 1.0) if period else 0.0


def _check_encoders(encoders: Encoders | None) -> tuple[FloatArray, FloatArray]:
    """The deviations of encoders from which a state is to be estimated."""
    if encoders is None:
        raise WiringError(
            "a state_rate is for encoders, whose noise the observer filters: give the loop "
            "encoders, or leave it out"
        )
    if encoders.velocity_bandwidth is not None:
        raise WiringError(
            "an observer that estimates the state takes positions and forms no differences: leave "
            "the encoders' velocity_bandwidth out"
        )
    return encoders.position_deviation, np.asarray(encoders.velocity_noise, dtype=float)
