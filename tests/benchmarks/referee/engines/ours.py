"""drake_dae: ideal constraints, with the multipliers on an output port."""

from functools import cache

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

import drake_dae as dd
from referee.description import Closure, Mechanism
from referee.tree import add_tree, controls, frame_at

NAME = "drake_dae"
NOTE = "ideal constraints"
STILL = 1e-12
"""The speed of regularized friction in m/s; at 1 m/s it takes 1e-24 off Coulomb's."""


@cache
def model_of(mechanism: Mechanism) -> dd.RobotModel:
    """The mechanism as a RobotModel."""
    plant = MultibodyPlant(0.0)
    add_tree(plant, mechanism)
    for closure in mechanism.closures:
        frame_at(plant, closure.body_a, closure.point_a, f"{closure.name}_a")
        frame_at(plant, closure.body_b, closure.point_b, f"{closure.name}_b")
    plant.Finalize()
    return dd.RobotModel.from_multibody(
        plant,
        [constraint(mechanism, closure) for closure in mechanism.closures],
        [],
        mechanism.q,
        mechanism.name,
        forces=[],
        exogenous=[f"{c.name}.position" for c in mechanism.closures if any(c.road)],
        compliances={} if mechanism.split else None,
    )


def constraint(mechanism: Mechanism, closure: Closure) -> object:
    """A closure as a constraint; its points are the origins of frames."""
    name, origin = closure.name, (0.0, 0.0, 0.0)
    a, b = f"{name}_a", f"{name}_b"
    if closure.kind == "point":
        return dd.CoincidentPoints(a, origin, b, origin, closure.axes, name)
    if closure.kind == "weld":
        return dd.WeldedFrames(a, b, name=name)
    if closure.kind == "hinge":
        axis = "xyz"[int(np.argmax(np.abs(closure.direction)))]
        return dd.RevoluteLoopJoint(a, b, axis, name=name)
    if closure.kind == "distance":
        return dd.FixedDistance(a, origin, b, origin, closure.size, name)
    if closure.kind == "gear":
        leader, follower = (
            f"j{mechanism.first_joint(body)}" for body in (closure.body_a, closure.body_b)
        )
        return dd.JointCoupler(follower, leader, closure.size, name=name)
    plane = dd.Plane(closure.point_a, closure.direction)
    friction = closure.friction or None
    return dd.PointOnSurface(b, plane, name=name, friction=friction, stiction_tolerance=STILL)


def forces(mechanism: Mechanism, q: np.ndarray, v: np.ndarray) -> dict[str, np.ndarray]:
    """The force of each closure in the components of `force_names`."""
    plant = dd.RobotPlant(model_of(mechanism))
    context = context_of(plant, mechanism, q, v)
    return read(mechanism, plant, context)


def context_of(plant: dd.RobotPlant, mechanism: Mechanism, q: np.ndarray, v: np.ndarray) -> object:
    """The state, and the torques."""
    context = plant.CreateDefaultContext()
    plant.set_state(context, np.concatenate([q, v]))
    plant.GetInputPort("control").FixValue(context, np.array(controls(mechanism)))
    for closure in mechanism.closures:
        if any(closure.road):
            place, normal = np.array(closure.point_a), np.array(closure.direction)
            course = np.column_stack([place, *(part * normal for part in closure.road)])
            # Signal by signal, each with the derivatives that the plant needs.
            degrees = plant.exogenous_layout.degrees
            needed = [row[: degree + 1] for row, degree in zip(course, degrees, strict=True)]
            plant.GetInputPort("exogenous").FixValue(context, np.concatenate(needed))
    return context


def read(mechanism: Mechanism, plant: dd.RobotPlant, context: object) -> dict[str, np.ndarray]:
    """The force of each closure by the plant's ports."""
    signals = plant.model.dae.force_signals
    force = plant.GetOutputPort("constraint_force").Eval(context)
    wrench = plant.GetOutputPort("constraint_wrenches").Eval(context)
    names = [signal.name for signal in plant.wrench_signals]
    found = {}
    for closure in mechanism.closures:
        if closure.kind in ("point", "distance", "gear"):
            rows = [i for i, s in enumerate(signals) if s.name.startswith(f"{closure.name}.")]
            found[closure.name] = force[rows]
            continue
        start = names.index(f"{closure.name}.{closure.name}_b.mx")
        whole = wrench[start : start + 6]
        found[closure.name] = whole if closure.kind in ("weld", "hinge") else whole[3:]
    return found
