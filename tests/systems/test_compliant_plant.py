"""Compliant contact as traced equations, against Drake's MultibodyPlant and closed forms."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from arms import arm, fixed_step, parse
from numpy.testing import assert_allclose
from pydrake.geometry import (
    AddContactMaterial,
    CollisionFilterDeclaration,
    GeometrySet,
    HalfSpace,
    ProximityProperties,
    Role,
    SceneGraph,
)
from pydrake.geometry import Cylinder as Rod
from pydrake.geometry import Sphere as Ball
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    CoulombFriction,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import PrismaticJoint, SpatialInertia, UnitInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
from runs import some

import drake_dae as dd
from drake_dae.errors import ModelError, SimulationError
from drake_dae.running import start_values
from drake_dae.scenario.shipped import FOLDER
from drake_dae.systems import PointMaterial

MATERIAL = {"stiffness": 1e5, "dissipation": 2.0, "friction": 0.3, "radius": 0.01}


class Pair(NamedTuple):
    """A CompliantPlant, and the same robot in a MultibodyPlant."""

    plant: dd.CompliantPlant
    diagram: object
    drake: MultibodyPlant

    def drake_context(self, state, control):
        context = self.diagram.CreateDefaultContext()
        own = self.drake.GetMyMutableContextFromRoot(context)
        self.drake.SetPositionsAndVelocities(own, state)
        self.drake.get_actuation_input_port().FixValue(own, control)
        return context


def drawn(shape: str):
    """A surface for the seven-joint arm, and its solid for Drake, outside for round ones."""
    point, radius = np.array([0.7, 0.0, 0.6]), 0.4
    if shape == "plane":
        tilt = np.array([-1.0, 0.1, 0.2]) / np.linalg.norm([-1.0, 0.1, 0.2])
        solid = HalfSpace(), HalfSpace.MakePose(tilt, point)
        return dd.Plane(point=point, normal=tilt), solid
    center = point + np.array([radius, 0.0, 0.0])
    if shape == "cylinder":
        surface = dd.Cylinder(point=center, axis=(0.0, 0.0, 1.0), radius=radius)
        return surface, (Rod(radius, 10.0), RigidTransform(center))
    return dd.Sphere(center=center, radius=radius), (Ball(radius), RigidTransform(center))


def on_arm(surface, time_step: float = 0.0, **material: float) -> dd.CompliantPlant:
    """The seven-joint arm on a surface."""
    links = arm("seven_joint").model
    wall = dd.PointOnSurface("tool", surface, name="wall", friction=0.3)
    model = dd.RobotModel(
        links.links, [wall], links.outputs, links.nominal_positions, forces=["wall.force"]
    )
    return dd.CompliantPlant(model, PointMaterial(time_step, **{**MATERIAL, **material}))


@cache
def pair(shape: str, time_step: float, dissipation: float = 2.0) -> Pair:
    surface, (form, pose) = drawn(shape)
    plant = on_arm(surface, time_step, dissipation=dissipation)
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(time_step=time_step, contact_model="point")
    drake, scene = AddMultibodyPlant(config, builder)
    parser = Parser(drake)
    parser.package_map().AddPackageXml(str(FOLDER / "models" / "package.xml"))
    parser.AddModelsFromUrl("package://drake_dae_models/seven_joint_arm.dmd.yaml")
    add_ball(plant, drake, scene, form, pose, dissipation)
    drake.Finalize()
    return Pair(plant, builder.Build(), drake)


def add_ball(plant, drake, scene: SceneGraph, form, pose, dissipation) -> None:
    """A ball that touches at the tool in the nominal configuration, and the solid."""
    properties = ProximityProperties()
    friction = CoulombFriction(0.3, 0.3)
    AddContactMaterial(dissipation, 2e5, friction, properties)
    own = parse("seven_joint_arm")
    context = own.CreateDefaultContext()
    state = plant.structure.manifold.project(plant.dae.nominal_state)
    own.SetPositions(context, state[: own.num_positions()])
    tool = own.GetFrameByName("tool")
    at = tool.CalcPoseInWorld(context)
    if isinstance(form, HalfSpace):
        normal = pose.rotation().matrix()[:, 2]
    else:
        normal = at.translation() - pose.translation()
        normal[2] *= not isinstance(form, Rod)
        normal /= np.linalg.norm(normal)
    center = at.rotation().matrix().T @ normal * MATERIAL["radius"]
    frame = drake.GetFrameByName("tool")
    on_body = frame.GetFixedPoseInBodyFrame() @ RigidTransform(center)
    body, world = frame.body(), drake.world_body()
    both = [
        drake.RegisterCollisionGeometry(body, on_body, Ball(0.01), "ball", properties),
        drake.RegisterCollisionGeometry(world, pose, form, "solid", properties),
    ]
    every = scene.model_inspector().GetAllGeometryIds(Role.kProximity)
    manager = scene.collision_filter_manager()
    manager.Apply(CollisionFilterDeclaration().ExcludeWithin(GeometrySet(every)))
    allowed = (GeometrySet([one]) for one in both)
    manager.Apply(CollisionFilterDeclaration().AllowBetween(*allowed))


def near_contact(plant, count: int, seed: int):
    """States in and near contact at speeds from a creep to a blow, and torques."""
    random, size = np.random.default_rng(seed), plant.model.links.q.numel()
    start = plant.structure.manifold.project(plant.dae.nominal_state)
    for _ in range(count):
        speed = random.choice([1e-5, 1e-3, 0.1])
        change = np.concatenate([random.normal(0.0, 2e-4, size), random.normal(0.0, speed, size)])
        yield start + change, random.normal(0.0, 20.0, size)


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["plane", "sphere", "cylinder"])
def test_the_rate_is_that_of_a_continuous_multibody_plant(shape):
    """To 1e-9 of the largest acceleration: both are a few thousand operations of round-off."""
    both, pressed = pair(shape, 0.0), 0
    context = both.plant.CreateDefaultContext()
    for state, control in near_contact(both.plant, 100, 1):
        both.plant.set_state(context, state)
        both.plant.GetInputPort("control").FixValue(context, control)
        found = both.plant.EvalTimeDerivatives(context).CopyToVector()
        theirs = both.drake_context(state, control)
        wanted = both.diagram.EvalTimeDerivatives(theirs).CopyToVector()
        assert_allclose(found, wanted, rtol=0.0, atol=1e-9 * np.abs(wanted).max())
        pressed += both.plant.GetOutputPort("constraint_force").Eval(context)[0] > 1.0
    assert 20 < pressed < 80


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "dissipation"),
    some([("plane", 0.0), ("plane", 2.0), ("plane", 30.0), ("sphere", 2.0), ("cylinder", 2.0)]),
)
def test_a_step_is_that_of_a_discrete_multibody_plant(shape, dissipation):
    """Its solver stops at a relative residual of 1e-6; without contact only round-off is left."""
    both, pressed = pair(shape, 1e-3, dissipation), 0
    size = both.plant.model.links.q.numel()
    for state, control in near_contact(both.plant, 100, 2):
        found, force = stepped(both.plant, state, control)
        simulator = Simulator(both.diagram, both.drake_context(state, control))
        simulator.AdvanceTo(0.5e-3)
        own = both.drake.GetMyContextFromRoot(simulator.get_context())
        wanted = both.drake.GetPositionsAndVelocities(own)
        moved = np.abs(wanted[size:] - state[size:]).max()
        limit = 1e-5 if force.any() else 1e-12
        assert_allclose(found[size:], wanted[size:], rtol=0.0, atol=limit * moved)
        assert_allclose(found[:size], wanted[:size], rtol=0.0, atol=1e-3 * limit * moved + 1e-15)
        pressed += bool(force.any())
    assert 20 < pressed < 80


def stepped(plant, state, control):
    """The state and the contact forces after a step."""
    context = plant.CreateDefaultContext()
    plant.set_state(context, state)
    plant.GetInputPort("control").FixValue(context, control)
    simulator = Simulator(plant, context)
    simulator.AdvanceTo(0.5 * plant.time_step)
    return plant.state(context), plant.GetOutputPort("contact_force").Eval(context)


@pytest.mark.slow
@pytest.mark.parametrize("inside", [False, True])
def test_a_distance_that_is_exact_on_the_surface_alone_will_do(inside):
    """An ellipsoid with equal axes is a sphere of 0.1 m, of ten times the radius of the ball.

    The distance of the ellipsoid is exact to first order in the depth d of up to 0.3 mm, which
    leaves k d^2 / (2 R) = 0.05 N; at the center of the ball it would be 0.4 mm off, or 40 N.
    """
    center = (0.7 - 0.1, 0.0, 0.6) if inside else (0.7 + 0.1, 0.0, 0.6)
    sphere = on_arm(dd.Sphere(center, 0.1, inside=inside))
    ellipsoid = on_arm(dd.Ellipsoid(center, (0.1, 0.1, 0.1), inside=inside))
    found = []
    for state, _ in near_contact(sphere, 50, 3):
        for plant in (sphere, ellipsoid):
            context = plant.CreateDefaultContext()
            plant.set_state(context, state)
            found.append(plant.GetOutputPort("contact_force").Eval(context))
    assert np.abs(found[::2]).max() > 10.0
    assert_allclose(found[1::2], found[::2], rtol=0.0, atol=0.1)


@pytest.mark.slow
def test_a_ball_that_its_surface_has_no_room_for_is_refused():
    hollow = dd.Ellipsoid((0.7 - 0.05, 0.0, 0.6), (0.05, 0.05, 0.05), inside=True)
    plant = on_arm(hollow, radius=0.04)
    with pytest.raises(ModelError, match=r"0.06.*'wall'"):
        on_arm(hollow, radius=0.06)
    context = plant.CreateDefaultContext()
    with pytest.raises(ModelError, match="'wall'"):
        plant.set_contact(context, replace(plant.material, radius=0.06))


def sled(stop: float = np.inf, exogenous: Sequence[str] = ()) -> dd.RobotModel:
    """A block that slides along x and z, on a floor at z = 0, pulled along x and pressed by u."""
    plant = MultibodyPlant(0.0)
    inertia = SpatialInertia(2.0, np.zeros(3), UnitInertia.SolidCube(0.1))
    rail = plant.AddRigidBody("rail", SpatialInertia(0.1, np.zeros(3), UnitInertia.SolidCube(0.1)))
    block = plant.AddRigidBody("block", inertia)
    world = plant.world_frame()
    along = PrismaticJoint("x", world, rail.body_frame(), [1.0, 0.0, 0.0], -np.inf, stop)
    along = plant.AddJoint(along)
    up = plant.AddJoint(PrismaticJoint("z", rail.body_frame(), block.body_frame(), [0, 0, 1.0]))
    for joint in (along, up):
        plant.AddJointActuator(f"{joint.name()}_motor", joint, 1e3)
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, 0.0])
    plant.Finalize()
    floor = dd.Plane(point=[0.0, 0.0, 0.0], normal=[0.0, 0.0, 1.0])
    contact = dd.PointOnSurface("block", floor, name="floor", friction=0.5)
    return dd.RobotModel.from_multibody(plant, [contact], [], forces=[], exogenous=exogenous)


PRESSED = [0.0, -1e-3, 0.0, 0.0]
"""Pressed in by 10 N / 1e4 N/m."""


def driven(plant, state, **inputs):
    """A diagram of a plant with constant inputs, its context and the plant's, from a state on."""
    builder = DiagramBuilder()
    builder.AddSystem(plant)
    for name, values in inputs.items():
        source = builder.AddSystem(ConstantVectorSource(values))
        builder.Connect(source.get_output_port(), plant.GetInputPort(name))
    builder.ExportOutput(plant.GetOutputPort("state"), "state")
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    own = plant.GetMyMutableContextFromRoot(context)
    plant.set_state(own, state)
    return diagram, context, own


def run_sled(time_step, pull, duration, **material):
    """The state of the sled under a pull and a press of 10 N, after a time."""
    plant = dd.CompliantPlant(sled(), PointMaterial(time_step, stiffness=1e4, **material))
    diagram, context, own = driven(plant, PRESSED, control=[pull, -10.0])
    dd.simulate(diagram, context, duration, fixed_step(1e-4))
    return plant.state(own)


@pytest.mark.slow
def test_creep_at_half_the_friction_limit_tells_the_two_laws_apart():
    """step5(s) = 1/2 at s = 1/2, and s / sqrt(1 + s^2) = 1/2 at 1 / sqrt(3).

    After 0.1 s the start has decayed by e^-100 and more.
    """
    tolerance = 1e-3
    for time_step, share in ((0.0, 0.5), (1e-4, 1.0 / np.sqrt(3.0))):
        state = run_sled(time_step, 2.5, 0.1, stiction_tolerance=tolerance)
        assert_allclose(state[2], share * tolerance, rtol=1e-8)


@pytest.mark.parametrize("steps", [1.0, 2.0])
def test_friction_settles_with_fixed_steps_up_to_m_v_s_by_mu_f_n(steps):
    """Where step5 is steepest; the step is 15/8 of the time constant of friction, or 15/4.

    Explicit schemes are stable up to 2.0 (Euler) to 3.3 (this one). Each of 1,000 steps takes an
    error to a fifth, down to round-off, or lets it grow until friction is less steep.
    """
    tolerance = 1e-4 * 5.0 / 2.1 / steps
    state = run_sled(0.0, 2.5, 0.1, stiction_tolerance=tolerance)
    off = abs(state[2] - 0.5 * tolerance) / tolerance
    assert off < 1e-8 if steps == 1.0 else off > 0.05, off


def test_a_contact_opens_and_strikes_with_the_restitution_of_hunt_and_crossley():
    """A falling sled, without dissipation, rises to where it fell from: energy is conserved.

    Steps of 1e-5 s of RK5 leave 1e-6 of it.
    """
    plant = dd.CompliantPlant(sled(), PointMaterial(0.0, stiffness=1e4, friction=0.0))
    diagram, context, own = driven(plant, [0.0, 0.05, 0.0, 0.0], control=[0.0, -20.0])
    fall = np.sqrt(2 * 0.05 / 10.0)
    dd.simulate(diagram, context, fall, fixed_step(1e-5))
    assert_allclose(plant.state(own)[3], -np.sqrt(2 * 10.0 * 0.05), rtol=1e-6)
    dd.simulate(diagram, context, 0.1, fixed_step(1e-5))
    state = plant.state(own)
    assert state[3] > 0.0
    energy = 0.5 * 2.0 * state[3] ** 2 + 20.0 * state[1]
    assert_allclose(energy, 20.0 * 0.05, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("time_step", [0.0, 1e-3])
def test_a_moving_floor_takes_the_sled_along(time_step):
    """A floor at 0.2 m/s pulls the sled with mu N = 5 N until it is as fast, to within v_s."""
    robot = sled(exogenous=["floor.position"])
    plant = dd.CompliantPlant(robot, PointMaterial(time_step, stiffness=1e4))
    moving = np.zeros(plant.exogenous_layout.reference_size)
    moving[1] = 0.2  # x, x', ...
    diagram, context, own = driven(plant, PRESSED, control=[0.0, -10.0], exogenous=moving)
    dd.simulate(diagram, context, 0.05, fixed_step(1e-4))
    assert_allclose(plant.state(own)[2], 0.05 * 5.0 / 2.1, rtol=0.03)
    dd.simulate(diagram, context, 0.2, fixed_step(1e-4))
    assert_allclose(plant.state(own)[2], 0.2, atol=1e-4)


def test_a_joint_at_its_limit_ends_the_run_with_a_reason():
    """The sled slides up to the stop of its rail."""
    plant = dd.CompliantPlant(sled(stop=0.2), PointMaterial(1e-3, stiffness=1e4))
    diagram, context, _ = driven(plant, [0.0, -1e-3, 0.5, 0.0], control=[6.0, -10.0])
    with pytest.raises(SimulationError, match="!MultibodyPlant") as found:
        dd.simulate(diagram, context, 1.0)
    assert 0.15 < found.value.state[0] < 0.2
    assert 0.0 < found.value.time < 1.0
    context = diagram.CreateDefaultContext()
    plant.set_state(plant.GetMyMutableContextFromRoot(context), [0.0, -1e-3, 0.5, 0.0])
    (run,) = dd.rollout(diagram, *start_values(diagram, context), [0.0, 1.0], compiled=False)
    assert str(run.failure) == str(found.value)
    assert_allclose(run.failure.state, found.value.state, atol=1e-12)


def test_a_constraint_that_is_no_contact_is_refused():
    links = arm("two_link").model.links
    pin = dd.CoincidentPoints("world", (1.2, 0.0, 0.0), "tool", (0.0, 0.0, 0.0), "x")
    model = dd.RobotModel(links, [pin], [dd.PointCoordinates("tool", "z")])
    with pytest.raises(ModelError, match="'pin'"):
        dd.CompliantPlant(model, PointMaterial())
