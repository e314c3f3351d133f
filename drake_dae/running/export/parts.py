"""What an export takes of a closed loop, or of any diagram with a plant and a law in it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, Diagram

from drake_dae.arrays import FloatArray
from drake_dae.compiler.compile import compile_diagram
from drake_dae.compiler.compiled import CompiledDiagram
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.running.rollout.program import program_of


@dataclass(frozen=True, eq=False)
class LoopParts:
    """A diagram with one plant and one law.

    Attributes:
        plant, controller: The blocks.
        diagram: The diagram.
        compiled: Its functions; None where something in it cannot be traced, is stepped by Drake,
            or changes at moments that a run has to find.
    """

    plant: Any
    controller: Any
    diagram: Diagram
    compiled: CompiledDiagram | None

    def reference(self, context: Context) -> Callable[[float], FloatArray]:
        """R(t) as the controller takes it, in a context of the diagram."""
        own = self.diagram.CreateDefaultContext()
        own.SetTimeStateAndParametersFrom(context)
        own_of_controller = self.controller.GetMyContextFromRoot(own)
        port = self.controller.GetInputPort("reference")

        def reference(time: float) -> FloatArray:
            own.SetTime(time)
            if port.HasValue(own_of_controller):
                return np.array(port.Eval(own_of_controller))
            (value, *_) = self.controller.traced().unwired["reference"].function.call([time])
            found: FloatArray = value.full()[:, 0]
            return found

        return reference


def parts_of(loop: ClosedLoop | Diagram) -> LoopParts:
    """The parts of a closed loop or of a diagram.

    Raises:
        ModelError: A diagram has no plant or no law, or more than one of them, or cannot be traced.
    """
    if not isinstance(loop, Diagram):
        try:
            compiled = program_of(loop).compiled
        except ModelError:
            compiled = None
        if compiled is not None and (compiled.changes or compiled.has_stepped):
            compiled = None
        return LoopParts(loop.plant, loop.controller, loop.diagram, compiled)
    compiled = compile_diagram(loop)
    if compiled.changes:
        names = ", ".join(system.get_name() for system, _ in (*compiled.guards, *compiled.watched))
        raise ModelError(
            f"'{names}' changes at moments that a run has to find, as where a contact opens: no "
            "export knows it, and a rollout does"
        )
    if compiled.has_stepped:
        name = compiled.stepped[1].system.get_name()
        raise ModelError(
            f"'{name}' has Drake's own contact, which no export knows; a rollout does. Export a "
            "diagram with an ideal plant"
        )
    plants = [each for each, block in compiled.blocks.items() if block.check_start is not None]
    laws = [each for each, block in compiled.blocks.items() if block.under is not None]
    if len(plants) != 1 or len(laws) != 1:
        raise ModelError(
            f"an export is of one plant and one law; this diagram has {len(plants)} plants and "
            f"{len(laws)} laws that lead to its output ports. Export the output ports of what it "
            "should compute"
        )
    return LoopParts(plants[0], laws[0], loop, compiled)
