"""The parts of a closed loop: what is refused, and how sensor and exogenous signals are wired."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import DiagramBuilder, OutputPort, TriggerType
from pydrake.systems.primitives import Adder, LogVectorOutput, MatrixGain, VectorLogSink

from drake_dae.dae.references import Reference
from drake_dae.dae.system.system import DaeSystem
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.errors import ModelError, WiringError
from drake_dae.systems.blocks.block import ParameterizedSystem
from drake_dae.systems.control.controller import TrackingController
from drake_dae.systems.control.limits import ControlLimits
from drake_dae.systems.control.references import ReferenceGenerator
from drake_dae.systems.control.sampling import ControlHold, Sampling
from drake_dae.systems.plants.contact.contact_plant import ContactPlant
from drake_dae.systems.plants.dae_plant import DaePlant
from drake_dae.systems.plants.unilateral.plant import UnilateralRobotPlant
from drake_dae.systems.sensing.force_sensor import ForceSensor
from drake_dae.systems.sensing.tolerances import Tolerances, ToleranceWatch

Block = TypeVar("Block", DaePlant, ForceSensor)


def add_block(builder: DiagramBuilder, block: Block) -> Block:
    """Adds what the caller made."""
    try:
        return builder.AddSystem(block)
    except RuntimeError:
        raise WiringError(
            f"'{block.get_name()}' stands in another diagram already; make a new one for this loop"
        ) from None


def add_exogenous(
    builder: DiagramBuilder, block: ParameterizedSystem, exogenous: Sequence[Reference]
) -> ReferenceGenerator | None:
    """Adds the generator of a block's exogenous signals, each with the derivatives that it needs.

    Raises:
        WiringError: The references are not as many as the signals.
    """
    names = [signal.name for signal in block.dae.exogenous.signals]
    size = sum(reference.size for reference in exogenous)
    if exogenous and size != len(names):
        raise WiringError(
            f"the references of exogenous signals cover {size}, '{block.dae.name}' has "
            f"{len(names)}: {', '.join(names) or 'none'}"
        )
    if not exogenous:
        return None
    generator = builder.AddSystem(ReferenceGenerator(exogenous, block.exogenous_layout.degrees))
    generator.set_name(f"{block.get_name()}_exogenous")
    builder.Connect(generator.get_output_port(), block.GetInputPort("exogenous"))
    return generator


def check_system(own: DaeSystem, other: DaeSystem, what: str, remedy: str) -> None:
    """Refuses what is for a system of another size than the plant's.

    Args:
        own: The plant's system.
        other: What it is for.
        what: What is wired to the plant.
        remedy: What to make instead.
    """
    sizes = [(s.num_states, s.num_controls, s.num_constraints) for s in (own, other)]
    if sizes[0] != sizes[1]:
        has, takes = ("{} states, {} controls and {} constraints".format(*size) for size in sizes)
        raise WiringError(
            f"the {what} is for '{other.name}' with {takes}, the plant '{own.name}' has {has}. "
            f"Make {remedy}"
        )


def check_sizes(plant: DaePlant, law: TrackingLaw, sensor: ForceSensor | None) -> None:
    """Refuses wrong sizes: Drake would name the ports, but not what is wrong with them."""
    own, remedy = plant.dae, "the law for the plant's system, TrackingLaw(plant.dae, ...), or for"
    check_system(own, law.system, "law", f"{remedy} a model of the same structure")
    if sensor is not None:
        size = sensor.GetInputPort("force").size()
        if size != own.num_constraints:
            names = ", ".join(signal.name for signal in own.constraint_input_signals) or "none"
            raise WiringError(
                f"the sensor measures {size} forces, the plant '{own.name}' has "
                f"{own.num_constraints} ({names}); make it as ForceSensor({own.num_constraints}, "
                "...)"
            )


def add_drives(
    builder: DiagramBuilder,
    controller: TrackingController,
    sampling: Sampling | None,
    control_limits: ArrayLike | None,
) -> tuple[OutputPort, ControlLimits | None]:
    """Adds what stands between controller and plant, and returns the control that arrives."""
    control, limits = controller.GetOutputPort("control"), None
    if sampling is not None:
        hold = builder.AddSystem(ControlHold(control.size(), sampling))
        builder.Connect(control, hold.get_input_port())
        control = hold.get_output_port()
    if control_limits is not None:
        limits = builder.AddSystem(ControlLimits(control_limits))
        if limits.limits.size != control.size():
            raise WiringError(
                f"control_limits has {limits.limits.size} entries, there are {control.size()} "
                "controls"
            )
        builder.Connect(control, limits.get_input_port())
        control = limits.GetOutputPort("control")
    return control, limits


def add_watch(
    builder: DiagramBuilder,
    plant: DaePlant | ContactPlant,
    reference: ReferenceGenerator,
    law: TrackingLaw,
    tolerances: Tolerances,
) -> None:
    """Adds what ends a run whose errors are too large.

    Raises:
        WiringError: There is no such output.
    """
    dae = plant.dae
    sizes = law.layout.reference_size, dae.num_states
    # Of a continuous plant often enough for what is recent.
    period = plant.time_step or tolerances.window / 20.0
    lowest = law.layout.lowest
    try:
        made = ToleranceWatch(
            tolerances, dae.output_signals, dae.force_signals, lowest, sizes, period
        )
    except ModelError as error:
        raise WiringError(str(error)) from None
    watch = builder.AddSystem(made)
    builder.Connect(reference.GetOutputPort("reference"), watch.GetInputPort("reference"))
    for name in ("controlled_output", "constraint_force", "state"):
        builder.Connect(plant.GetOutputPort(name), watch.GetInputPort(name))


def add_hold(
    builder: DiagramBuilder, controller: TrackingController, sources: Sequence[OutputPort]
) -> None:
    """Lets the integrals of a controller stand still while a signal is not 0.

    Args:
        builder: The builder of the diagram.
        controller: The controller.
        sources: The signals: of one entry for all integrals, or of one for each.
    """
    count = len(controller.law.integral.outputs)
    if not (count and sources):
        return
    total = builder.AddSystem(Adder(len(sources), count))
    for index, source in enumerate(sources):
        if source.size() != count:
            spread = builder.AddSystem(MatrixGain(np.ones((count, 1))))
            builder.Connect(source, spread.get_input_port())
            source = spread.get_output_port()
        builder.Connect(source, total.get_input_port(index))
    builder.Connect(total.get_output_port(), controller.GetInputPort("hold"))


def log_steps(
    builder: DiagramBuilder,
    port: OutputPort,
    plant: DaePlant | ContactPlant | UnilateralRobotPlant,
) -> VectorLogSink:
    """Logs once per step.

    Of a discrete plant it is by the clock: after the last step of a run its state is that of an
    instant that the run has not reached.
    """
    if plant.time_step:
        return LogVectorOutput(port, builder, {TriggerType.kPeriodic}, plant.time_step)
    return LogVectorOutput(port, builder, {TriggerType.kPerStep})


def hold_before(
    plant: DaePlant | ContactPlant | UnilateralRobotPlant, sampling: Sampling
) -> Sampling:
    """The sampling of the hold: a discrete plant takes what was held one step of its own before."""
    step = plant.time_step
    if step and sampling.delay < step * (1.0 - 1e-9):
        raise WiringError(
            f"the plant steps by {step:g} s and takes the control that was held before, so that a "
            f"sampling's delay is {step:g} s or more, got {sampling.delay:g} s. A law without "
            "delay at each step of the plant needs no sampling"
        )
    return replace(sampling, delay=max(sampling.delay - step, 0.0))
