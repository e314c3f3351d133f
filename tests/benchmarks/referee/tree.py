"""The tree of a mechanism as a MultibodyPlant, for drake_dae and for Drake's own constraints."""

from collections.abc import Sequence

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    Frame,
    LinearSpringDamper,
    PrismaticJoint,
    RevoluteJoint,
    RotationalInertia,
    SpatialInertia,
)

from referee.description import Body, Mechanism


def inertia_of(body: Body) -> SpatialInertia:
    """The inertia about the origin of the body."""
    if body.mass == 0.0:
        return SpatialInertia.Zero()
    about_center = RotationalInertia(*body.inertia)
    return SpatialInertia.MakeFromCentralInertia(body.mass, list(body.center), about_center)


def add_tree(plant: MultibodyPlant, mechanism: Mechanism) -> None:
    """Adds bodies, the joints "j0", "j1", ..., actuators where torques act, and springs."""
    plant.mutable_gravity_field().set_gravity_vector(list(mechanism.gravity))
    number = 0
    for body in mechanism.bodies:
        parent = frame_at(plant, body.parent, body.at)
        for kind, axis in body.joints:
            last = number == mechanism.first_joint(body.name) + len(body.joints) - 1
            link = plant.AddRigidBody(
                body.name if last else f"{body.name}_{number}",
                inertia_of(body) if last else SpatialInertia.Zero(),
            )
            joint = {"turn": RevoluteJoint, "slide": PrismaticJoint}[kind]
            added = plant.AddJoint(joint(f"j{number}", parent, link.body_frame(), list(axis)))
            if number in mechanism.torques:
                plant.AddJointActuator(f"motor{number}", added)
            parent, number = link.body_frame(), number + 1
    for spring in mechanism.springs:
        ends = (body_of(plant, spring.body_a), list(spring.point_a),
                body_of(plant, spring.body_b), list(spring.point_b))  # fmt: skip
        plant.AddForceElement(LinearSpringDamper(*ends, spring.length, spring.stiffness, 0.0))


def body_of(plant: MultibodyPlant, name: str) -> object:
    """A body by its name."""
    return plant.world_body() if name == "world" else plant.GetBodyByName(name)


def frame_at(plant: MultibodyPlant, body: str, point: Sequence[float], name: str = "") -> Frame:
    """A frame of a body at a point, parallel to the body's."""
    own = body_of(plant, body).body_frame()
    if not (any(point) or name):
        return own
    name = name or f"{body}_{plant.num_frames()}"
    return plant.AddFrame(FixedOffsetFrame(name, own, RigidTransform(np.array(point))))


def controls(mechanism: Mechanism) -> list[float]:
    """The torques in the order of the actuators."""
    return [mechanism.torques[number] for number in sorted(mechanism.torques)]
