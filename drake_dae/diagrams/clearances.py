"""The links of a closed loop's robot that are in the way of a recorded motion."""

from pydrake.systems.framework import Context

from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.robots.geometry.clearances import LinkBehind, links_behind
from drake_dae.robots.geometry.shapes import Collision, LinkShapes, collisions
from drake_dae.simulation.records.record import Record


def links_in_the_way(
    loop: ClosedLoop, record: Record, context: Context
) -> tuple[LinkBehind | Collision, ...]:
    """The links that went behind a surface in a run, and those that collided.

    Args:
        loop: The closed loop.
        record: The run.
        context: Its context, with the parameters.
    """
    plant = loop.plant
    if plant.model is None:
        return ()
    own = plant.parameters_along(plant.GetMyContextFromRoot(context), record.time)
    if "exogenous" in record.signals:
        own[:, plant.exogenous_places] = record["exogenous"]
    shapes, states = LinkShapes(plant.model, loop.scene_graph), record["state"]
    behind = links_behind(plant.model, record.time, states, own, shapes)
    return *behind, *collisions(shapes, record.time, states)
