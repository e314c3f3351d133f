"""Numbers of a loop or diagram that are set by the names that a page shows."""

from pydrake.systems.framework import Context, Diagram

from drake_dae import ClosedLoop
from drake_dae.blocks.compose import Leaves
from drake_dae.blocks.traced_system import TracedSystem


def parameter_names(loop: ClosedLoop | Diagram) -> dict[str, tuple[TracedSystem, int]]:
    """ "block.parameter" -> the block, and the place among its numeric parameters."""
    diagram = loop if isinstance(loop, Diagram) else loop.diagram
    return {
        f"{system.get_name()}.{signal.name}": (system, i)
        for system in Leaves.of(diagram).systems
        if isinstance(system, TracedSystem)
        for i, signal in enumerate(system.block.signals.get("parameters", ()))
    }


def set_inputs(loop: ClosedLoop | Diagram, context: Context, changes: dict[str, float]) -> None:
    """Sets the parameters in a context whose names end with those of `changes`."""
    for ending, value in changes.items():
        places = [p for name, p in parameter_names(loop).items() if name.endswith(ending)]
        assert places, ending
        for system, i in places:
            own = system.GetMyMutableContextFromRoot(context)
            own.get_mutable_numeric_parameter(0).SetAtIndex(i, value)
