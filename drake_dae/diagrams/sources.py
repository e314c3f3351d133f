"""The sources of a closed loop: references, and exogenous signals of plant and law."""

from collections.abc import Sequence

from pydrake.common import RandomDistribution, RandomGenerator
from pydrake.systems.framework import Context, DiagramBuilder, System
from pydrake.systems.primitives import RandomSource

from drake_dae.blocks.traced_system import context_in
from drake_dae.dae import DaeSystem, TrackingLaw
from drake_dae.diagrams.settings import LoopSettings
from drake_dae.errors import WiringError
from drake_dae.references import Reference
from drake_dae.systems.control.commanded import CommandedReferences
from drake_dae.systems.control.contract import Controller
from drake_dae.systems.control.references import ReferenceGenerator
from drake_dae.systems.plants.contract import Plant


def make_generator(
    references: Sequence[Reference], law: TrackingLaw, parts: LoopSettings
) -> ReferenceGenerator:
    """The reference block of a law: `CommandedReferences` if the settings are `commanded`.

    Raises:
        ReferenceSignalError: The references do not fit the law.
    """
    if not parts.commanded:
        return ReferenceGenerator(references, law.layout.reference_degrees)
    return CommandedReferences(references, law.layout.reference_degrees, law.system.output_signals)


def add_exogenous(
    builder: DiagramBuilder, plant: Plant, controller: Controller, parts: LoopSettings
) -> tuple[ReferenceGenerator | None, ReferenceGenerator | None]:
    """Adds the generators of the exogenous signals of the plant and of the law.

    The output of the second one is exported as `known_exogenous`.

    Returns:
        The generator for the plant and that for the law, each None without exogenous signals.

    Raises:
        WiringError: The number of references differs from that of the signals.
    """
    of_plant = parts.exogenous if parts.plant_exogenous is None else parts.plant_exogenous
    # Commands pass as many lags to the plant as to the law.
    degrees = *plant.exogenous_layout.degrees, *controller.exogenous_layout.degrees
    lags = parts.commanded, max(degrees, default=0) + 1
    moving = _add_exogenous(builder, plant, plant.dae, of_plant, *lags)
    known = _add_exogenous(builder, controller, controller.law.system, parts.exogenous, *lags)
    if known is not None:
        builder.ExportOutput(known.get_output_port(), "known_exogenous")
    return moving, known


def _add_exogenous(
    builder: DiagramBuilder,
    block: Plant | Controller,
    dae: DaeSystem,
    exogenous: Sequence[Reference],
    commanded: bool,
    depth: int,
) -> ReferenceGenerator | None:
    """Adds the generator of a block's exogenous signals, with as many lags as `depth`."""
    if not exogenous:
        return None
    names = [signal.name for signal in dae.exogenous.signals]
    size = sum(reference.size for reference in exogenous)
    if size != len(names):
        raise WiringError(
            f"the references of exogenous signals cover {size}, '{dae.name}' has "
            f"{len(names)}: {', '.join(names) or 'none'}"
        )
    if any(reference.parameters for reference in exogenous):
        raise WiringError(
            "references of exogenous signals take no parameters: write their numbers into the "
            "expressions"
        )
    degrees, signals = block.exogenous_layout.degrees, dae.exogenous.signals
    generator = ReferenceGenerator(exogenous, degrees)
    if commanded:
        generator = CommandedReferences(exogenous, degrees, signals, depth=depth)
    builder.AddSystem(generator)
    generator.set_name(f"{block.get_name()}_exogenous")
    builder.Connect(generator.get_output_port(), block.GetInputPort("exogenous"))
    return generator


def add_noise(
    builder: DiagramBuilder, sensor: System, period: float, name: str
) -> RandomSource | None:
    """Adds the source of a sensor's noise, with a period in s; None for a sensor without noise."""
    if not sensor.HasInputPort("noise"):
        return None
    port = sensor.GetInputPort("noise")
    noise = builder.AddSystem(RandomSource(RandomDistribution.kGaussian, port.size(), period))
    noise.set_name(name)
    builder.Connect(noise.get_output_port(), port)
    return noise


def seed_noise(noise: RandomSource | None, context: Context, seed: int) -> None:
    """Sets the seed of a sensor's noise in the context of the diagram, if there is noise."""
    if noise is not None:
        noise.SetRandomContext(context_in(noise, context), RandomGenerator(seed))
