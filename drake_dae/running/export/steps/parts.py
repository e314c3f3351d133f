"""The parts of a loop that can be written as C99."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydrake.systems.framework import Context, Diagram

from drake_dae.arrays import FloatArray
from drake_dae.dae import Signal
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
        part: The part.
        kind: "controller", "plant" or "loop".
        parameters: Names and units of the parameters.
        values: The default parameters.
        inputs: The default inputs.
        files: The header, the source, and any further files.
        time: The start time, in s.
        states: Names and units of the continuous state; a controller has none.
        start: The initial continuous state.
        longest: The default of the longest step of a plant or a loop, in s.
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
    """The result of an export.

    Attributes:
        files: The paths of the written files.
        left_out: For each part that was not written, a sentence with the reason.
    """

    files: list[Path]
    left_out: list[str]


def parts_of_loop(
    loop: ClosedLoop | Diagram, context: Context, kinds: Sequence[str]
) -> tuple[dict[str, ExportedPart], list[str]]:
    """Returns the parts of a loop that can be exported, and the reasons for the other parts.

    Args:
        loop: The loop, or any diagram with one `Plant`.
        context: Its context at the start.
        kinds: The kinds of the requested parts.

    Raises:
        ModelError: No part can be exported; the message has the reasons.
    """
    parts, left_out = dict[str, ExportedPart](), list[str]()
    for kind in kinds:
        try:
            parts[kind] = MAKERS[kind](loop, context)
        except ModelError as error:
            left_out.append(f"the controller: {error}" if kind == CONTROLLER else str(error))
    if not parts:
        raise ModelError(f"nothing of it can be exported: {'; '.join(left_out)}")
    return parts, left_out


def defaults(part: ExportedPart, context: Context) -> tuple[FloatArray, FloatArray]:
    """The parameters of a part, and its inputs at the start of a run.

    Args:
        part: The part.
        context: The context of the diagram at the start; not changed.
    """
    values = part.compiled.values(context)
    if not part.inputs:
        return values, np.zeros(0)
    # A discrete control, which the plant reads, is nan before a run is initialized.
    own = context.Clone()
    part.compiled.diagram.ExecuteInitializationEvents(own)
    count = part.compiled.inputs[0][1].start
    return values[:count], part.compiled.values(own)[count:]
