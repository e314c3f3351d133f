"""The parts of a closed loop: adding them to a diagram, and checks."""

from collections.abc import Mapping, Sequence
from typing import TypeVar

import numpy as np
from pydrake.systems.framework import DiagramBuilder, OutputPort, System
from pydrake.systems.primitives import Adder, MatrixGain

from drake_dae.arrays import unknown_name
from drake_dae.diagrams.settings import LoopSettings
from drake_dae.errors import WiringError
from drake_dae.references import ConstantReference, Reference
from drake_dae.systems.control.contract import SIGNAL, Controller
from drake_dae.systems.control.references import ReferenceGenerator
from drake_dae.systems.plants.contract import Plant

Block = TypeVar("Block", bound=System)


def add_block(builder: DiagramBuilder, block: Block) -> Block:
    """Adds a block of the caller.

    Raises:
        WiringError: The block belongs to another diagram.
    """
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


def add_signals(
    builder: DiagramBuilder, controller: Controller, signals: Mapping[str, Reference | float]
) -> None:
    """Connects the signals for which a controller waits; without a source they become inputs.

    Args:
        builder: The builder of the diagram, with the controller in it.
        controller: The controller.
        signals: Name -> reference.

    Raises:
        WiringError: The controller waits for no signal of that name, or it is not one number.
    """
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


def contact_reference(
    controller: Controller, reference: ReferenceGenerator | None
) -> OutputPort | None:
    """The port of R(t) of the law in contact, of a generator or of the controller; None if none."""
    block, name = reference or controller, "reference" if reference else "contact_reference"
    return block.GetOutputPort(name) if block.HasOutputPort(name) else None


def check_parts(
    plant: Plant,
    controller: Controller,
    reference: ReferenceGenerator | None,
    parts: LoopSettings,
) -> None:
    """Refuses parts that do not fit; Drake would name only the ports.

    Args:
        plant: The plant.
        controller: The controller.
        reference: The source of its references, if any.
        parts: The parts.

    Raises:
        WiringError: The controller does not support a part, references are missing, the sensor has
            another number of forces, or the law does not use it.
    """
    if controller.HasInputPort("reference") is not (reference is not None):
        needs = "plans its references itself: leave `reference` out"
        if reference is None:
            needs = (
                "needs a ReferenceGenerator(references, controller.law.layout.reference_degrees)"
            )
        raise WiringError(f"{controller.get_name()} {needs}")
    if parts.observer is not None and contact_reference(controller, reference) is None:
        raise WiringError("observer: it needs the references of a generator, and there is none")
    sensor = parts.sensor
    if sensor is None:
        return
    dae, size = plant.dae, sensor.GetInputPort("force").size()
    if size != dae.num_constraints:
        names = ", ".join(signal.name for signal in dae.constraint_input_signals) or "none"
        raise WiringError(
            f"the sensor measures {size} forces, the plant '{dae.name}' has "
            f"{dae.num_constraints} ({names}); make it as ForceSensor({dae.num_constraints}, "
            "...)"
        )
    if not controller.HasInputPort("measured_force"):
        raise WiringError("the law takes no measured force; make it with measured_force=True")


def add_hold(
    builder: DiagramBuilder, controller: Controller, sources: Sequence[OutputPort]
) -> None:
    """Connects the signals that stop the integrals of a controller while they are not 0.

    Args:
        builder: The builder of the diagram.
        controller: The controller.
        sources: The signals, each with one entry for all integrals or one entry per integral.
    """
    if not (sources and controller.HasInputPort("hold")):
        return
    count = controller.GetInputPort("hold").size()
    total = builder.AddSystem(Adder(len(sources), count))
    for index, source in enumerate(sources):
        if source.size() != count:
            spread = builder.AddSystem(MatrixGain(np.ones((count, 1))))
            builder.Connect(source, spread.get_input_port())
            source = spread.get_output_port()
        builder.Connect(source, total.get_input_port(index))
    builder.Connect(total.get_output_port(), controller.GetInputPort("hold"))
