"""Joints that close loops: the same mechanism, cut at another joint, moves and pushes alike.

A ring of eight joints in space, from the ground over seven links to the ground, has two freedoms.
Cut at one joint, that one closes the loop and the others are Drake's; cut at another, it is one of
Drake's, with the damping, spring, limits and motor that it had.
"""

from functools import cache

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce, MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    PrismaticJoint,
    PrismaticSpring,
    RevoluteJoint,
    RevoluteSpring,
    SpatialInertia,
    UnitInertia,
)

from drake_dae import (
    JointPositions,
    PrismaticLoopJoint,
    RevoluteLoopJoint,
    RobotModel,
    RobotPlant,
    find_structure,
)
from drake_dae.errors import ModelError

COUNT = 8
SLIDES = {2, 6}
"""Joints that slide; the others turn."""
DRIVEN = {3, 6}
DAMPING = np.array([0.2, 0.3, 0.4, 0.25, 0.15, 0.35, 0.5, 0.1])
SPRING = {2: (30.0, 0.05), 3: (2.0, -0.3)}
"""Stiffness, and where it is slack, by joint."""


def places():
    """Where each joint is at the coordinates 0, in the world: its axis is the z axis there."""
    random = np.random.default_rng(4)
    for i in range(COUNT):
        angle = 2.0 * np.pi * i / COUNT
        centre = np.array([0.6 * np.cos(angle) + 0.6, 0.6 * np.sin(angle), 0.0])
        rpy = RollPitchYaw(random.uniform(-1.0, 1.0, 3))
        yield RigidTransform(rpy, centre + random.uniform(-0.15, 0.15, 3))


PLACES = list(places())


@cache
def ring(cut: int) -> RobotModel:
    """The ring as a tree with its joint number `cut` as the constraint.

    Link i lies between joints i - 1 and i; links 0 and 8 are the ground. At the coordinates 0 all
    frames of links are parallel to the world, at its origin.
    """
    plant = MultibodyPlant(0.0)
    frames = [plant.world_frame()]
    random = np.random.default_rng(5)
    for i in range(1, COUNT):
        middle = (PLACES[i - 1].translation() + PLACES[i].translation()) / 2.0
        own = UnitInertia.SolidEllipsoid(*random.uniform(0.05, 0.2, 3))
        mass = random.uniform(0.5, 2.0)
        central = SpatialInertia(mass, np.zeros(3), own)
        body = plant.AddRigidBody(f"link{i}", central.Shift(-middle))
        frames.append(body.body_frame())
    frames.append(plant.world_frame())

    def add(i: int, forward: bool) -> None:
        kind = PrismaticJoint if i in SLIDES else RevoluteJoint
        parent, child = (
            plant.AddFrame(FixedOffsetFrame(f"joint{i}_{side}", frame, PLACES[i]))
            for side, frame in enumerate(frames[i : i + 2][:: 1 if forward else -1])
        )
        axis = np.array([0.0, 0.0, 1.0 if forward else -1.0])
        joint = plant.AddJoint(kind(f"joint{i}", parent, child, axis, damping=DAMPING[i]))
        if i in SPRING:
            stiffness, rest = SPRING[i]
            spring = PrismaticSpring if i in SLIDES else RevoluteSpring
            plant.AddForceElement(spring(joint, rest, stiffness))
        if i in DRIVEN:
            plant.AddJointActuator(f"joint{i}_motor", joint, 40.0)

    for i in range(cut):
        add(i, True)
    for i in range(COUNT - 1, cut, -1):
        add(i, False)
    plant.mutable_gravity_field().set_gravity_vector([0.3, -0.5, -9.81])
    plant.Finalize()
    kind = PrismaticLoopJoint if cut in SLIDES else RevoluteLoopJoint
    place, rpy = PLACES[cut].translation(), RollPitchYaw(PLACES[cut].rotation()).vector()
    where = {"point_a": tuple(place), "rpy_a": tuple(rpy), "point_b": tuple(place)}
    names = ["world", *(f"link{i}" for i in range(1, COUNT)), "world"]
    stiffness, rest = SPRING.get(cut, (0.0, 0.0))
    motor = {"motor": True, "effort_limit": 40.0} if cut in DRIVEN else {}
    loop = kind(
        names[cut],
        names[cut + 1],
        **where,
        rpy_b=tuple(rpy),
        damping=float(DAMPING[cut]),
        stiffness=stiffness,
        rest=rest,
        **motor,
    )
    outputs = ["joint1", "joint5"]
    return RobotModel.from_multibody(
        plant, [loop], [JointPositions(outputs)], forces=[], name=f"cut at {cut}"
    )


def tree_joints(cut: int) -> list[int]:
    """The numbers of the joints in the order of q."""
    return [*range(cut), *range(COUNT - 1, cut, -1)]


@cache
def structure(cut: int):
    return find_structure(ring(cut).dae)


def coordinates(cut: int, state):
    """All eight coordinates and their rates, by number."""
    model = ring(cut)
    plant = RobotPlant(model, structure=structure(cut))
    context = plant.CreateDefaultContext()
    plant.set_state(context, state)
    own = plant.GetOutputPort("loop_state").Eval(context)
    order = tree_joints(cut)
    result = np.zeros((2, COUNT))
    result[0, order], result[1, order] = np.split(state, 2)
    result[:, cut] = own
    return result


def moving(seed: int):
    """A consistent state of the ring, by the numbers of the joints."""
    random = np.random.default_rng(seed)
    guess = np.concatenate([0.25 * random.uniform(-1, 1, 7), random.uniform(-1, 1, 7)])
    return coordinates(7, structure(7).manifold.project(guess))


def rates(cut: int, both, torques):
    """The plant with its control set, its context, and all accelerations of the tree by number."""
    model, order = ring(cut), tree_joints(cut)
    plant = RobotPlant(model, structure=structure(cut))
    context = plant.CreateDefaultContext()
    plant.set_state(context, np.concatenate([both[0, order], both[1, order]]))
    named = [int(s.name[5]) if s.name[0] == "j" else cut for s in model.dae.control_signals]
    control = [torques[i] for i in named]
    plant.GetInputPort("control").FixValue(context, control)
    found = np.full(COUNT, np.nan)
    found[order] = plant.EvalTimeDerivatives(context).CopyToVector()[7:]
    return plant, context, found


@pytest.mark.slow
@pytest.mark.parametrize("cut", [2, 3, 6])
def test_what_the_loop_joint_exerts_is_what_drakes_joint_does(cut):
    """Drake's forward dynamics and reaction forces of the tree that is cut at joint 7, which gets
    the force of that cut from outside. Forces up to 100 N: 1e-9."""
    random = np.random.default_rng(cut)
    both, torques = moving(1), random.uniform(-5.0, 5.0, COUNT)
    other, own, expected = rates(7, both, torques)
    plant, context, _ = rates(cut, both, torques)
    tree = ring(7).links.plant
    inside = tree.CreateDefaultContext()
    tree.SetPositionsAndVelocities(inside, other.state(own))
    wrenches = other.GetOutputPort("constraint_wrenches").Eval(own)
    acting = ExternallyAppliedSpatialForce()
    acting.body_index = tree.GetBodyByName("link7").index()
    first = other.wrench_signals[0].name
    on_link = wrenches[:6] if first.startswith("loop.link7") else wrenches[6:]
    joint = ring(7).constraints[0]
    axis = ring(7).links.plant.EvalBodyPoseInWorld(inside, tree.GetBodyByName("link7")).rotation()
    along = axis.matrix() @ PLACES[7].rotation().matrix()[:, 2]
    damping = DAMPING[7] * both[1, 7] * along  # On link 7, the parent of that joint.
    acting.F_Bq_W = SpatialForce(on_link[:3] + damping, on_link[3:])
    assert joint.frame_a == "link7"
    tree.get_applied_spatial_force_input_port().FixValue(inside, [acting])
    tree.get_actuation_input_port().FixValue(inside, [torques[3], torques[6]])
    drakes = tree.get_generalized_acceleration_output_port().Eval(inside)
    assert_allclose(drakes, expected[:7], rtol=1e-9, atol=1e-9)
    reaction = tree.get_reaction_forces_output_port().Eval(inside)[
        int(tree.GetJointByName(f"joint{cut}").index())
    ]
    # On the child, in its own frame of the joint; turned to that of the parent.
    turn = 0.0 if cut in SLIDES else both[0, cut]
    turned = RotationMatrix.MakeZRotation(turn).matrix()
    force, moment = turned @ reaction.translational(), turned @ reaction.rotational()
    names = [signal.name for signal in ring(cut).dae.constraint_input_signals]
    found = dict(zip(names, plant.GetOutputPort("constraint_force").Eval(context), strict=True))
    by_drake = dict(zip(["fx", "fy", "fz", "mx", "my", "mz"], [*force, *moment], strict=True))
    for name, value in found.items():
        assert value == pytest.approx(by_drake[name.split(".")[1]], rel=1e-9, abs=1e-9)
    assert len(found) == 5


@pytest.mark.parametrize(("low", "high"), [(0.0, 4.5), (-0.5, 3.5)])
def test_the_angle_counts_from_the_middle_of_its_limits(low, high):
    """In a chain that is closed by nothing else: 3 rad beyond a middle of 2 is 5, and not -1.28."""
    loop = RevoluteLoopJoint("world", "link1", "z", lower=low, upper=high, damping=1.0)
    plant = MultibodyPlant(0.0)
    body = plant.AddRigidBody("link1", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    plant.AddJoint(
        RevoluteJoint("turn", plant.world_frame(), body.body_frame(), np.array([0.0, 0.0, 1.0]))
    )
    plant.Finalize()
    model = RobotModel.from_multibody(plant, [], [])
    angle = ca.Function("c", [model.links.q], [loop.coordinates(model.links)])
    middle = (low + high) / 2.0
    for value in middle + np.array([-3.0, -1.5, 1.0, 3.0]):
        assert float(angle(value)) == pytest.approx(value, abs=1e-14)
    assert float(angle(middle + 3.2)) == pytest.approx(middle + 3.2 - 2.0 * np.pi, abs=1e-14)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RevoluteLoopJoint("a", "b", "w"), "axis"),
        (lambda: RevoluteLoopJoint("a", "b", damping=-1.0), "damping"),
        (lambda: RevoluteLoopJoint("a", "b", lower=1.0, upper=0.5), "lower.*upper"),
        (lambda: RevoluteLoopJoint("a", "b", upper=3.5, name="knee"), "'knee'.*3.5"),
        (lambda: RevoluteLoopJoint("a", "b", effort_limit=3.0), "effort_limit|motor"),
        (lambda: RevoluteLoopJoint("a", "b", velocity_limit=0.0), "velocity_limit"),
        (lambda: PrismaticLoopJoint("a", "b", "x", normal="x"), "'x'"),
        (lambda: PrismaticLoopJoint("a", "b", "x", normal="n"), "normal"),
    ],
)
def test_refusals(make, message):
    with pytest.raises(ModelError, match=message):
        make()
