"""The parts of a closed loop besides plant, controller and references: settings and checks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike
from pydrake.common import RandomDistribution
from pydrake.systems.framework import DiagramBuilder, System
from pydrake.systems.primitives import RandomSource

from drake_dae.arguments import checked
from drake_dae.arrays import unknown_name
from drake_dae.dae import DaeSystem
from drake_dae.errors import ModelError, WiringError
from drake_dae.references import ConstantReference, Reference
from drake_dae.robots import velocities_are_rates
from drake_dae.systems.control.commanded import CommandedReferences
from drake_dae.systems.control.contract import SIGNAL, Controller
from drake_dae.systems.control.drives import Sampling
from drake_dae.systems.control.references import ReferenceGenerator
from drake_dae.systems.observing.estimator import StateEstimator
from drake_dae.systems.observing.observing import Observing
from drake_dae.systems.plants.contract import Plant
from drake_dae.systems.sensing.encoders import Encoders, StateSensor
from drake_dae.systems.sensing.force_sensor import ForceSensor

ENCODER_NOISE = "encoder_noise"
"""The name of the source of the noise of encoders."""


@checked(WiringError)
@dataclass(frozen=True, eq=False)
class LoopSettings:
    """The settings of a closed loop besides plant, controller and references.

    Attributes:
        sensor: The sensor of the constraint force, for a law with measured force. Without one the
            force is connected directly, if that closes no algebraic loop.
        encoders: The measurement of the state for the law, at its samples; None for the exact one.
        sampling: The period and delay of the law, with a zero-order hold of its control. None for
            a continuous law, or on a discrete plant for one that is evaluated at each of its steps.
        control_limits: The largest |u| of the drives, shape (p,), such as `model.control_limits`;
            the record has "excess", the part beyond. Integrals are not updated meanwhile.
        observer: The settings of a `StateEstimator`, for a sampled law with measured force of
            a system that `with_disturbance` made.
        exogenous: The references of all exogenous signals w of plant and law, in their order.
        plant_exogenous: Those of the plant; None if they equal the law's.
        signals: Name -> reference of a signal for which phases of a task wait; the signal is set
            where it is above 1/2. Any other is an input port signal_<name> of the loop.
        commanded: Whether references and exogenous signals are `CommandedReferences`.
        start_time: The start of a run in s, for the references at which the stability of the zero
            dynamics is judged.
    """

    sensor: ForceSensor | None = None
    encoders: Encoders | None = None
    sampling: Sampling | None = None
    control_limits: ArrayLike | None = None
    observer: Observing | None = None
    exogenous: Sequence[Reference] = ()
    plant_exogenous: Sequence[Reference] | None = None
    signals: Mapping[str, Reference | float] = field(default_factory=dict)
    commanded: bool = False
    start_time: float = 0.0

    def period(self, step: float) -> float:
        """The time between samples of the law in s, on a plant with such a step; 0 for none."""
        return step if self.sampling is None else self.sampling.period


AnySystem = TypeVar("AnySystem", bound=System)


def add_block(builder: DiagramBuilder, block: AnySystem) -> AnySystem:
    """Adds a block of the caller, or refuses one that belongs to another diagram."""
    taken = WiringError(
        f"'{block.get_name()}' belongs to another diagram already; make a new one for this loop"
    )
    # Drake's AddSystem refuses a block of an unfinished diagram, but one of a built diagram only
    # its Build, which would fail here without the name of the argument.
    if block.GetSystemPathname() not in (f"::{block.get_name()}", "::_"):
        raise taken
    try:
        return builder.AddSystem(block)
    except RuntimeError:
        raise taken from None


def check_parts(
    plant: Plant, controller: Controller, reference: ReferenceGenerator | None, parts: LoopSettings
) -> None:
    """Refuses parts that do not fit; Drake would name only the ports."""
    if controller.HasInputPort("reference") is not (reference is not None):
        needs = "plans its references itself: leave `reference` out"
        if reference is None:
            needs = (
                "needs a ReferenceGenerator(references, controller.law.layout.reference_degrees)"
            )
        raise WiringError(f"{controller.get_name()} {needs}")
    sensor, dae = parts.sensor, plant.dae
    if sensor is not None and (size := sensor.GetInputPort("force").size()) != dae.num_constraints:
        names = ", ".join(signal.name for signal in dae.constraint_input_signals) or "none"
        raise WiringError(
            f"the sensor measures {size} forces, the plant '{dae.name}' has "
            f"{dae.num_constraints} ({names}); make it as ForceSensor({dae.num_constraints}, "
            "...)"
        )
    if sensor is not None and not controller.HasInputPort("measured_force"):
        raise WiringError("the law takes no measured force; make it with measured_force=True")


# ----------------------------------------------------------------------------------------- sensors


def make_sensor(plant: Plant, encoders: Encoders, period: float) -> StateSensor:
    """The encoders of a robot, sampled with its law."""
    if not period:
        raise WiringError(
            "encoders are read at samples, and this law acts continuously; give it a sampling"
        )
    if plant.model is None:
        raise WiringError(
            "encoders measure the positions of a robot: a RobotPlant or a ContactPlant"
        )
    links = plant.model.links
    if encoders.velocity_bandwidth is not None and not velocities_are_rates(links):
        raise WiringError(
            "velocities from differences need q' = v, and this robot has a body with q' = N(q) v; "
            "leave velocity_bandwidth out"
        )
    try:
        return StateSensor(plant.dae.num_states, links.q.numel(), encoders, period)
    except ModelError as error:
        raise WiringError(str(error)) from None


def encoder_seed(seed: int) -> int:
    """The seed of the noise of encoders for a user's seed below 2^32, which a force sensor uses."""
    return (seed + 2**31) % 2**32


def add_noise(
    builder: DiagramBuilder, sensor: System, period: float, name: str
) -> RandomSource | None:
    """Adds the source of a sensor's noise; None for a sensor without noise."""
    if not sensor.HasInputPort("noise"):
        return None
    port = sensor.GetInputPort("noise")
    noise = builder.AddSystem(RandomSource(RandomDistribution.kGaussian, port.size(), period))
    noise.set_name(name)
    builder.Connect(noise.get_output_port(), port)
    return noise


def check_force_loop(
    plant: Plant, controller: Controller, sensor: ForceSensor | None, sampling: Sampling | None
) -> None:
    """Refuses an algebraic loop by the measured force, or a sampled loop that diverges."""
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


def make_observer(
    plant: Plant,
    controller: Controller,
    observing: Observing,
    sampling: Sampling | None,
    encoders: Encoders | None,
) -> StateEstimator:
    """The observer of a loop; `sampling` is that of the hold after the controller."""
    law, step = controller.law, plant.time_step
    period = step if sampling is None else sampling.period
    if not period:
        raise WiringError(
            "an observer observes at samples: give the loop a sampling=Sampling(period), or a "
            "ContactPlant"
        )
    estimates = observing.state_rate is not None
    if plant.dae.num_constraints and not (law.measured_force or estimates):
        raise WiringError(
            "an observer needs the measured force: make the law with measured_force=True, or give "
            "the observer a state_rate and the loop encoders, by which the model's force serves"
        )
    if controller.HasOutputPort("contact_reference") and not law.measured_force:
        raise WiringError(
            "the observer of a task needs the measured force, since the model's force is that of a "
            "closed contact: make the law with measured_force=True (in a scenario: sensors.force: "
            "{sample_period: ...})"
        )
    if estimates and encoders is None:
        raise WiringError(
            "a state_rate is for encoders, whose noise the observer filters: give the loop "
            "encoders, or leave it out"
        )
    noise: tuple[ArrayLike, ArrayLike] = (0.0, 0.0)
    if estimates and encoders is not None:
        if encoders.velocity_bandwidth is not None:
            raise WiringError(
                "an observer that estimates the state takes positions and forms no differences: "
                "leave the encoders' velocity_bandwidth out"
            )
        noise = encoders.position_deviation, encoders.velocity_noise
    # The previous control acts for a share of a sample.
    rest, late = (0.0, 0.0) if sampling is None else (sampling.rest, sampling.delay + step)
    lag, delay = min((rest + step) / period, 1.0), late + period / 2.0
    try:
        return StateEstimator(law, observing, period, lag, delay, step, *noise, plant.is_ideal)
    except ModelError as error:
        raise WiringError(str(error)) from None


# ------------------------------------------------------------------------------ control and inputs


def hold_before(plant: Plant, sampling: Sampling) -> Sampling:
    """The sampling of the hold; a discrete plant adds a delay of one of its own steps."""
    step = plant.time_step
    if step and sampling.delay < step * (1.0 - 1e-9):
        raise WiringError(
            f"the plant steps by {step:g} s and takes the control that was held before, so that a "
            f"sampling's delay is {step:g} s or more, got {sampling.delay:g} s. A law without "
            "delay at each step of the plant needs no sampling"
        )
    return replace(sampling, delay=max(sampling.delay - step, 0.0))


def add_exogenous(
    builder: DiagramBuilder,
    block: Plant | Controller,
    dae: DaeSystem,
    exogenous: Sequence[Reference],
    depth: int,
) -> ReferenceGenerator:
    """Adds the generator of a block's exogenous signals, commanded with that many lags if any."""
    signals = dae.exogenous.signals
    size = sum(reference.size for reference in exogenous)
    if size != len(signals):
        raise WiringError(
            f"the references of exogenous signals cover {size}, '{dae.name}' has "
            f"{len(signals)}: {', '.join(signal.name for signal in signals) or 'none'}"
        )
    if any(reference.parameters for reference in exogenous):
        raise WiringError(
            "references of exogenous signals take no parameters: write their numbers into the "
            "expressions"
        )
    degrees = block.exogenous_layout.degrees
    generator = ReferenceGenerator(exogenous, degrees)
    if depth:
        generator = CommandedReferences(exogenous, degrees, signals, depth=depth)
    builder.AddSystem(generator)
    generator.set_name(f"{block.get_name()}_exogenous")
    builder.Connect(generator.get_output_port(), block.GetInputPort("exogenous"))
    return generator


def add_signals(
    builder: DiagramBuilder, controller: Controller, signals: Mapping[str, Reference | float]
) -> None:
    """Connects the signals for which a controller waits; without a source they become inputs."""
    ports = [controller.get_input_port(i) for i in range(controller.num_input_ports())]
    names = [port.get_name() for port in ports]
    waited_for = [name.removeprefix(SIGNAL) for name in names if name.startswith(SIGNAL)]
    for name in signals:
        if name not in waited_for:
            raise WiringError(
                f"{unknown_name('signal', name, waited_for)}, for which a phase waits"
            )
    for name in waited_for:
        port = controller.GetInputPort(SIGNAL + name)
        if name not in signals:
            builder.ExportInput(port, SIGNAL + name)
            continue
        signal = signals[name]
        reference = signal if isinstance(signal, Reference) else ConstantReference(signal)
        if reference.size != 1:
            raise WiringError(
                f"the signal '{name}' is one number, its reference has {reference.size}"
            )
        source = builder.AddSystem(ReferenceGenerator([reference], [0]))
        source.set_name(SIGNAL + name)
        builder.Connect(source.GetOutputPort("reference"), port)
