"""Shapes of links behind surfaces and in each other, against forward kinematics by hand."""

import numpy as np
import pytest
from pydrake.geometry import SceneGraph
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from runs import scenario

from drake_dae import (
    Cylinder,
    JointPositions,
    Plane,
    PointOnSurface,
    RobotModel,
    Sphere,
    shipped_model,
)
from drake_dae.robots.geometry.clearances import (
    LinkBehind,
    links_behind,
    surface_distances,
)
from drake_dae.robots.geometry.shapes import LinkShapes, collisions, nearest_links
from drake_dae.robots.geometry.speeds import contact_speeds
from drake_dae.scenario.feasibility.feasibility import find_feasibility

BASE, LENGTH, RADIUS = 0.3, 0.5, 0.06
JOINTS = 4


def urdf(shape):
    """Links of 0.5 m that turn about y and point along x at zero, each with a shape at its end."""
    inertia = '<mass value="1"/><inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/>'
    parts = ['<robot name="chain"><link name="base"/>']
    parts.append(
        '<joint name="mount" type="fixed"><parent link="world"/><child link="base"/>'
        f'<origin xyz="0 0 {BASE}"/></joint>'
    )
    for index in range(JOINTS):
        above, shift = (f"link{index - 1}", LENGTH) if index else ("base", 0.0)
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


def chain(surface, shape=f'<sphere radius="{RADIUS}"/>'):
    plant, scene_graph = MultibodyPlant(0.0), SceneGraph()
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    Parser(plant).AddModelsFromString(urdf(shape), "urdf")
    plant.Finalize()
    model = RobotModel.from_multibody(
        plant,
        [PointOnSurface("tip", surface, name="wall")],
        [JointPositions(["joint1", "joint2", "joint3"])],
    )
    return model, LinkShapes(model, scene_graph)


def ends(q):
    """Where the links end, m, shape (4, 3)."""
    angles = np.cumsum(q)
    steps = LENGTH * np.column_stack([np.cos(angles), 0 * angles, -np.sin(angles)])
    return np.array([0.0, 0.0, BASE]) + np.cumsum(steps, axis=0)


def behind(model, shapes, *configurations):
    states = np.column_stack([configurations, np.zeros((len(configurations), JOINTS))])
    own = np.tile(model.dae.parameter_values, (len(states), 1))
    return links_behind(model, np.arange(len(states)) / 10.0, states, own, shapes)


# The second link ends so far above the table; the base stands on it.
def bent(height):
    turn = np.arcsin((BASE - height) / (2 * LENGTH))
    return np.array([turn, 0.0, -turn - 0.4, 0.6])


def test_an_elbow_above_a_table_is_no_problem_and_one_in_it_is_named():
    """Its origin is in front of the table in both cases."""
    model, shapes = chain(Plane(point=[0.0, 0.0, 0.0], normal=[0.0, 0.0, 1.0]))
    assert behind(model, shapes, bent(0.07), bent(0.07)) == ()
    (one,) = behind(model, shapes, bent(0.07), bent(0.03), bent(0.02), bent(0.07))
    assert (one.link, one.since, one.time) == ("link1", 0.1, 0.2)
    assert one.depth == pytest.approx(RADIUS - 0.02, abs=1e-9)
    assert "link1 is behind the surface of 'wall'" in str(one)
    # By origins alone, as without shapes, nothing is seen of it.
    assert behind(model, None, bent(0.02)) == ()


@pytest.mark.parametrize(
    "shape",
    [
        '<box size="0.2 0.1 0.12"/>',
        '<cylinder radius="0.06" length="0.3"/>',
        '<capsule radius="0.06" length="0.1"/>',
    ],
)
def test_other_shapes_are_as_deep_as_their_lowest_point(shape):
    plane = Plane(point=[0.0, 0.0, 0.0], normal=[0.0, 0.0, 1.0])
    model, shapes = chain(plane, shape)
    q = bent(0.03)
    (one,) = behind(model, shapes, q)
    turn = q[0] + q[1]
    lowest = {
        "box": 0.1 * abs(np.sin(turn)) + 0.06 * np.cos(turn),
        "cylinder": 0.06 * abs(np.sin(turn)) + 0.15 * np.cos(turn),
        "capsule": 0.06 + 0.05 * np.cos(turn),
    }[shape[1:].split()[0]]
    assert (one.link, one.depth) == ("link1", pytest.approx(lowest - 0.03, rel=1e-9))


@pytest.mark.parametrize(
    ("surface", "distance"),
    [
        (Sphere(center=[0.9, 0.0, -0.4], radius=0.45), [0.9, 0.0, -0.4]),
        (Cylinder(point=[0.9, 0.0, -0.4], axis=[0.0, 1.0, 0.0], radius=0.45), [0.9, 0.0, -0.4]),
    ],
)
def test_surfaces_that_bend_are_as_deep_as_they_are_far(surface, distance):
    model, shapes = chain(surface)
    q = bent(0.05)
    (one,) = behind(model, shapes, q)
    off = np.linalg.norm(ends(q)[1] - distance)
    assert (one.link, one.depth) == ("link1", pytest.approx(0.45 + RADIUS - off, rel=1e-9))


def test_links_that_collide_are_named_with_pair_depth_and_time():
    _, shapes = chain(Plane(point=[0.0, 0.0, -9.0], normal=[0.0, 0.0, 1.0]))
    turns = np.linspace(0.3, 2.2, 20)
    states = np.array([[0.0, turn, turn, turn, 0, 0, 0, 0] for turn in turns])
    overlap = []
    for state in states:
        places = ends(state[:JOINTS])
        overlap.append(2 * RADIUS - np.linalg.norm(places[3] - places[0]))
    times = np.arange(20) / 100.0
    (one, *others) = collisions(shapes, times, states)
    assert {one.first, one.second} == {"link0", "link3"}
    assert one.depth == pytest.approx(max(overlap), rel=1e-6)
    assert one.time == times[np.argmax(overlap)]
    assert one.since == times[np.argmax(np.array(overlap) > 1e-3)]
    assert f"collide from {one.since:.4g} s on" in str(one)
    assert collisions(shapes, times[:3], states[:3]) == ()
    assert all({each.first, each.second} != {"link0", "link1"} for each in others)


def test_shapes_with_one_link_between_them_may_overlap_a_little():
    """Vendors' shapes do, as those of a base and an upper arm: the ends of two links apart."""
    _, shapes = chain(Plane(point=[0.0, 0.0, -9.0], normal=[0.0, 0.0, 1.0]))
    for overlap, count in ((0.015, 0), (0.03, 1)):
        fold = 2 * np.arccos((2 * RADIUS - overlap) / (2 * LENGTH))
        state = np.array([[0.0, 0.2, fold, 0.2, 0, 0, 0, 0]])
        assert len(collisions(shapes, np.zeros(1), state)) == count


def test_shapes_that_always_overlap_are_how_the_file_has_them():
    _, shapes = chain(
        Plane(point=[0.0, 0.0, -9.0], normal=[0.0, 0.0, 1.0]), '<sphere radius="0.6"/>'
    )
    straight = np.zeros((3, 2 * JOINTS))
    assert collisions(shapes, np.arange(3.0), straight) == ()


def test_a_robot_without_shapes_has_none():
    model, _ = chain(Plane(point=[0.0, 0.0, 0.0], normal=[0.0, 0.0, 1.0]))
    bare = LinkShapes(model, None)
    assert not bare
    assert collisions(bare, np.zeros(1), np.zeros((1, 8))) == ()


def test_the_least_distances_and_when_they_are_by_hand():
    """Balls at the ends of links over a table, and of the first and the last link."""
    model, shapes = chain(Plane(point=[0.0, 0.0, -0.5], normal=[0.0, 0.0, 1.0]))
    turns = np.linspace(0.3, 1.1, 20)
    states = np.array([[0.1, 0.2, turn, turn, 0, 0, 0, 0] for turn in turns])
    own = np.tile(model.dae.parameter_values, (20, 1))
    times = np.arange(20) / 100.0
    (table,) = surface_distances(model, times, states, own, shapes)
    # The last link is at the contact, the first at the base: of the others the third is lowest.
    heights = np.array([[ends(state[:JOINTS])[k, 2] for k in (1, 2)] for state in states]) + 0.5
    row, column = divmod(int(np.argmin(heights)), 2)
    assert (table.first, table.second) == (("link1", "link2")[column], "wall")
    assert table.distance == pytest.approx(heights[row, column] - RADIUS, rel=1e-9)
    assert table.time == times[row]
    assert "comes closest to the surface of 'wall' at" in str(table)

    near = nearest_links(shapes, times, states)
    apart = [
        np.linalg.norm(places[3] - places[0]) - 2 * RADIUS
        for places in (ends(state[:JOINTS]) for state in states)
    ]
    assert {near.first, near.second} == {"link0", "link3"}
    # Drake's distance of balls is exact.
    assert near.distance == pytest.approx(min(apart), rel=1e-9)
    assert near.time == times[np.argmin(apart)]
    # Without shapes links are their origins.
    (bare,) = surface_distances(model, times, states, own)
    assert bare.of_origin
    origins = [ends(state[:JOINTS])[k - 1, 2] + 0.5 for state in states for k in (1, 2, 3)]
    assert bare.distance == pytest.approx(min(origins), rel=1e-9)
    assert nearest_links(LinkShapes(model, None), times, states) is None


def test_a_contact_point_goes_as_fast_as_its_frame():
    """All joints turn about y: the velocity is the sum of rates times levers."""
    model, _ = chain(Plane(point=[0.0, 0.0, 0.0], normal=[0.0, 0.0, 1.0]))
    random = np.random.default_rng(3)
    states, times = random.normal(size=(20, 2 * JOINTS)), np.arange(20) / 10.0
    own = np.tile(model.dae.parameter_values, (20, 1))
    wanted = []
    for state in states:
        places = np.vstack([[0.0, 0.0, BASE], ends(state[:JOINTS])])
        velocity = sum(
            np.cross([0.0, rate, 0.0], places[-1] - joint)
            for rate, joint in zip(state[JOINTS:], places[:-1], strict=True)
        )
        wanted.append(np.linalg.norm(velocity))
    (one,) = contact_speeds(model, times, states, own)
    assert (one.constraint, one.frame) == ("wall", "tip")
    assert one.speed == pytest.approx(max(wanted), rel=1e-9)
    assert one.time == times[np.argmax(wanted)]


@pytest.mark.slow
def test_analyze_reports_shapes_before_a_run(tmp_path):
    """The first link ends at cos 1.2 or so, before a wall at 1.2 m; its ball is 0.95 m large."""
    text = shipped_model("two_link_arm.urdf").read_text()
    ball = (
        '<collision><origin xyz="1 0 0"/><geometry><sphere radius="0.95"/></geometry></collision>'
    )
    (tmp_path / "ball.urdf").write_text(
        text.replace('<link name="link1">', f'<link name="link1">{ball}')
    )
    robot = f"robot={{file: {tmp_path / 'ball.urdf'}}}"
    found = find_feasibility(scenario("two_link_wall", robot, "duration=0.5"))
    (told,) = [one for one in found.behind if isinstance(one, LinkBehind)]
    elbow = np.cos(found.analysis.motion.states[:, 0]).max()
    assert told.link == "link1"
    assert told.depth == pytest.approx(elbow + 0.95 - 1.2, abs=1e-3)
    assert any("link1 is behind the surface of 'wall'" in text for text in found.problems)
