"""Drake's discrete MultibodyPlant: SAP with its constraints and contacts.

A step solves J v+ = -phi / h with the Jacobian of its start, so the part J' v of the acceleration
enters after some steps. Forces of constraints are found from the change of momentum in a step: they
are on no port. Contact forces are on a port. The settings are the best of those that were tried.
"""

from typing import NamedTuple

import numpy as np
from pydrake.geometry import (
    AddContactMaterial,
    HalfSpace,
    ProximityProperties,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    CoulombFriction,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import JacobianWrtVariable, MultibodyForces, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

from referee.description import Closure, Mechanism
from referee.tree import add_tree, body_of, controls

NAME = "Drake, SAP"
NOTE = (
    "near-rigid constraints on rates in discrete time: the force of the tenth step of 1e-6 s. "
    "Contacts of 1e9 N/m: the third step of 1e-5 s; where they slide, the 30th of 1e-4 s with "
    "Drake's lagged approximation, since SAP's own lifts what slides. Motions in 10,000 steps"
)
STIFFNESS, RADIUS, GRIP = 1e9, 0.01, 10.0


class Settings(NamedTuple):
    """How contact is approximated, the step in s, and the number of the step that is read."""

    approximation: str
    step: float
    count: int


RIGID, STICKING, SLIDING = (
    Settings("sap", 1e-6, 10),
    Settings("sap", 1e-5, 3),
    Settings("lagged", 1e-4, 30),
)


STEPS = 10_000
"""The steps of a motion."""


def settings_for(mechanism: Mechanism, duration: float = 0.0) -> Settings:
    """The settings for its kinds of closures."""
    if duration:
        return Settings("sap", duration / STEPS, STEPS)
    if any(closure.friction for closure in mechanism.closures):
        return SLIDING
    touching = any(closure.kind in ("plane", "ball") for closure in mechanism.closures)
    return STICKING if touching else RIGID


def diagram_of(
    mechanism: Mechanism, rotations: dict[str, np.ndarray], settings: Settings
) -> tuple[Diagram, MultibodyPlant]:
    """The plant with its geometry; balls that touch are placed for the given orientations."""
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(
        time_step=settings.step,
        discrete_contact_approximation=settings.approximation,
        contact_model="point",
    )
    plant, _ = AddMultibodyPlant(config, builder)
    add_tree(plant, mechanism)
    # A constraint to the world's own body ends the process in Drake 1.51.
    anchor = plant.AddRigidBody("anchor", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    plant.WeldFrames(plant.world_frame(), anchor.body_frame())
    for closure in mechanism.closures:
        add(plant, mechanism, closure, rotations)
    plant.Finalize()
    return builder.Build(), plant


def add(
    plant: MultibodyPlant,
    mechanism: Mechanism,
    closure: Closure,
    rotations: dict[str, np.ndarray],
) -> None:
    """A closure as a constraint or a contact."""
    a, b = (
        plant.GetBodyByName("anchor" if name == "world" else name)
        for name in (closure.body_a, closure.body_b)
    )
    point_a, point_b = list(closure.point_a), list(closure.point_b)
    if closure.kind == "point":
        plant.AddBallConstraint(body_A=a, p_AP=point_a, body_B=b, p_BQ=point_b)
    elif closure.kind == "weld":
        plant.AddWeldConstraint(
            body_A=a, X_AP=RigidTransform(point_a), body_B=b, X_BQ=RigidTransform(point_b)
        )
    elif closure.kind == "distance":
        plant.AddDistanceConstraint(
            body_A=a, p_AP=point_a, body_B=b, p_BQ=point_b, distance=closure.size
        )
    elif closure.kind == "gear":
        leader, follower = (
            plant.GetJointByName(f"j{mechanism.first_joint(body)}")
            for body in (closure.body_a, closure.body_b)
        )
        plant.AddCouplerConstraint(follower, leader, closure.size)
    else:
        add_contact(plant, closure, rotations)


def add_contact(plant: MultibodyPlant, closure: Closure, rotations: dict[str, np.ndarray]) -> None:
    """A half space, and a ball on the body that touches it at the point."""
    normal, ball = np.array(closure.direction), closure.kind == "ball"
    radius = closure.size if ball else RADIUS
    lift = np.zeros(3) if ball else RADIUS * rotations[closure.body_b].T @ normal
    mu = GRIP if ball else closure.friction
    properties = ProximityProperties()
    AddContactMaterial(
        dissipation=0.0,
        point_stiffness=STIFFNESS,
        friction=CoulombFriction(mu, mu),
        properties=properties,
    )
    ground = RigidTransform(RotationMatrix.MakeFromOneVector(normal, 2), np.array(closure.point_a))
    if not plant.GetCollisionGeometriesForBody(plant.world_body()):
        plant.RegisterCollisionGeometry(
            plant.world_body(), ground, HalfSpace(), "ground", properties
        )
    plant.RegisterCollisionGeometry(
        plant.GetBodyByName(closure.body_b),
        RigidTransform(np.array(closure.point_b) + lift),
        Sphere(radius),
        closure.name,
        properties,
    )


def mass_matrix(mechanism: Mechanism, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """M in the order of the description."""
    plant = MultibodyPlant(1e-3)
    add_tree(plant, mechanism)
    plant.Finalize()
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    return plant.CalcMassMatrix(context)


def rotations_at(mechanism: Mechanism, q: np.ndarray) -> dict[str, np.ndarray]:
    """The orientation of each body."""
    plant = MultibodyPlant(1e-3)
    add_tree(plant, mechanism)
    plant.Finalize()
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    return {
        body.name: plant.GetBodyByName(body.name).EvalPoseInWorld(context).rotation().matrix()
        for body in mechanism.bodies
    }


def after(mechanism: Mechanism, q: np.ndarray, v: np.ndarray) -> dict[str, np.ndarray]:
    """The forces after the motion from there."""
    if any(closure.kind == "plane" for closure in mechanism.closures):
        raise NotImplementedError("a ball stands for the point that touches: other motion")
    return forces(mechanism, q, v, mechanism.duration)


def forces(
    mechanism: Mechanism, q: np.ndarray, v: np.ndarray, duration: float = 0.0
) -> dict[str, np.ndarray]:
    """The force of each closure in the components of `force_names`, after a while."""
    if any(any(closure.road) for closure in mechanism.closures):
        raise NotImplementedError("no constraint or contact that moves with time")
    if any(closure.kind == "hinge" for closure in mechanism.closures):
        raise NotImplementedError("no hinge among its constraints")
    touching = any(closure.kind in ("plane", "ball") for closure in mechanism.closures)
    if mechanism.split and not touching:
        raise NotImplementedError("the forces of its constraints are on no port, only their sum")
    settings = settings_for(mechanism, duration)
    diagram, plant = diagram_of(mechanism, rotations_at(mechanism, q), settings)
    simulator = Simulator(diagram)
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    plant.SetPositions(context, q)
    plant.SetVelocities(context, v)
    plant.get_actuation_input_port().FixValue(context, controls(mechanism))
    simulator.Initialize()
    simulator.AdvanceTo((settings.count - 0.5) * settings.step)
    if touching:
        simulator.AdvancePendingEvents()
        return contacts(mechanism, plant, context)
    before = plant.GetPositions(context), plant.GetVelocities(context)
    simulator.AdvanceTo((settings.count + 0.5) * settings.step)
    after = plant.GetVelocities(context)
    plant.SetPositions(context, before[0])
    plant.SetVelocities(context, before[1])
    return by_momentum(mechanism, plant, context, (after - before[1]) / settings.step)


def by_momentum(
    mechanism: Mechanism, plant: MultibodyPlant, context: Context, acceleration: np.ndarray
) -> dict[str, np.ndarray]:
    """The forces at the closures that explain the change of rates in a step."""
    applied = MultibodyForces(plant)
    plant.CalcForceElementsContribution(context, applied)
    needed = plant.CalcInverseDynamics(context, acceleration, applied)
    needed -= plant.MakeActuationMatrix() @ np.array(controls(mechanism))
    rows = [rows_of(mechanism, plant, context, closure) for closure in mechanism.closures]
    every = np.linalg.lstsq(np.vstack(rows).T, needed, rcond=1e-12)[0]
    parts = np.split(every, np.cumsum([len(part) for part in rows])[:-1])
    return {c.name: part for c, part in zip(mechanism.closures, parts, strict=True)}


def rows_of(
    mechanism: Mechanism, plant: MultibodyPlant, context: Context, closure: Closure
) -> np.ndarray:
    """The Jacobian of a closure, shape (m, n)."""
    if closure.kind == "gear":
        row = np.zeros((1, mechanism.size))
        row[0, mechanism.first_joint(closure.body_b)] = 1.0
        row[0, mechanism.first_joint(closure.body_a)] = -closure.size
        return row
    world, twists, places = plant.world_frame(), [], []
    ends = (closure.body_a, closure.point_a), (closure.body_b, closure.point_b)
    for body, point in ends:
        frame = body_of(plant, body).body_frame()
        where = np.array(point).reshape(3, 1)
        twists.append(
            plant.CalcJacobianSpatialVelocity(
                context, JacobianWrtVariable.kV, frame, point, world, world
            )
        )
        places.append(plant.CalcPointsPositions(context, frame, where, world)[:, 0])
    relative = twists[1] - twists[0]
    if closure.kind == "weld":
        return relative
    if closure.kind == "distance":
        away = places[1] - places[0]
        return (away / np.linalg.norm(away))[None] @ relative[3:]
    return relative[3:][["xyz".index(axis) for axis in closure.axes]]


def contacts(
    mechanism: Mechanism, plant: MultibodyPlant, context: Context
) -> dict[str, np.ndarray]:
    """The contact force on the body of each closure, in the world."""
    results = plant.get_contact_results_output_port().Eval(context)
    infos = [results.point_pair_contact_info(i) for i in range(results.num_point_pair_contacts())]
    found = {}
    for closure in mechanism.closures:
        body = plant.GetBodyByName(closure.body_b)
        place = body.EvalPoseInWorld(context) @ np.array(closure.point_b)
        if closure.kind == "ball":
            place = place - closure.size * np.array(closure.direction)
        if not infos:
            raise NotImplementedError("the contact opened")
        near = min(
            infos, key=lambda info, place=place: np.linalg.norm(info.contact_point() - place)
        )
        # On B of the pair.
        sign = 1.0 if near.bodyB_index() == body.index() else -1.0
        found[closure.name] = sign * near.contact_force()
    return found
