"""The parts of a closed loop besides plant, controller and references: settings and checks."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike
from pydrake.common import RandomDistribution
from pydrake.systems.framework import DiagramBuilder, System
from pydrake.systems.primitives import RandomSource

from drake_dae.arguments import checked
from drake_dae.arrays import unknown_name
from drake_dae.errors import WiringError
from drake_dae.references import ConstantReference, Reference
from drake_dae.robots import velocities_are_rates
from drake_dae.systems.applied_control import Sampling
from drake_dae.systems.break_away import Observing
from drake_dae.systems.controller import SIGNAL, Controller
from drake_dae.systems.estimator import StateEstimator
from drake_dae.systems.plant import Plant
from drake_dae.systems.references import CommandedReferences, ReferenceGenerator
from drake_dae.systems.sensors import Encoders, ForceSensor, StateSensor

ENCODER_NOISE = "encoder_noise"  # the name of the source


@checked(WiringError)
@dataclass(frozen=True, eq=False)
class LoopSettings:
    """The settings of a closed loop besides plant, controller and references.

    Attributes:
        sensor: The sensor of the constraint force, for a law with measured force. Without one the
            force is connected directly; with rigid joints that closes an algebraic loop.
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

    def period(self, step: float) -> float:
        """The time between samples of the law in s, on a plant with such a step; 0 for none."""
        return step if self.sampling is None else self.sampling.period


def misfits(
    plant: Plant, controller: Controller, reference: ReferenceGenerator | None, parts: LoopSettings
) -> Iterator[str]:
    """What does not fit together, for messages; Drake would name only the ports."""
    encoders, observer, measured = parts.encoders, parts.observer, controller.law.measured_force
    if (takes := controller.HasInputPort("reference")) and reference is None:
        remedy = "ReferenceGenerator(references, controller.law.layout.reference_degrees)"
        yield f"{controller.get_name()} needs a {remedy}"
    if reference is not None and not takes:
        yield f"{controller.get_name()} plans its references itself: leave `reference` out"
    if parts.sensor is not None and not controller.HasInputPort("measured_force"):
        yield "the law takes no measured force; make it with measured_force=True"
    if observer is None:
        return
    if not parts.period(plant.time_step):
        yield "an observer observes at samples: take a sampling=Sampling(period) or a ContactPlant"
    if plant.dae.num_constraints and not measured:
        remedy = "make the law with measured_force=True (in a scenario: sensors.force)"
        yield f"an observer needs the measured force: {remedy}"
    if observer.state_rate is None:
        return
    if encoders is None:
        yield "a state_rate is for encoders, whose noise the observer filters: give the loop some"
    elif encoders.velocity_bandwidth is not None:
        yield "an observer with a state_rate takes positions alone: leave velocity_bandwidth out"


def check_force_loop(
    plant: Plant, controller: Controller, sensor: ForceSensor | None, sampling: Sampling | None
) -> None:
    """Refuses an algebraic loop by the measured force, or a sampled loop that diverges.

    With a rigid robot the force follows the acting control, lambda = -Gbar y of an earlier sample,
    and the sensor follows the force, y' = a y + (1 - a) lambda. With a delay of d samples each
    sample multiplies the error by the largest root, in magnitude, of
    z^(d + 1) - a z^d + (1 - a) Gbar = 0.
    """

    def feeds(system: System, into: str, out: str) -> bool:
        ports = system.GetInputPort(into), system.GetOutputPort(out)
        return bool(system.HasDirectFeedthrough(*(port.get_index() for port in ports)))

    at_once, measured = feeds(plant, "control", "constraint_force"), controller.law.measured_force
    if sensor is None:
        if at_once and feeds(controller, "measured_force", "control"):
            raise WiringError(
                "the constraint force depends on the control in the same instant, so a law that "
                "reads it closes an algebraic loop; pass a sensor=ForceSensor(...) with a "
                "time_constant or a sample_period"
            )
        return
    gain = measured.gain if measured else 0.0
    lag, samples = sensor.time_constant, sensor.sample_period
    loops = [(samples, 0)] if samples else []
    if sampling is not None and at_once:
        # The law reads what a sensor samples at the same instant one sample later.
        loops.append((sampling.period, sampling.late_samples + bool(samples)))
    for period, late in loops:
        a = float(np.exp(-period / lag)) if lag else 0.0
        polynomial = np.array([1.0, *np.zeros(late + 1)])
        polynomial[1] -= a
        polynomial[-1] += (1.0 - a) * gain
        if (radius := np.max(np.abs(np.roots(polynomial)), initial=0.0)) >= 1.0:
            raise WiringError(
                f"the sampled force loop diverges: with Gbar = {gain:.3g} each sample of "
                f"{period:g} s multiplies the force error by {radius:.3g}. Lower force_gain, or "
                "give the sensor a time_constant well above the period of samples and the delay"
            )


def make_observer(plant: Plant, controller: Controller, parts: LoopSettings) -> StateEstimator:
    """The observer of a loop, whose settings are checked."""
    assert parts.observer is not None
    step, period, rest, late = plant.time_step, parts.period(plant.time_step), 0.0, 0.0
    if parts.sampling is not None:
        hold = hold_sampling(plant, parts.sampling)
        rest, late = hold.rest, hold.delay + step
    noise: tuple[ArrayLike, ArrayLike] = (0.0, 0.0)
    if parts.encoders is not None and parts.observer.state_rate is not None:
        noise = parts.encoders.position_deviation, parts.encoders.velocity_noise
    # The previous control acts for a share of a sample.
    lag, delay = min((rest + step) / period, 1.0), late + period / 2.0
    return StateEstimator(
        controller.law, parts.observer, period, lag, delay, step, *noise, plant.is_ideal
    )


def make_sensor(plant: Plant, encoders: Encoders, period: float) -> StateSensor:
    """The encoders of a robot, sampled with its law."""
    if not period:
        raise WiringError(
            "encoders are read at samples, and this law acts continuously; give it a sampling"
        )
    links = plant.robot("the encoders").links
    if encoders.velocity_bandwidth is not None and not velocities_are_rates(links):
        raise WiringError(
            "velocities from differences need q' = v, and this robot has a body with q' = N(q) v; "
            "leave velocity_bandwidth out"
        )
    return StateSensor(plant.dae.num_states, links.q.numel(), encoders, period)


def hold_sampling(plant: Plant, sampling: Sampling) -> Sampling:
    """The sampling of the hold; a discrete plant adds a delay of one of its own steps."""
    step = plant.time_step
    if step and sampling.delay < step * (1.0 - 1e-9):
        raise WiringError(
            f"the plant steps by {step:g} s and takes the control that was held before, so that a "
            f"sampling's delay is {step:g} s or more, got {sampling.delay:g} s. A law without "
            "delay at each step of the plant needs no sampling"
        )
    return replace(sampling, delay=max(sampling.delay - step, 0.0))


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


def add_exogenous(
    builder: DiagramBuilder, block: Plant | Controller, exogenous: Sequence[Reference], depth: int
) -> ReferenceGenerator:
    """Adds the generator of a block's exogenous signals, commanded with that many lags if any."""
    dae = block.dae if isinstance(block, Plant) else block.law.system
    signals, size = dae.exogenous.signals, sum(reference.size for reference in exogenous)
    if size != len(signals):
        raise WiringError(
            f"the references of exogenous signals cover {size}, '{dae.name}' has {len(signals)}: "
            f"{', '.join(signal.name for signal in signals) or 'none'}"
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
    ports = {
        name.removeprefix(SIGNAL): controller.GetInputPort(name)
        for i in range(controller.num_input_ports())
        if (name := controller.get_input_port(i).get_name()).startswith(SIGNAL)
    }
    for name, signal in signals.items():
        reference = signal if isinstance(signal, Reference) else ConstantReference(signal)
        if name not in ports:
            raise WiringError(f"{unknown_name('signal', name, ports)}, for which a phase waits")
        if (size := reference.size) != 1:
            raise WiringError(f"the signal '{name}' is one number, its reference has {size}")
        source = builder.AddSystem(ReferenceGenerator([reference], [0]))
        source.set_name(SIGNAL + name)
        builder.Connect(source.GetOutputPort("reference"), ports[name])
    for name, port in ports.items():
        if name not in signals:
            builder.ExportInput(port, SIGNAL + name)
