"""The sources of a closed loop: references, and exogenous signals of plant and law."""

from collections.abc import Sequence

from pydrake.systems.framework import DiagramBuilder

from drake_dae.dae.references import Reference
from drake_dae.dae.system.system import DaeSystem
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.diagrams.settings import LoopSettings
from drake_dae.errors import WiringError
from drake_dae.systems.control.command_filter import CommandLimits
from drake_dae.systems.control.commanded import CommandedReferences
from drake_dae.systems.control.contract import Controller
from drake_dae.systems.control.references import ReferenceGenerator
from drake_dae.systems.plants.contract import Plant


def make_generator(
    references: Sequence[Reference], law: TrackingLaw, parts: LoopSettings
) -> ReferenceGenerator:
    """The generator of a law's references, which are commanded if the settings say so.

    Raises:
        WiringError: References are to be governed and commanded.
        ReferenceSignalError: They do not fit the law.
    """
    if parts.commands is None:
        return ReferenceGenerator(references, law.degrees)
    if parts.governed is not None:
        raise WiringError("references that are governed cannot be commanded: leave one out")
    signals = law.system.output_signals
    return CommandedReferences(references, law.degrees, signals, parts.commands, parts.start_time)


def add_exogenous(
    builder: DiagramBuilder, plant: Plant, controller: Controller, parts: LoopSettings
) -> tuple[ReferenceGenerator | None, ReferenceGenerator | None]:
    """Adds the generators of exogenous signals, of the plant and of the law as known there.

    The diagram shows the latter as `known_exogenous`.

    Raises:
        WiringError: The number of references differs from that of the signals.
    """
    own = parts.exogenous if parts.plant_exogenous is None else parts.plant_exogenous
    # What is commanded passes as many lags to the plant as to the law.
    degrees = *plant.exogenous_layout.degrees, *controller.exogenous_layout.degrees
    lags = parts.commands, max(degrees, default=0) + 1
    moving = _add_exogenous(builder, plant, plant.dae, own, *lags)
    known = _add_exogenous(builder, controller, controller.law.system, parts.exogenous, *lags)
    if known is not None:
        builder.ExportOutput(known.get_output_port(), "known_exogenous")
    return moving, known


def _add_exogenous(
    builder: DiagramBuilder,
    block: Plant | Controller,
    dae: DaeSystem,
    exogenous: Sequence[Reference],
    commands: CommandLimits | None = None,
    depth: int = 0,
) -> ReferenceGenerator | None:
    """Adds the generator of a block's exogenous signals, each with the derivatives that it needs.

    Args:
        builder: The builder of the diagram.
        block: The block.
        dae: The block's system.
        exogenous: The references, in the order of the signals.
        commands: How fast they follow what is commanded; None if nothing is.
        depth: The least number of lags of these; plant and law have the same.

    Raises:
        WiringError: The number of references differs from that of the signals.
    """
    names = [signal.name for signal in dae.exogenous.signals]
    size = sum(reference.size for reference in exogenous)
    if exogenous and size != len(names):
        raise WiringError(
            f"the references of exogenous signals cover {size}, '{dae.name}' has "
            f"{len(names)}: {', '.join(names) or 'none'}"
        )
    if not exogenous:
        return None
    if any(reference.parameters for reference in exogenous):
        raise WiringError(
            "references of exogenous signals take no parameters: write their numbers into the "
            "expressions"
        )
    degrees, signals = block.exogenous_layout.degrees, dae.exogenous.signals
    made = ReferenceGenerator(exogenous, degrees)
    if commands is not None:
        made = CommandedReferences(
            exogenous, degrees, signals, commands, has_speed=False, depth=depth
        )
    generator = builder.AddSystem(made)
    generator.set_name(f"{block.get_name()}_exogenous")
    builder.Connect(generator.get_output_port(), block.GetInputPort("exogenous"))
    return generator
