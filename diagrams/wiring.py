"""The parts of a closed loop: what is refused, and how sensor and exogenous signals are wired."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import DiagramBuilder, OutputPort
from pydrake.systems.primitives import Adder, MatrixGain

from drake_dae.dae.references import Reference
from drake_dae.dae.tracking import TrackingLaw
from drake_dae.errors import WiringError
from drake_dae.systems.block import ParameterizedSystem
from drake_dae.systems.controller import TrackingController
from drake_dae.systems.limits import ControlLimits
from drake_dae.systems.plant import DaePlant
from drake_dae.systems.references import ReferenceGenerator
from drake_dae.systems.sampling import ControlHold, Sampling
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


def add_drives(
    builder: DiagramBuilder,
    controller: TrackingController,
    sampling: Sampling | None,
    control_limits: ArrayLike | None,
    holds: Sequence[OutputPort] = (),
) -> tuple[OutputPort, ControlLimits | None]:
    """Adds what stands between controller and plant, and returns the control that arrives.

    Integrals stand still while a drive is at its limit, or where a port of `holds` is not 0.
    """
    control, limits = controller.GetOutputPort("control"), None
    found, count = list(holds), len(controller.law.integral.outputs)
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
        if count:
            gain = builder.AddSystem(MatrixGain(np.ones((count, 1))))
            builder.Connect(limits.GetOutputPort("is_limited"), gain.get_input_port())
            found.append(gain.get_output_port())
    if len(found) > 1:
        both = builder.AddSystem(Adder(len(found), count))
        for i, port in enumerate(found):
            builder.Connect(port, both.get_input_port(i))
        found = [both.get_output_port()]
    for port in found:
        builder.Connect(port, controller.GetInputPort("hold"))
    return control, limits
