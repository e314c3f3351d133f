"""The parts of a loop in C99, as far as each can be written."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydrake.systems.framework import Context, Diagram

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.signals import Signal
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.running.export.steps.boundary import (
    ExportedPart,
    controller_part,
    loop_part,
    plant_part,
)

CONTROLLER, PLANT, LOOP = "controller", "plant", "loop"
"""The kinds of parts."""

MAKERS: dict[str, Callable[[ClosedLoop | Diagram, Context], ExportedPart]] = {
    LOOP: loop_part,
    PLANT: plant_part,
    CONTROLLER: controller_part,
}


@dataclass(frozen=True, eq=False)
class WrittenPart:
    """A part that was written as C99.

    Attributes:
        part: It.
        kind: "controller", "plant" or "loop".
        parameters, states: Names and units; a controller has no continuous state.
        values, start: Their defaults.
        inputs: Those of the inputs.
        longest: The longest step of a plant or a loop at first, in s.
        time: Of the start, in s.
        files: The header and the source, and what else there is.
    """

    part: ExportedPart
    kind: str
    parameters: Sequence[Signal]
    values: FloatArray
    inputs: FloatArray
    files: tuple[Path, ...]
    time: float
    states: Sequence[Signal] = ()
    start: FloatArray = field(default_factory=lambda: np.zeros(0))
    longest: float = 0.0


class Export(NamedTuple):
    """What an export wrote, and what it did not.

    Attributes:
        files: The files.
        left_out: Why a part is not among them, a sentence for each.
    """

    files: list[Path]
    left_out: list[str]


def parts_of_loop(
    loop: ClosedLoop | Diagram, context: Context, kinds: Sequence[str]
) -> tuple[dict[str, ExportedPart], list[str]]:
    """The parts of a loop that can be exported, and why the others can not.

    Args:
        loop: The loop, or any diagram with one `Plant`.
        context: Its context at the start.
        kinds: Which parts are asked for.

    Raises:
        ModelError: No part can be exported: why.
    """
    found, left_out = dict[str, ExportedPart](), list[str]()
    for kind in kinds:
        try:
            found[kind] = MAKERS[kind](loop, context)
        except ModelError as error:
            left_out.append(f"the controller: {error}" if kind == CONTROLLER else str(error))
    if not found:
        raise ModelError(f"nothing of it can be exported: {'; '.join(left_out)}")
    return found, left_out


def defaults(part: ExportedPart, context: Context) -> tuple[FloatArray, FloatArray]:
    """The parameters of a part, and its inputs when a run begins.

    Args:
        part: The part.
        context: The context of the diagram at the start; not changed.
    """
    values = part.compiled.values(context)
    if not part.inputs:
        return values, np.zeros(0)
    # What a law holds, and the plant reads, is no number before a run begins.
    own = context.Clone()
    own.SetAccuracy(1e-9)
    part.compiled.diagram.ExecuteInitializationEvents(own)
    count = part.compiled.inputs[0][1].start
    return values[:count], part.compiled.values(own)[count:]
