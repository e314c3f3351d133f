"""The connection from a plant's constraint force to its law."""

from collections.abc import Sequence

import numpy as np
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import RandomSource

from drake_dae.diagrams.sources import add_noise
from drake_dae.errors import WiringError
from drake_dae.systems.control.contract import Controller
from drake_dae.systems.control.sampling import Sampling
from drake_dae.systems.observing.estimator import StateEstimator
from drake_dae.systems.plants.contract import Plant
from drake_dae.systems.sensing.force_sensor import ForceSensor


def add_force_feedback(
    builder: DiagramBuilder,
    plant: Plant,
    controller: Controller,
    sensor: ForceSensor | None,
    sampling: Sampling | None,
    others: Sequence[StateEstimator] = (),
) -> RandomSource | None:
    """Connects the constraint force to the controller, through the sensor if there is one.

    Args:
        builder: The builder of the diagram, with plant, controller and sensor in it.
        plant: The plant.
        controller: The controller, whose law uses a measured force.
        sensor: The sensor; None for the exact force.
        sampling: The sampling of the control; None for continuous control.
        others: Further blocks that use the measured force.

    Returns:
        The source of the sensor's noise, if it has one.

    Raises:
        WiringError: It would close an algebraic loop, or a sampled loop that diverges.
    """
    force, noise = plant.GetOutputPort("constraint_force"), None
    _check_loop(plant, controller, sensor, sampling)
    if sensor is not None:
        builder.Connect(force, sensor.GetInputPort("force"))
        force = sensor.GetOutputPort("measured_force")
        period = sensor.sample_period or sensor.time_constant
        noise = add_noise(builder, sensor, period, "force_noise")
    builder.Connect(force, controller.GetInputPort("measured_force"))
    if controller.HasOutputPort("tared_force"):
        force = controller.GetOutputPort("tared_force")
    for block in others:
        builder.Connect(force, block.GetInputPort("measured_force"))
    return noise


def _check_loop(
    plant: Plant,
    controller: Controller,
    sensor: ForceSensor | None,
    sampling: Sampling | None,
) -> None:
    """Refuses an algebraic loop, or a sampled loop that diverges."""
    force, measured = plant.GetOutputPort("constraint_force"), controller.law.measured_force
    control = plant.GetInputPort("control").get_index()
    at_once = plant.HasDirectFeedthrough(control, force.get_index())
    if sensor is None and sampling is None:
        reads = controller.GetInputPort("measured_force").get_index()
        acts = controller.GetOutputPort("control").get_index()
        if controller.HasDirectFeedthrough(reads, acts) and at_once:
            raise WiringError(
                "the constraint force depends on the control in the same instant, so a law that "
                "reads it closes an algebraic loop; pass a sensor=ForceSensor(...) with a "
                "time_constant or a sample_period, or a sampling"
            )
        return
    gain = float(np.linalg.norm(measured.gain, 2)) if measured and force.size() else 0.0
    if sensor is not None and gain >= sensor.largest_stable_gain():
        raise WiringError(
            f"the sampled force loop diverges: ||Gbar|| = {gain:.3g}, but each sample "
            "multiplies the force error by -Gbar; it must stay below "
            f"{sensor.largest_stable_gain():.3g}. Lower force_gain, or give the sensor a "
            "time_constant well above its sample_period"
        )
    if sampling is not None and at_once:
        radius = _radius(gain, sensor, sampling)
        if radius >= 1.0:
            raise WiringError(
                f"the sampled force loop diverges: with ||Gbar|| = {gain:.3g} each sample of "
                f"{sampling.period:g} s multiplies the force error by {radius:.3g}. Lower "
                "force_gain, or give the sensor a time_constant well above the sampling's period "
                "and delay"
            )


def _radius(gain: float, sensor: ForceSensor | None, sampling: Sampling) -> float:
    """The factor by which each sample multiplies the force error of a rigid robot.

    The force follows the acting control, lambda = -Gbar y of an earlier sample, and the sensor
    follows the force, y' = a y + (1 - a) lambda. With a delay of d samples the factor is the
    largest root, in magnitude, of z^(d + 1) - a z^d + (1 - a) Gbar = 0.
    """
    lag = sensor.time_constant if sensor is not None else 0.0
    a = float(np.exp(-sampling.period / lag)) if lag else 0.0
    # The law reads what a sensor samples at the same instant one sample later.
    late = sampling.late_samples + bool(sensor is not None and sensor.sample_period)
    polynomial = np.zeros(late + 2)
    polynomial[0] = 1.0
    polynomial[1] -= a
    polynomial[-1] += (1.0 - a) * gain
    return float(np.max(np.abs(np.roots(polynomial)), initial=0.0))
