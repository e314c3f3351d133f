"""Remarks on a run: surfaces, limits, references, and its end."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from drake_dae.references import Reference
from drake_dae.robots.constraints import Constraint
from drake_dae.robots.model import RobotModel
from drake_dae.simulation.records.record import Record
from drake_dae.simulation.simulate import RunStatistics
from drake_dae.simulation.summary import Limits
from drake_dae.systems.control.phase_change import PhaseChange
from drake_dae.trace.functions import TracedFunction

_AT_ONCE, _AWAY = 0.1, 1e-3
"""A touch within this time of the start of its phase, in s, and as far before the surface, in m, is
none: a tool does not come that far."""


def surface_remarks(model: RobotModel, record: Record) -> list[str]:
    """Remarks on approximations of surfaces, and on leaving their defined range.

    Args:
        model: The robot.
        record: A record of it, with its state.
    """
    remarks = [constraint.remark for constraint in model.constraints]
    remarks += [_left(constraint, model, record) for constraint in model.constraints]
    return [remark for remark in remarks if remark]


def _left(constraint: Constraint, model: RobotModel, record: Record) -> str:
    """A remark on the first time at which a point is beyond the edge of its surface, or ""."""
    extent, dae = constraint.extent, model.dae
    if extent is None:
        return ""
    coordinates = constraint.coordinates(model.links)
    if any(ca.depends_on(coordinates, p.symbol) for p in dae.exogenous.moving):
        return ""  # The record does not contain the position of a moving surface.
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
        f"{1e3 * float(np.max(beyond)):.2g} mm, first at {first:.3g} s; there the surface "
        "continues as a plane"
    )


def limit_remarks(record: Record, limits: Limits) -> list[str]:
    """Remarks on the drive and the joint that come closest to their limits, relative to these.

    Args:
        record: A record with control and state.
        limits: The limits of the robot.
    """
    remarks = []
    if limits.control is not None and np.isfinite(limits.control).any():
        shares = np.max(np.abs(record["control"]), axis=0) / limits.control
        index, signals = int(np.argmax(shares)), record.signals["control"].signals
        unit = f" {signals[index].unit}".rstrip()
        remarks.append(
            f"of the drives {signals[index].name} comes closest to its limit, with "
            f"{shares[index]:.0%} of {limits.control[index]:.4g}{unit}"
        )
    if limits.state is not None:
        lower, upper = limits.state
        values = record["state"][:, : lower.size]
        room = np.minimum(values - lower, upper - values).min(axis=0)
        # A joint with one limit or none has no range to compare with.
        shares = np.full(lower.size, np.inf)
        np.divide(room, upper - lower, out=shares, where=np.isfinite(upper - lower))
        index, signals = int(np.argmin(shares)), record.signals["state"].signals
        if np.isfinite(shares[index]):
            unit = f" {signals[index].unit}".rstrip()
            remarks.append(
                f"of the joints {signals[index].name} comes closest to a limit, with "
                f"{room[index]:.3g}{unit} left"
            )
    return remarks


def ball_remarks(radius: float | None) -> list[str]:
    """A remark on the rolling of the ball in Drake's own contact.

    Args:
        radius: The radius of the ball in m; None without a ball.
    """
    if radius is None:
        return []
    return [
        f"Compliant contact is that of a ball of {1e3 * radius:.3g} mm. Where the robot tilts by "
        "an angle a the ball rolls,\nand touches 2 * radius * sin(a / 2) beside the point of the "
        "constraint; no stiffness changes that, a smaller\nplant.radius does."
    ]


def reference_remarks(references: Mapping[str, Any]) -> list[str]:
    """Remarks on approximations in references.

    Args:
        references: Name -> object; lists, mappings and dataclasses are searched for references.
    """
    return list(dict.fromkeys(_remarks_of(references)))


def _remarks_of(value: Any, name: str = "") -> Iterator[str]:
    if isinstance(value, Reference):
        if value.remark:
            yield f"{name}: {value.remark}" if name else value.remark
    elif isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _remarks_of(inner, key)
    elif isinstance(value, (list, tuple)):
        for inner in value:
            yield from _remarks_of(inner, name)
    elif is_dataclass(value):
        for field in fields(value):
            yield from _remarks_of(getattr(value, field.name), name)


def stop_remarks(statistics: RunStatistics | None, duration: float) -> list[str]:
    """A remark if a task ended its run before the duration was over.

    Args:
        statistics: The statistics of the run; None if it failed.
        duration: The requested duration, in s.
    """
    if statistics is None or statistics.interrupted:
        return []
    left = duration - statistics.simulated_time
    return [f"The task stops the run there, {left:.4g} s early."] if left > 1e-9 * duration else []


def touch_remarks(changes: Sequence[PhaseChange]) -> list[str]:
    """Remarks on touches that a task felt as soon as a phase began, away from the surface.

    Args:
        changes: The starts of phases of a run.
    """
    texts = []
    for before, after in pairwise(changes):
        lasted, away = after.time - before.time, after.distance
        touched = after.in_contact > before.in_contact
        if touched and not after.failed and lasted < _AT_ONCE and away > _AWAY:
            texts.append(
                f"{before.phase} felt {after.force:.3g} N {1e3 * lasted:.3g} ms after its start, "
                f"{1e3 * away:.3g} mm before the surface of the model: a bias of the force sensor "
                "feels like a touch. Find the bias by task.tare_time"
            )
    return texts
