"""Friction in pictures: the cone of each contact, and when it begins to slide."""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.pictures.moments import RunEvent, RunEventKind
from drake_dae.pictures.scene.run_motion import RunMotion
from drake_dae.trace.functions import TracedFunction


@dataclass(frozen=True, eq=False)
class DrawnFrictionCone:
    """The directions that the force of a contact may have: |F_t| <= mu F_n.

    Attributes:
        row: The place of its constraint among those that act at a point.
        coefficient: mu.
        normals: The unit normal toward the free side at each moment, in the world, shape (k, 3).
    """

    row: int
    coefficient: float
    normals: FloatArray


def friction_cones(course: RunMotion) -> list[DrawnFrictionCone]:
    """The cones of all contacts with friction, by what the plant has, not the law."""
    normals, found = course.normals, []
    for row, constraint in enumerate(course.acting.constraints):
        coefficient = course.friction.get(constraint.name, 0.0)
        lengths = np.linalg.norm(normals[:, row], axis=1, keepdims=True)
        if coefficient > 0.0 and sum(constraint.is_unilateral) == 1 and lengths.all():
            found.append(DrawnFrictionCone(row, coefficient, normals[:, row] / lengths))
    return found


def slips(course: RunMotion) -> list[RunEvent]:
    """When contacts with friction begin to slide, and when they stick again.

    Regularized friction creeps below the speed at which it is counted as sliding here, the
    stiction tolerance of its constraint. A contact without force does not slide.
    """
    model, found = course.model, list[RunEvent]()
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
            [float(each.item()) for each in speed(x[:nq], x[nq : nq + nv], own)]
            for x, own in zip(course.states, course.parameters, strict=True)
        ]
        speeds, least = np.array(values).T
        touching = np.linalg.norm([each.forces[row] for each in course.wrenches], axis=1) > 0.0
        found += _changes(constraint.name, course, (speeds > least) & touching, touching)
    return found


def _changes(
    name: str, course: RunMotion, slides: Sequence[bool], touches: Sequence[bool]
) -> list[RunEvent]:
    found, times = list[RunEvent](), course.start_time + course.times
    for place in range(len(times)):
        before = slides[place - 1] if place else False
        if slides[place] and not before:
            found.append(RunEvent(float(times[place]), RunEventKind.SLIDE, f"{name} slides"))
        elif before and not slides[place] and touches[place]:
            found.append(RunEvent(float(times[place]), RunEventKind.STICK, f"{name} sticks"))
    return found
