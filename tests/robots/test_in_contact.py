"""Normals of contacts, and the depth of links behind a surface, against forward kinematics."""

import numpy as np
import pytest
from arms import parse
from numpy.testing import assert_allclose
from pydrake.geometry import SceneGraph
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable
from runs import scenario

from drake_dae import (
    Cylinder,
    JointPositions,
    Plane,
    PointCoordinates,
    PointOnSurface,
    RobotModel,
    Sphere,
    shipped_model,
)
from drake_dae.robots import (
    ConstraintSet,
    ConstraintWrenches,
    MultibodyExpressions,
    contact_normals,
    links_behind,
)
from drake_dae.scenario.judging import find_feasibility


def rubbing_arm():
    wall = Plane((1.2, 0, 0), (-1, 0, 0))
    contact = PointOnSurface("tool", wall, name="wall", friction=0.3, stiction_tolerance=0.05)
    outputs = [PointCoordinates("tool", "z")]
    return RobotModel.from_multibody(parse("two_link_arm"), [contact], outputs, [1.2, -1.6])


def sphere_arm():
    contact = PointOnSurface("tool", Sphere((1.5, 0, 0.2), 0.4), name="ball")
    outputs = [JointPositions(["joint1"])]
    return RobotModel.from_multibody(parse("two_link_arm"), [contact], outputs, [1.2, -1.6])


@pytest.mark.parametrize("make", [rubbing_arm, sphere_arm], ids=["friction", "sphere"])
def test_normal_is_the_direction_in_which_the_residual_grows(make):
    """n = d phi / d(point), the tool's row of the constraint's Jacobian by MultibodyPlant: phi'
    is n . (J_point v) for any v, where friction does not enter; 1e-12 is round-off."""
    model = make()
    plant, rng = model.links.plant, np.random.default_rng(3)
    own = plant.CreateDefaultContext()
    normals, wrenches = contact_normals(model), ConstraintWrenches(model)
    kinematics = model.links.kinematics()
    rate = kinematics.value(ConstraintSet(model.constraints).rate(kinematics))
    rates = model.dae.trace("rate", {"value": rate})
    for _ in range(5):
        state = rng.normal(size=model.dae.num_states)
        plant.SetPositionsAndVelocities(own, state)
        (normal,) = normals(state, model.dae.parameter_values)
        (point,) = wrenches(state, [1.0]).points
        body = plant.GetFrameByName(wrenches.frames[0])
        seen = body.CalcPoseInWorld(own).inverse() @ point
        world = plant.world_frame()
        jacobian = plant.CalcJacobianTranslationalVelocity(
            own, JacobianWrtVariable.kV, body, seen, world, world
        )
        moving = jacobian @ plant.GetVelocities(own)
        assert_allclose(normal @ moving, rates(state, model.dae.parameter_values)[0], atol=1e-12)


BASE, LENGTH, RADIUS, JOINTS = 0.3, 0.5, 0.06, 4
TABLE = Plane(point=[0.0, 0.0, 0.0], normal=[0.0, 0.0, 1.0])


def urdf(shape, joints):
    """Links of 0.5 m that turn about y and point along x at zero, each with a shape at its end.

    Four are a chain; a fifth stands on the base.
    """
    inertia = '<mass value="1"/><inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/>'
    parts = ['<robot name="chain"><link name="base"/>']
    parts.append(
        '<joint name="mount" type="fixed"><parent link="world"/><child link="base"/>'
        f'<origin xyz="0 0 {BASE}"/></joint>'
    )
    for index in range(joints):
        above, shift = (f"link{index - 1}", LENGTH) if index % 4 else ("base", 0.0)
        parts.append(
            f'<link name="link{index}"><inertial><origin xyz="0.25 0 0"/>{inertia}</inertial>'
            f'<collision><origin xyz="{LENGTH} 0 0"/><geometry>{shape}</geometry></collision>'
            f'</link><joint name="joint{index}" type="revolute"><parent link="{above}"/>'
            f'<child link="link{index}"/><origin xyz="{shift} 0 0"/><axis xyz="0 1 0"/>'
            '<limit lower="-3" upper="3" effort="9" velocity="9"/></joint>'
            f"<transmission><type>transmission_interface/SimpleTransmission</type><joint "
            f'name="joint{index}"/><actuator name="motor{index}"/></transmission>'
        )
    parts.append('<frame name="tip" link="link3" xyz="0.5 0 0" rpy="0 0 0"/></robot>')
    return "".join(parts)


def chain(surface, shape=f'<sphere radius="{RADIUS}"/>', joints=JOINTS):
    plant, scene_graph = MultibodyPlant(0.0), SceneGraph()
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    Parser(plant).AddModelsFromString(urdf(shape, joints), "urdf")
    plant.Finalize()
    return RobotModel(
        MultibodyExpressions(plant, scene_graph),
        [PointOnSurface("tip", surface, name="wall")],
        [JointPositions([f"joint{k}" for k in range(1, joints)])],
        plant.GetDefaultPositions(),
        "chain",
    )


def ends(q):
    """Where the links end, m, shape (4, 3)."""
    angles = np.cumsum(q)
    steps = LENGTH * np.column_stack([np.cos(angles), 0 * angles, -np.sin(angles)])
    return np.array([0.0, 0.0, BASE]) + np.cumsum(steps, axis=0)


def behind(model, *configurations):
    states = np.column_stack([configurations, np.zeros_like(configurations)])
    own = np.tile(model.dae.parameter_values, (len(states), 1))
    return links_behind(model, np.arange(len(states)) / 10.0, states, own)


def bent(height):
    """The second link ends so far above the table, on which the base stands."""
    turn = np.arcsin((BASE - height) / (2 * LENGTH))
    return np.array([turn, 0.0, -turn - 0.4, 0.6])


def test_an_elbow_above_a_table_is_no_problem_and_one_in_it_is_named():
    """Its origin is in front of the table in both cases."""
    model = chain(TABLE)
    assert behind(model, bent(0.07), bent(0.07)) == ()
    (one,) = behind(model, bent(0.07), bent(0.03), bent(0.02), bent(0.07))
    assert (one.link, one.time) == ("link1", 0.2)
    assert one.depth == pytest.approx(RADIUS - 0.02, abs=1e-9)


def test_a_link_beside_the_one_in_contact_is_named():
    """The last link of the robot, on the base: it ends next to the contact, and below the table."""
    (one,) = behind(chain(TABLE, joints=5), [-1.0, 1.0, 1.2, 1.4, 0.55])
    depth = RADIUS - (BASE - LENGTH * np.sin(0.55))
    assert (one.link, one.depth) == ("link4", pytest.approx(depth, rel=1e-9))


def test_a_surface_above_the_base_ends_before_what_is_nearer_to_the_base():
    """The base is 0.1 m behind it, and so is the end of the first link, 0.5 m beside the base."""
    height = 0.1
    model = chain(Plane((0.0, 0.0, BASE + height), (0.0, 0.0, 1.0)))

    def touching(far):
        """The contact is so far from that end: the second link points up, the others down to it."""
        across, down = np.sqrt(far**2 - height**2), LENGTH - height
        turn = np.arctan2(down, across)
        half = np.arccos(np.hypot(across, down) / (2 * LENGTH))
        return np.diff([0.0, -np.pi / 2, turn - half, turn + half], prepend=0.0)

    assert behind(model, touching(1.05 * LENGTH)) == ()
    (one,) = behind(model, touching(0.95 * LENGTH))
    assert (one.link, one.depth) == ("link0", pytest.approx(height + RADIUS, rel=1e-9))


@pytest.mark.parametrize(
    ("shape", "lowest"),
    [
        ('<box size="0.2 0.1 0.12"/>', lambda a: 0.1 * abs(np.sin(a)) + 0.06 * np.cos(a)),
        (
            '<cylinder radius="0.06" length="0.3"/>',
            lambda a: 0.06 * abs(np.sin(a)) + 0.15 * np.cos(a),
        ),
        ('<capsule radius="0.06" length="0.1"/>', lambda a: 0.06 + 0.05 * np.cos(a)),
    ],
)
def test_other_shapes_are_as_deep_as_their_lowest_point(shape, lowest):
    q = bent(0.03)
    (one,) = behind(chain(TABLE, shape), q)
    assert (one.link, one.depth) == ("link1", pytest.approx(lowest(q[0] + q[1]) - 0.03, rel=1e-9))


@pytest.mark.parametrize(
    "surface",
    [
        Sphere(center=[0.9, 0.0, -0.4], radius=0.45),
        Cylinder(point=[0.9, 0.0, -0.4], axis=[0.0, 1.0, 0.0], radius=0.45),
    ],
)
def test_surfaces_that_bend_are_as_deep_as_they_are_far(surface):
    q = bent(0.05)
    (one,) = behind(chain(surface), q)
    off = np.linalg.norm(ends(q)[1] - [0.9, 0.0, -0.4])
    assert (one.link, one.depth) == ("link1", pytest.approx(0.45 + RADIUS - off, rel=1e-9))


@pytest.mark.slow
def test_analysis_and_run_tell_a_link_behind_a_wall(tmp_path):
    """The first link ends at cos 1.2 or so, before a wall at 1.2 m; its ball is 0.95 m large."""
    ball = (
        '<collision><origin xyz="1 0 0"/><geometry><sphere radius="0.95"/></geometry></collision>'
    )
    text = shipped_model("two_link_arm.urdf").read_text()
    (tmp_path / "ball.urdf").write_text(
        text.replace('<link name="link1">', f'<link name="link1">{ball}')
    )
    robot = f"robot={{file: {tmp_path / 'ball.urdf'}}}"
    found = find_feasibility(scenario("two_link_wall", robot, "duration=0.5"))
    (one,) = found.behind
    elbow = np.cos(found.analysis.motion.states[:, 0]).max()
    assert (one.constraint, one.link) == ("wall", "link1")
    assert one.depth == pytest.approx(elbow + 0.95 - 1.2, abs=1e-3)
    assert any("link1" in text for text in found.problems)
    assert found.to_dict()["behind"][0]["depth"] == one.depth
