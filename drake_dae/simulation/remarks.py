"""What a run should say of the surfaces that a robot touched, and of how it ended."""

from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import casadi as ca
import numpy as np

from drake_dae.dae.references import Reference
from drake_dae.robots.constraints import Constraint
from drake_dae.robots.model import RobotModel
from drake_dae.simulation.records.record import Record
from drake_dae.simulation.simulate import RunStatistics
from drake_dae.trace.functions import TracedFunction


def surface_remarks(model: RobotModel, record: Record) -> list[str]:
    """What of the surfaces is approximate, and where the robot left what is given of them.

    Args:
        model: The robot.
        record: A record of it, with its state.
    """
    remarks = [constraint.remark for constraint in model.constraints]
    remarks += [_left(constraint, model, record) for constraint in model.constraints]
    return [remark for remark in remarks if remark]


def _left(constraint: Constraint, model: RobotModel, record: Record) -> str:
    """When a point is first beyond the edge of its surface; empty if it never is."""
    extent, dae = constraint.extent, model.dae
    if extent is None:
        return ""
    coordinates = constraint.coordinates(model.links)
    if any(ca.depends_on(coordinates, p.symbol) for p in dae.exogenous.moving):
        return ""  # Where a surface that moves has been the record does not say.
    inputs = {"q": model.links.q, "parameters": dae.parameter_symbol}
    function = TracedFunction("coordinates", inputs, {"coordinates": coordinates})
    positions = record["state"][:, : model.links.q.numel()]
    places = np.array([function(q, dae.parameter_values)[0] for q in positions])
    beyond = np.max(np.maximum(extent[0] - places, places - extent[1]), axis=1)
    if not np.any(beyond > 0.0):
        return ""
    first = record.time[int(np.argmax(beyond > 0.0))]
    return (
        f"{constraint.name}: the robot is beyond the edge of the data by up to "
        f"{1e3 * float(np.max(beyond)):.2g} mm, first at {first:.3g} s; there a plane goes on"
    )


def ball_remarks(radius: float | None) -> list[str]:
    """What the ball of Drake's own contact does that a point does not.

    Args:
        radius: The radius of the ball in m; None where there is none.
    """
    if radius is None:
        return []
    return [
        f"Drake's own contact is that of a ball of {1e3 * radius:.3g} mm. Where the robot tilts by "
        "an angle a the ball rolls,\nand touches 2 * radius * sin(a / 2) beside the point of the "
        "constraint; no stiffness changes that, a smaller\nplant.radius does."
    ]


def reference_remarks(references: Mapping[str, Any]) -> list[str]:
    """What of the references is approximate.

    Args:
        references: What holds references, in lists, mappings and data classes, by name.
    """
    return list(dict.fromkeys(_told(references)))


def _told(one: Any, name: str = "") -> Iterator[str]:
    if isinstance(one, Reference):
        if one.remark:
            yield f"{name}: {one.remark}" if name else one.remark
    elif isinstance(one, Mapping):
        for key, inner in one.items():
            yield from _told(inner, key)
    elif isinstance(one, (list, tuple)):
        for inner in one:
            yield from _told(inner, name)
    elif is_dataclass(one):
        for part in fields(one):
            yield from _told(getattr(one, part.name), name)


def stop_remarks(statistics: RunStatistics | None, duration: float) -> list[str]:
    """That a task has ended its run, where it has; no failure and no signal did.

    Args:
        statistics: What the run took; None where it failed.
        duration: How long it should have lasted, in s.
    """
    if statistics is None or statistics.interrupted:
        return []
    left = duration - statistics.simulated_time
    return [f"The task stops the run there, {left:.4g} s early."] if left > 1e-9 * duration else []
