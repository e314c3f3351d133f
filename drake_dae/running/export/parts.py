"""The plant, the law and the traced functions of a closed loop or another diagram."""

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
from drake_dae.running.export.steps.boundary import check_events
from drake_dae.running.rollout.program import program_of


@dataclass(frozen=True, eq=False)
class LoopParts:
    """A diagram with one plant and one law.

    Attributes:
        plant, controller: The blocks of the plant and the law.
        diagram: The diagram.
        compiled: The functions of the diagram; None if a block cannot be traced, has Drake's own
            contact, or the controller plans its references itself.
    """

    plant: Any
    controller: Any
    diagram: Diagram
    compiled: CompiledDiagram | None

    def reference(self, context: Context) -> Callable[[float], FloatArray]:
        """Returns the controller's reference t -> R(t) for a context of the diagram."""
        own = self.diagram.CreateDefaultContext()
        own.SetTimeStateAndParametersFrom(context)
        own_of_controller = self.controller.GetMyContextFromRoot(own)
        port = self.controller.GetInputPort("reference")

        def reference(time: float) -> FloatArray:
            own.SetTime(time)
            if port.HasValue(own_of_controller):
                return np.array(port.Eval(own_of_controller))
            (value, *_) = self.controller.traced().unwired["reference"].function.call([time])
            references: FloatArray = value.full()[:, 0]
            return references

        return reference


def parts_of(loop: ClosedLoop | Diagram) -> LoopParts:
    """Finds the parts of a closed loop or of a diagram.

    Raises:
        ModelError: The diagram does not have exactly one plant and one law, or it cannot be traced.
    """
    if not isinstance(loop, Diagram):
        try:
            compiled = program_of(loop).compiled
        except ModelError:
            compiled = None
        if compiled is not None and (loop.generator is None or compiled.has_stepped):
            compiled = None
        return LoopParts(loop.plant, loop.controller, loop.diagram, compiled)
    compiled = compile_diagram(loop)
    check_events(compiled, "the diagram")
    plants = [system for system, block in compiled.blocks.items() if block.check_start is not None]
    laws = [system for system, block in compiled.blocks.items() if block.under is not None]
    if len(plants) != 1 or len(laws) != 1:
        raise ModelError(
            f"an export is of one plant and one law; this diagram has {len(plants)} plants and "
            f"{len(laws)} laws that lead to its output ports. Export the output ports of what it "
            "should compute"
        )
    return LoopParts(plants[0], laws[0], loop, compiled)
