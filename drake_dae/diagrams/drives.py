"""The way from a controller to the drives: hold, link and limits."""

from dataclasses import dataclass, replace

from numpy.typing import ArrayLike
from pydrake.systems.framework import Context, DiagramBuilder, OutputPort
from pydrake.systems.primitives import RandomSource

from drake_dae.diagrams.sources import add_noise, seed_noise
from drake_dae.errors import WiringError
from drake_dae.systems.control.limits import ControlLimits
from drake_dae.systems.control.sampling import ControlHold, Sampling
from drake_dae.systems.plants.contract import Plant
from drake_dae.systems.sensing.link import ControlLink

LINK_NOISE = "link_noise"
"""The name of the source of random numbers of a link."""


@dataclass(frozen=True, eq=False)
class LinkWithNoise:
    """The link from a law to the drives.

    Attributes:
        block: The link.
        noise: The source of its random numbers.
    """

    block: ControlLink
    noise: RandomSource | None

    def set_seed(self, context: Context, seed: int) -> None:
        """Sets the seed of the random numbers, below 2^32, in the context of the diagram."""
        seed_noise(self.noise, context, link_seed(seed))


def link_seed(seed: int) -> int:
    """The seed of the link for a user's seed below 2^32, so that its numbers are independent."""
    return (seed + 2**30) % 2**32


def add_drives(
    builder: DiagramBuilder,
    plant: Plant,
    control: OutputPort,
    sampling: Sampling | None,
    control_limits: ArrayLike | None,
) -> tuple[OutputPort, LinkWithNoise | None, ControlLimits | None]:
    """Adds hold, link and limits behind a control.

    Args:
        builder: The builder of the diagram, with the plant in it.
        plant: The plant.
        control: The source of the control.
        sampling, control_limits: As in `LoopSettings`.

    Returns:
        The control at the plant, the link, and the limits.
    """
    link, limits = None, None
    if sampling is not None:
        hold = builder.AddSystem(ControlHold(control.size(), sampling))
        builder.Connect(control, hold.get_input_port())
        control = hold.get_output_port()
    if sampling is not None and not sampling.is_exact:
        state = plant.GetOutputPort("state")
        block = builder.AddSystem(ControlLink(control.size(), state.size(), sampling))
        builder.Connect(control, block.GetInputPort("control"))
        builder.Connect(state, block.GetInputPort("state"))
        link = LinkWithNoise(block, add_noise(builder, block, sampling.period, LINK_NOISE))
        control = block.GetOutputPort("control")
    if control_limits is not None:
        limits = builder.AddSystem(ControlLimits(control_limits))
        if limits.limits.size != control.size():
            raise WiringError(
                f"control_limits has {limits.limits.size} entries, there are {control.size()} "
                "controls"
            )
        builder.Connect(control, limits.get_input_port())
        control = limits.GetOutputPort("control")
    return control, link, limits


def hold_before(plant: Plant, sampling: Sampling) -> Sampling:
    """The sampling of the hold; a discrete plant adds a delay of one of its own steps."""
    step = plant.time_step
    if step and sampling.delay < step * (1.0 - 1e-9):
        raise WiringError(
            f"the plant steps by {step:g} s and takes the control that was held before, so that a "
            f"sampling's delay is {step:g} s or more, got {sampling.delay:g} s. A law without "
            "delay at each step of the plant needs no sampling"
        )
    if step and abs(sampling.jitter / step - round(sampling.jitter / step)) > 1e-9:
        raise WiringError(
            f"the plant steps by {step:g} s and takes controls only then, so that a sampling's "
            f"jitter is a multiple of {step:g} s, got {sampling.jitter:g} s; give the plant a "
            "shorter time_step"
        )
    return replace(sampling, delay=max(sampling.delay - step, 0.0))
