"""Friction in pictures: the friction cones of contacts, and when contacts slide and stick."""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.pictures.moments import RunEvent, RunEventKind
from drake_dae.pictures.run_motion import RunMotion
from drake_dae.trace.functions import TracedFunction


@dataclass(frozen=True, eq=False)
class DrawnFrictionCone:
    """The friction cone of a contact, |F_t| <= mu F_n.

    Attributes:
        row: The index of its constraint among those that act at a point.
        coefficient: mu, the coefficient of friction.
        normals: The unit normal toward the free side in each frame, in the world, shape (k, 3).
    """

    row: int
    coefficient: float
    normals: FloatArray


def friction_cones(course: RunMotion) -> list[DrawnFrictionCone]:
    """Returns the cones of all contacts with friction, with the plant's coefficients."""
    normals, cones = course.normals, []
    for row, constraint in enumerate(course.acting.constraints):
        coefficient = course.friction.get(constraint.name, 0.0)
        lengths = np.linalg.norm(normals[:, row], axis=1, keepdims=True)
        if coefficient > 0.0 and sum(constraint.is_unilateral) == 1 and lengths.all():
            cones.append(DrawnFrictionCone(row, coefficient, normals[:, row] / lengths))
    return cones


def slips(course: RunMotion) -> list[RunEvent]:
    """Returns the events at which contacts with friction begin to slide, and stick again.

    A contact slides if its speed is above the stiction tolerance of its constraint, since
    regularized friction always creeps, and if it has a force.
    """
    model, events = course.model, list[RunEvent]()
    kinematics = model.links.kinematics()
    for row, constraint in enumerate(course.acting.constraints):
        velocity = constraint.sliding(kinematics)
        tolerance = {p.name: p for p in constraint.parameters}.get(
            f"{constraint.name}.stiction_tolerance"
        )
        if velocity is None or tolerance is None or not course.friction.get(constraint.name):
            continue
        speed = TracedFunction(
            "sliding speed",
            {"q": model.links.q, "v": model.links.v, "parameters": model.dae.parameter_symbol},
            {"speed": kinematics.value(ca.norm_2(velocity)), "least": tolerance.symbol},
        )
        nq, nv = model.links.q.numel(), model.links.v.numel()
        values = [
            [float(value.item()) for value in speed(x[:nq], x[nq : nq + nv], parameters)]
            for x, parameters in zip(course.states, course.parameters, strict=True)
        ]
        speeds, least = np.array(values).T
        forces = [wrench.forces[row] for wrench in course.wrenches]
        touches = np.linalg.norm(forces, axis=1) > 0.0
        events += _changes(constraint.name, course, (speeds > least) & touches, touches)
    return events


def _changes(
    name: str, course: RunMotion, slides: Sequence[bool], touches: Sequence[bool]
) -> list[RunEvent]:
    """Returns the events at which a contact begins to slide or sticks again."""
    events, slid_before = list[RunEvent](), False
    times = (course.start_time + course.times).tolist()
    for time, is_sliding, is_touching in zip(times, slides, touches, strict=True):
        if is_sliding and not slid_before:
            events.append(RunEvent(time, RunEventKind.SLIDE, f"{name} slides"))
        elif slid_before and not is_sliding and is_touching:
            events.append(RunEvent(time, RunEventKind.STICK, f"{name} sticks"))
        slid_before = is_sliding
    return events
