"""Links of a closed loop's robot along a recorded motion: in the way, how near, how fast."""

from dataclasses import dataclass

from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.robots.geometry.clearances import LinkBehind, links_behind, surface_distances
from drake_dae.robots.geometry.shapes import (
    Collision,
    LeastDistance,
    LinkShapes,
    collisions,
    nearest_links,
)
from drake_dae.robots.geometry.speeds import ContactSpeed, contact_speeds
from drake_dae.simulation.records.record import Record


@dataclass(frozen=True)
class Nearness:
    """How near the links of a robot came to anything in a run, and how fast its contacts went.

    Attributes:
        distances: The least distance from each surface, and of links from each other.
        speeds: The largest speed of each contact point.
    """

    distances: tuple[LeastDistance, ...] = ()
    speeds: tuple[ContactSpeed, ...] = ()


def links_in_the_way(
    loop: ClosedLoop, record: Record, context: Context
) -> tuple[LinkBehind | Collision, ...]:
    """The links that went behind a surface in a run, and those that collided.

    Args:
        loop: The closed loop.
        record: The run.
        context: Its context, with the parameters.
    """
    if (model := loop.plant.model) is None:
        return ()
    shapes, states = LinkShapes(model, loop.scene_graph), record["state"]
    own = _parameters(loop, record, context)
    behind = links_behind(model, record.time, states, own, shapes)
    return *behind, *collisions(shapes, record.time, states)


def nearness(loop: ClosedLoop, record: Record, context: Context) -> Nearness:
    """How near and how fast the links of a robot were in a run; nothing of another plant.

    Args:
        loop: The closed loop.
        record: The run.
        context: Its context, with the parameters.
    """
    if (model := loop.plant.model) is None:
        return Nearness()
    shapes = LinkShapes(model, loop.scene_graph)
    moved = model, record.time, record["state"], _parameters(loop, record, context)
    links = nearest_links(shapes, record.time, record["state"])
    return Nearness(
        (*surface_distances(*moved, shapes), *([] if links is None else [links])),
        contact_speeds(*moved),
    )


def _parameters(loop: ClosedLoop, record: Record, context: Context) -> FloatArray:
    """The parameters of the plant at the times of a record, one row each."""
    plant = loop.plant
    own = plant.parameters_along(plant.GetMyContextFromRoot(context), record.time)
    if "exogenous" in record.signals:
        own[:, plant.exogenous_places] = record["exogenous"]
    return own
