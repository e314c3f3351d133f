"""The parts of a closed loop: what is refused, and how sensor and exogenous signals are wired."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import RandomSource

from drake_dae.dae.references import Reference
from drake_dae.dae.tracking import TrackingLaw
from drake_dae.errors import WiringError
from drake_dae.systems.block import ParameterizedSystem
from drake_dae.systems.controller import TrackingController
from drake_dae.systems.plant import DaePlant
from drake_dae.systems.references import ReferenceGenerator
from drake_dae.systems.sensors import ForceSensor

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


def check_sizes(plant: DaePlant, law: TrackingLaw, sensor: ForceSensor | None) -> None:
    """Refuses wrong sizes: Drake would name the ports, but not what is wrong with them."""
    own, other = plant.dae, law.system
    sizes = [(s.num_states, s.num_controls, s.num_constraints) for s in (own, other)]
    if sizes[0] != sizes[1]:
        has, takes = ("{} states, {} controls and {} constraints".format(*size) for size in sizes)
        raise WiringError(
            f"the law is for '{other.name}' with {takes}, the plant '{own.name}' has {has}. Make "
            "the law for the plant's system, TrackingLaw(plant.dae, ...), or for a model of the "
            "same structure"
        )
    if sensor is not None:
        size = sensor.GetInputPort("force").size()
        if size != own.num_constraints:
            names = ", ".join(signal.name for signal in own.constraint_input_signals) or "none"
            raise WiringError(
                f"the sensor measures {size} forces, the plant '{own.name}' has "
                f"{own.num_constraints} ({names}); make it as ForceSensor({own.num_constraints}, "
                "...)"
            )


def add_force_feedback(
    builder: DiagramBuilder,
    plant: DaePlant,
    controller: TrackingController,
    sensor: ForceSensor | None,
) -> RandomSource | None:
    """Connects the constraint force to the controller, through the sensor if there is one.

    Returns:
        The source of the sensor's noise, if it has one.
    """
    force, noise = plant.GetOutputPort("constraint_force"), None
    if sensor is None:
        control = plant.GetInputPort("control").get_index()
        reads = controller.GetInputPort("measured_force").get_index()
        acts = controller.GetOutputPort("control").get_index()
        takes = controller.HasDirectFeedthrough(reads, acts)
        if takes and plant.HasDirectFeedthrough(control, force.get_index()):
            raise WiringError(
                "the constraint force depends on the control in the same instant, so a law that "
                "reads it closes an algebraic loop; pass a sensor=ForceSensor(...) with a "
                "time_constant or a sample_period"
            )
    else:
        measured = controller.law.measured_force
        gain = float(np.linalg.norm(measured.gain, 2)) if measured and force.size() else 0.0
        if gain >= sensor.largest_stable_gain():
            raise WiringError(
                f"the sampled force loop diverges: ||Gbar|| = {gain:.3g}, but each sample "
                "multiplies the force error by -Gbar; it must stay below "
                f"{sensor.largest_stable_gain():.3g}. Lower force_gain, or give the sensor a "
                "time_constant well above its sample_period"
            )
        add_block(builder, sensor)
        builder.Connect(force, sensor.GetInputPort("force"))
        force = sensor.GetOutputPort("measured_force")
        if sensor.HasInputPort("noise"):
            size = sensor.GetInputPort("noise").size()
            period = sensor.sample_period or sensor.time_constant
            source = RandomSource(RandomDistribution.kGaussian, size, period)
            noise = builder.AddSystem(source)
            builder.Connect(noise.get_output_port(), sensor.GetInputPort("noise"))
    builder.Connect(force, controller.GetInputPort("measured_force"))
    return noise
