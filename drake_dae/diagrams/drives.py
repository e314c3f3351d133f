"""The way from a controller to the drives: hold and limits."""

from dataclasses import replace

from numpy.typing import ArrayLike
from pydrake.systems.framework import DiagramBuilder, OutputPort

from drake_dae.errors import WiringError
from drake_dae.systems.control.limits import ControlLimits
from drake_dae.systems.control.sampling import ControlHold, Sampling
from drake_dae.systems.plants.contract import Plant


def add_drives(
    builder: DiagramBuilder,
    control: OutputPort,
    sampling: Sampling | None,
    control_limits: ArrayLike | None,
) -> tuple[OutputPort, ControlLimits | None]:
    """Adds hold and limits behind a control.

    Args:
        builder: The builder of the diagram.
        control: The source of the control.
        sampling, control_limits: As in `LoopSettings`.

    Returns:
        The control at the plant, and the limits.
    """
    limits = None
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
