"""Cameras, floors and drawn surfaces; what arrows and the live view show."""

import socket
from urllib.parse import urlparse

import casadi as ca
import numpy as np
import pytest
from arms import arm, parse
from members import Saddle
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix
from pydrake.systems.analysis import Simulator
from recordings import animation, objects, transforms, vertices
from runs import run_scenario, scenario, some
from two_arms import two_arms

import drake_dae as dd
from drake_dae.pictures.motion import follow, run_points
from drake_dae.robots import ConstraintWrenches
from drake_dae.scene.arrows import ForceArrows
from drake_dae.scene.surroundings import direction_of, floor_below, framed, surroundings
from drake_dae.scene.view import draw_scene


def turned(quaternion):
    """The z axis of a pose whose quaternion is (x, y, z, w), as three.js has it."""
    x, y, z, w = quaternion
    return RotationMatrix(Quaternion(np.array([w, x, y, z]))).matrix()[:, 2]


# Camera and floor.


@pytest.mark.parametrize("seed", range(10))
def test_a_camera_shows_all_points_and_stands_no_farther_than_it_must(seed):
    random = np.random.default_rng(seed)
    points = random.normal(size=(30, 3)) * random.uniform(0.1, 3.0, 3)
    direction = random.normal(size=3) * [1.0, 1.0, 0.5]
    direction /= np.linalg.norm(direction)
    side, up, down = random.uniform(0.2, 1.0, 3)
    eye, at = framed(points, direction, (side, up, down))
    forward = (at - eye) / np.linalg.norm(at - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    depth = (points - eye) @ forward
    x, y = (points - eye) @ right / depth, (points - eye) @ np.cross(right, forward) / depth
    # Round-off of a few steps.
    assert depth.min() > 0.0
    assert np.abs(x).max() <= side * (1 + 1e-9)
    assert y.max() <= up * (1 + 1e-9)
    assert -y.min() <= down * (1 + 1e-9)
    # In one direction the points reach both ends, in the other they stand in the middle.
    across, upward = min(x.max(), -x.min()) / side, min(y.max() / up, -y.min() / down)
    assert max(across, upward) == pytest.approx(1.0, abs=1e-9)


def test_the_camera_goes_where_nothing_hides_the_contact():
    contact, none = np.array([[0.5, 0.0, 0.0]]), np.zeros((1, 3))
    corners = np.array([[-0.5, -0.5, 0.0], [0.6, 0.5, 1.0]])
    usual = direction_of(corners, contact, none)
    # A link stands in the way.
    link = contact + usual * np.linspace(0.2, 0.6, 20)[:, None]
    around = direction_of(np.vstack([corners, link]), contact, none)
    assert around @ usual < 0.95
    assert around[2] == pytest.approx(usual[2])
    # A wall is looked at from its free side; at a right angle, which is a turn, round-off decides.
    c, s = np.cos(0.2), np.sin(0.2)
    free = -np.array([[c * usual[0] - s * usual[1], s * usual[0] + c * usual[1], 0.0]])
    assert usual @ free[0] < 0.0
    assert direction_of(corners, contact, free) @ free[0] > 0.0
    # What is flat is looked at more from above.
    assert direction_of(corners * [1.0, 1.0, 0.1], contact * 0, none)[2] > usual[2] + 0.2


def test_a_floor_has_round_cells_and_is_below_all():
    random = np.random.default_rng(1)
    for _ in range(50):
        points = random.normal(size=(10, 3)) * 10.0 ** random.uniform(-2.0, 3.0)
        floor = floor_below(points)
        assert f"{floor.cell:.0e}"[0] in "125"
        assert floor.cell == pytest.approx(float(f"{floor.cell:.0e}"), rel=1e-12)
        assert floor.begins[0, 2] < points[:, 2].min()
        assert np.all(floor.begins[:, :2].min(axis=0) <= points[:, :2].min(axis=0))
        assert np.all(floor.ends[:, :2].max(axis=0) >= points[:, :2].max(axis=0))
        # Each along x or along y.
        assert np.all(np.count_nonzero(floor.ends - floor.begins, axis=1) == 1)
        assert 10 < len(floor.begins) < 80


# Surfaces.


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "drawn"),
    some([("biped", ["front"]), ("cart_wall", ["wall"]), ("three_fingers", None)]),
)
def test_each_surface_is_drawn_once_around_the_whole_run(name, drawn):
    """Two feet on one floor; what wheels roll on is not drawn; each finger on its own side."""
    loop, context, record = run_scenario(scenario(name, "duration=2.0"))
    motion = follow(loop, record, context, 8.0)
    model, acting = motion.model, motion.acting
    surfaces = surroundings(model, acting, motion.points, motion.parameters[0], 0.2)
    if drawn is not None:
        assert [one.constraint.name for one in surfaces] == drawn
    places = [(one.pose @ one.picture.pose).GetAsMatrix4() for one in surfaces]
    pairs = [(a, b) for i, a in enumerate(places) for b in places[:i]]
    assert not any(np.allclose(a, b, atol=1e-9) for a, b in pairs)
    if name == "cart_wall":
        (wall,) = surfaces
        local = (wall.pose @ wall.picture.pose).inverse().multiply(motion.points[:, 0].T)
        half = np.array([wall.picture.form.width(), wall.picture.form.depth()]) / 2
        assert np.ptp(motion.points[:, 0, 0]) > 0.2  # More than it asks for.
        assert np.all(np.abs(local[:2]) <= half[:, None])
    if name == "biped":  # Its hip is at 0.7 m, its head 0.6 m above; it stands on the floor.
        assert run_points(motion, loop.scene_graph)[:, 2].max() >= 1.3
        assert 0.0 < floor_below(run_points(motion, None), surfaces).begins[0, 2] < 0.02


def shown_at_rest(model, forces):
    """The page of a robot that holds still with given constraint forces."""
    meshcat, plant = dd.start_meshcat(), dd.RobotPlant(model)
    state = plant.structure.manifold.project(model.dae.nominal_state)
    arrows = draw_scene(plant, meshcat)
    meshcat.StartRecording()
    arrows.draw(ConstraintWrenches(model)(state, forces), 0.0)
    meshcat.StopRecording()
    meshcat.PublishRecording()
    return state, meshcat.StaticHtml()


@pytest.mark.slow
@pytest.mark.parametrize(
    "surface",
    [Saddle((1.2, 0.0, 0.0), 0.5), dd.ImplicitSurface(lambda p: p[2] - p[0] ** 2, (1.2, 0.0, 0.0))],
)
def test_a_surface_without_a_shape_is_drawn(surface):
    """Around the contact, every vertex on the surface."""
    contact = dd.PointOnSurface("tool", surface, name="it")
    outputs = [dd.PointCoordinates("tool", "x")]
    model = dd.RobotModel.from_multibody(parse("two_link_arm"), [contact], outputs, [1.2, -1.6])
    _, page = shown_at_rest(model, np.array([10.0]))
    points = vertices(objects(page)["/contact/it/surface/form"])
    points += transforms(page)["/contact/it/surface"][:3, 3]
    assert len(points) > 500
    offset = ca.SX.sym("offset", 3)
    distance = ca.Function("distance", [offset], [surface.distance(offset)]).map(len(points))
    # The page holds single precision.
    np.testing.assert_allclose(distance((points - surface.position).T), 0.0, atol=1e-6)
    place = animation(page)["/contact/it/force", "position"].values[0]
    assert np.min(np.linalg.norm(points - place, axis=1)) < 0.1


# Arrows.


def test_a_pulling_force_points_the_other_way_and_zero_has_no_length():
    model, meshcat = arm("two_link").model, dd.start_meshcat()
    arrows, loads = ForceArrows(meshcat, model, length=0.3), ConstraintWrenches(model)
    state = arm("two_link").structure.manifold.project(model.dae.nominal_state)
    seen = {}
    for force in (0.0, 10.0, -20.0):
        meshcat.StartRecording()
        arrows.draw(loads(state, [force]), 0.0)
        meshcat.StopRecording()
        meshcat.PublishRecording()
        tracks = animation(meshcat.StaticHtml())
        direction = turned(tracks["/contact/wall/force", "quaternion"].values[0])
        seen[force] = direction[0], tracks["/contact/wall/force/arrow", "scale"].values[0, 0]
    assert seen[0.0][1] == pytest.approx(1e-3)
    # The wall's normal is -x; the largest force so far has the full length.
    assert seen[10.0] == pytest.approx((-1.0, 1.0), abs=1e-6)
    assert seen[-20.0] == pytest.approx((1.0, 1.0), abs=1e-6)
    assert arrows.largest_force == 20.0


@pytest.mark.slow
def test_force_and_moment_of_a_weld_are_drawn():
    """In the axes of frame A, at the origin of frame B; the moment along its axis, two heads."""
    model, load = two_arms(), np.array([40.0, 0.0, 30.0, 0.0, 6.0, 8.0])
    state, page = shown_at_rest(model, load)
    plant = model.links.plant
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, state[:14])
    frame_a = plant.GetFrameByName("object").CalcPoseInWorld(context).rotation().matrix()
    right = plant.GetModelInstanceByName("right")
    point = plant.GetFrameByName("tool", right).CalcPoseInWorld(context).translation()
    tracks = animation(page)
    for kind, acting in (("force", load[:3]), ("moment", load[3:])):
        path = f"/contact/grasp/{kind}"
        np.testing.assert_allclose(tracks[path, "position"].values[0], point, atol=1e-6)
        direction = turned(tracks[path, "quaternion"].values[0])
        np.testing.assert_allclose(direction, frame_a @ acting / np.linalg.norm(acting), atol=1e-6)
        # Each is the largest of its kind.
        scale = tracks[f"{path}/arrow", "scale"].values[0]
        np.testing.assert_allclose(scale, 1.0, rtol=1e-6)
    assert "/contact/grasp/moment/arrow/second_head" in objects(page)


# Live.


def test_live_view_draws_while_it_runs():
    meshcat = dd.start_meshcat()
    loop, context = dd.build_scenario(scenario("two_link_wall"), meshcat)
    simulator = Simulator(loop.diagram, context)
    simulator.AdvanceTo(1.25)
    page = meshcat.StaticHtml()
    state = loop.plant.state(loop.plant.GetMyContextFromRoot(context))
    arrow = transforms(page)["/contact/wall/force"]
    # The wall x = 1.2 pushes along -x.
    np.testing.assert_allclose(arrow[0, 3], 1.2, atol=1e-9)
    np.testing.assert_allclose(arrow[:3, 2], [-1.0, 0.0, 0.0], atol=1e-9)
    plant = parse("two_link_arm")
    own = plant.CreateDefaultContext()
    plant.SetPositions(own, state[:2])
    tool = plant.GetFrameByName("tool").CalcPoseInWorld(own).translation()
    np.testing.assert_allclose(arrow[:3, 3], tool, atol=1e-9)
    pose = plant.EvalBodyPoseInWorld(own, plant.GetBodyByName("link2")).GetAsMatrix4()
    link = transforms(page)["/drake/visualizer/two_link_arm/link2"]
    np.testing.assert_allclose(link, pose, atol=1e-9)
    # The path so far has 41 points, in pieces that meet; the last is where the tool is.
    first, second = (vertices(objects(page)[f"/paths/wall/actual/{k}"]) for k in (0, 1))
    assert (len(first), len(second)) == (33, 9)
    np.testing.assert_array_equal(first[-1], second[0])
    np.testing.assert_allclose(second[-1], tool, atol=1e-6)
    # A new run begins with a new path.
    context.SetTime(0.0)
    loop.plant.set_consistent_state(loop.plant.GetMyMutableContextFromRoot(context), state)
    simulator.Initialize()
    paths = [path for path in objects(meshcat.StaticHtml()) if path.startswith("/paths")]
    assert paths == ["/paths/wall/actual/0"]


def test_only_this_machine_reaches_meshcat():
    meshcat = dd.start_meshcat()
    url = urlparse(meshcat.web_url())
    assert url.hostname == "localhost"
    with socket.create_connection(("localhost", url.port), timeout=5):
        pass
    # On Linux all of 127.0.0.0/8 is this machine, so that a server on all interfaces would answer.
    with pytest.raises(OSError):  # noqa: PT011 (each system has its own words)
        socket.create_connection(("127.0.0.2", url.port), timeout=5)
