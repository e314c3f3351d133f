"""Clearances and speeds of a robot's links along a recorded motion."""

from dataclasses import dataclass

from pydrake.systems.framework import Context

from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.robots.geometry.clearances import (
    LinkBehind,
    links_behind,
    surface_distances,
)
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
    """The least distances of a robot's links in a run, and the largest speeds of its contacts.

    Attributes:
        distances: The least distance of links from each surface, and of links from each other.
        speeds: The largest speed of each contact point.
    """

    distances: tuple[LeastDistance, ...] = ()
    speeds: tuple[ContactSpeed, ...] = ()


def links_in_the_way(
    loop: ClosedLoop, record: Record, context: Context
) -> tuple[LinkBehind | Collision, ...]:
    """Finds the links that were behind a surface in a run, and links that collided.

    Args:
        loop: The closed loop.
        record: The run.
        context: Its context, with the parameters.
    """
    if (model := loop.plant.model) is None:
        return ()
    shapes, states = LinkShapes(model, loop.scene_graph), record["state"]
    parameters = loop.plant_parameters(record, context)
    behind = links_behind(model, record.time, states, parameters, shapes)
    return *behind, *collisions(shapes, record.time, states)


def nearness(loop: ClosedLoop, record: Record, context: Context) -> Nearness:
    """Computes the least distances and largest speeds of a run; none for a plant without a robot.

    Args:
        loop: The closed loop.
        record: The run.
        context: Its context, with the parameters.
    """
    if (model := loop.plant.model) is None:
        return Nearness()
    shapes = LinkShapes(model, loop.scene_graph)
    moved = model, record.time, record["state"], loop.plant_parameters(record, context)
    links = nearest_links(shapes, record.time, record["state"])
    return Nearness(
        (*surface_distances(*moved, shapes), *([] if links is None else [links])),
        contact_speeds(*moved),
    )
