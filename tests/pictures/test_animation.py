"""The picture of a closed loop in Meshcat, live and recorded, against MultibodyPlant."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from arms import fixed_step, parse
from browser import needs_chromium
from browser import shown as in_browser
from members import Mirror
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RollPitchYaw, RotationMatrix
from recordings import animation, commands, middles, objects, overlay, transforms, vertices
from runs import run, run_scenario, scenario, some

from drake_dae import (
    ConstantReference,
    JointPositions,
    Record,
    RobotModel,
    RobotPlant,
    TrackingLaw,
    build_scenario,
    make_animation,
    make_closed_loop,
    poles,
    robots,
    simulate,
)
from drake_dae.diagrams.record import Recorded
from drake_dae.pictures.motion import frame_times
from drake_dae.robots import ConstraintWrenches
from drake_dae.scene.surroundings import diagonal, scene_points

NAMES = ["two_link_wall", "seven_joint_dome"]
"""On a plane and on a sphere."""


@cache
def recorded(name, *settings):
    """A run of a scenario, and the page of its animation, which changes nothing."""
    loop, context, record = run_scenario(scenario(name, *settings))
    state, time = context.get_continuous_state_vector().CopyToVector(), context.get_time()
    page = make_animation(loop, record, context)
    np.testing.assert_array_equal(context.get_continuous_state_vector().CopyToVector(), state)
    assert context.get_time() == time
    np.testing.assert_array_equal(loop.record(context).time, record.time)
    return loop, record, page


@pytest.fixture(scope="module", params=NAMES)
def shown(request):
    return recorded(request.param, "duration=1")


def at(record, name, times):
    """A recorded signal at other times, shape (k, size)."""
    moments = record.time - record.time[0]
    return np.array([np.interp(times, moments, column) for column in record[name].T]).T


def rotation(quaternion):
    """From (x, y, z, w), as three.js has it."""
    x, y, z, w = quaternion
    return RotationMatrix(Quaternion(np.array([w, x, y, z]))).matrix()


@pytest.mark.slow
def test_every_link_moves_as_the_plant_does(shown):
    loop, record, page = shown
    tracks = animation(page)
    plant = parse(loop.plant.dae.name)
    context = plant.CreateDefaultContext()
    q = at(record, "state", np.arange(33) / 32)[:, : plant.num_positions()]
    moving = 0
    for joint in (plant.get_joint(index) for index in plant.GetJointIndices()):
        body = joint.child_body()
        path = f"/drake/visualizer/{loop.plant.dae.name}/{body.name()}"
        if (path, "position") not in tracks:
            continue  # It has no geometry.
        position, turn = tracks[path, "position"], tracks[path, "quaternion"]
        # 1 s at 32 frames a second.
        for track in (position, turn):
            np.testing.assert_array_equal(track.times, np.arange(33) / 32)
        moving += np.ptp(turn.values, axis=0).max() > 0.01
        for frame in (0, 7, 16, 32):
            plant.SetPositions(context, q[frame])
            pose = plant.EvalBodyPoseInWorld(context, body)
            # The page holds single precision.
            np.testing.assert_allclose(position.values[frame], pose.translation(), atol=1e-6)
            np.testing.assert_allclose(
                rotation(turn.values[frame]), pose.rotation().matrix(), atol=1e-6
            )
    assert moving >= 2


@pytest.mark.slow
def test_the_arrow_stands_at_the_contact_along_the_normal(shown):
    """For a plane and a sphere, where normal and force are known without the library."""
    loop, record, page = shown
    tracks = animation(page)
    contact = loop.plant.model.constraints[0]
    path = f"/contact/{contact.name}/force"
    position, turn = tracks[path, "position"], tracks[path, "quaternion"]
    scale = tracks[f"{path}/arrow", "scale"]
    force = at(record, "constraint_force", position.times)[:, 0]
    assert len(position.times) == len(turn.times) == len(scale.times) == 33
    surface = contact.surface
    for point, quaternion in zip(position.values, turn.values, strict=True):
        if isinstance(surface, robots.Plane):
            assert np.dot(point - surface.point, surface.normal) == pytest.approx(0.0, abs=1e-4)
            normal = np.array(surface.normal)
        else:
            offset = point - surface.center
            assert np.linalg.norm(offset) == pytest.approx(surface.radius, abs=1e-4)
            normal = offset / np.linalg.norm(offset)
        # Between steps of up to 0.1 s the joints go along a straight line.
        np.testing.assert_allclose(rotation(quaternion)[:, 2], normal, atol=1e-3)
    for values in scale.values.T:
        np.testing.assert_allclose(values, force / np.max(force), rtol=1e-6)
    # The longest arrow is a fifth of the scene; it ends at the contact, not on the tool.
    things, places = objects(page), transforms(page)
    shaft = things[f"{path}/arrow/shaft"]["geometries"][0]
    head = things[f"{path}/arrow/head"]["geometries"][0]
    nominal = loop.plant.structure.manifold.project(loop.plant.dae.nominal_state)
    model = loop.plant.model
    corners = scene_points(model, ConstraintWrenches(model), nominal[None], loop.scene_graph)
    assert shaft["height"] + head["height"] == pytest.approx(0.2 * diagonal(corners), rel=1e-6)
    middle = places[f"{path}/arrow/shaft"][2, 3]
    assert middle + shaft["height"] / 2 == pytest.approx(-head["height"], rel=1e-6)
    tip = places[f"{path}/arrow/head"][2, 3]
    assert tip == pytest.approx(0.0, abs=1e-9)


def test_paths_of_the_contact_point(shown):
    loop, record, page = shown
    contact = loop.plant.model.constraints[0]
    lines = objects(page)
    times = np.arange(33) / 32
    axes = ["xyz".index(axis) for axis in loop.plant.model.outputs[0].axes]
    for name, signal in (("actual", "controlled_output"), ("desired", "desired_output")):
        path = middles(lines[f"/paths/{contact.name}/{name}"])
        assert path.shape == (33, 3)
        wanted = at(record, signal, times)[:, : len(axes)]
        # Where the joints, not the outputs, go along a straight line from step to step.
        np.testing.assert_allclose(path[:, axes], wanted, atol=1e-3)


def test_what_the_page_says(shown):
    """Its title, the clock's ends, and the force at each arrow: that of the record."""
    loop, record, page = shown
    said = overlay(page)
    assert f"<title>{loop.plant.dae.name}</title>" in page
    assert (said["title"], said["rate"]) == (loop.plant.dae.name, 32.0)
    assert (said["start"], said["end"]) == (0.0, 1.0)
    assert not [path for path in objects(page) if "cone" in path]
    (command,) = [c for c in commands(page) if c["type"] == "set_animation"]
    assert command["options"]["repetitions"] > 1e6
    assert command["options"]["loopMode"] == 2201  # LoopRepeat of three.js.
    (force,) = said["forces"]
    assert "/" + "/".join(force["path"]) + "/arrow/head" in objects(page)
    wanted = at(record, "constraint_force", np.arange(33) / 32)[:, 0]
    np.testing.assert_allclose(force["values"], wanted, rtol=1e-3)
    words = [text for _, text in said["legend"]]
    assert f"constraint force, the longest {wanted.max():.3g} N" in words
    (grid,) = [text for text in words if text.startswith("grid of ")]
    lines = vertices(objects(page)["/floor"]).reshape(-1, 2, 3)
    apart = np.diff(np.unique(np.round(lines[:, 0, 0], 6)))
    # The page holds single precision.
    np.testing.assert_allclose(apart, float(grid.split()[2]), atol=1e-5)
    (path,) = said["paths"]
    drawn = objects(page)["/" + "/".join(path)]["geometries"][0]["data"]
    # Six sides of two triangles for each of the 32 pieces, one after the other.
    triangles = np.asarray(drawn["index"]["array"]).reshape(-1, 3)
    assert said["indices"] * 32 == triangles.size
    np.testing.assert_array_equal(triangles.reshape(32, -1).max(axis=1), 6 * np.arange(2, 34) - 1)


def test_a_title_is_text(shown):
    loop, record, _ = shown
    title = '</script><b>wall & "dome"</b>'
    page = make_animation(loop, record, loop.diagram.CreateDefaultContext(), title)
    assert overlay(page)["title"] == title
    assert "<title>&lt;/script&gt;&lt;b&gt;wall &amp; &quot;dome&quot;&lt;/b&gt;</title>" in page
    assert title not in page


def test_the_desired_path_ends_where_it_leaves_the_reach():
    """The arm is 2 m long and the wall 1.2 m away: it reaches 1.6 m up. It is asked for more."""
    loop, record, _ = recorded("two_link_wall", "duration=1")
    desired = record.signals["desired_output"]
    values = desired.values.copy()
    values[:, 0] = 0.3 + 2.0 * record.time
    signals = {**record.signals, "desired_output": Recorded(values, desired.signals)}
    context = loop.diagram.CreateDefaultContext()
    lines = objects(make_animation(loop, replace(record, signals=signals), context))
    assert len(middles(lines["/paths/wall/actual"])) == 33
    path = middles(lines["/paths/wall/desired"])
    assert 1.5 < np.max(path[:, 2]) < 1.61
    assert len(path) < 33


def test_a_run_that_begins_later_is_shown_from_its_start():
    _, record, page = recorded("two_link_wall", "duration=0.5", "integrator.start_time=-2")
    tracks = animation(page)
    scale = tracks["/contact/wall/force/arrow", "scale"]
    np.testing.assert_array_equal(scale.times, np.arange(17) / 32)
    force = at(record, "constraint_force", scale.times)[:, 0]
    np.testing.assert_allclose(scale.values[:, 0], force / force.max(), rtol=1e-6)
    assert record.time[0] == -2.0


def test_a_parameter_moves_the_surface():
    """The wall stands where the context of the run has it, not where the scenario put it."""
    case = scenario("two_link_wall", "duration=0.25", "start.errors={}")
    loop, context = build_scenario(case)
    own = loop.plant.GetMyMutableContextFromRoot(context)
    state = loop.plant.state(own)
    loop.plant.set_parameter(own, "wall.position", [1.1, 0.0, 0.0])
    loop.plant.set_consistent_state(own, state)
    page = make_animation(loop, run(loop, context, case.duration, case.integrator), context)
    wall = objects(page)["/contact/wall/surface/form"]["geometries"][0]
    thickness = min(wall[key] for key in ("width", "height", "depth"))
    stands = (
        transforms(page)["/contact/wall/surface"] @ transforms(page)["/contact/wall/surface/form"]
    )
    assert stands[0, 3] == pytest.approx(1.1 + thickness / 2)
    arrow = animation(page)["/contact/wall/force", "position"]
    np.testing.assert_allclose(arrow.values[:, 0], 1.1, atol=1e-3)


@pytest.mark.slow
def test_a_plate_that_moves_is_animated_where_it_is():
    found = animation(recorded("seven_joint_moving_plate", "duration=0.5")[2])
    position = found["/contact/plate/surface", "position"]
    times = position.times
    height = 0.4 + 0.05 * np.sin(2 * times)
    np.testing.assert_allclose(position.values[:, 2], height, atol=1e-4)
    turns = found["/contact/plate/surface", "quaternion"].values
    for t, quaternion in zip(times, turns, strict=True):
        wanted = RollPitchYaw(0.12 * np.sin(1.7 * t), 0.1 * np.sin(1.3 * t + 0.5), 0.0)
        np.testing.assert_allclose(
            rotation(quaternion), wanted.ToRotationMatrix().matrix(), atol=1e-4
        )


def test_one_moment_is_an_animation_too(shown):
    """What is left of a run that failed in its first step."""
    loop, record, _ = shown
    start = Record(
        record.time[:1], {n: Recorded(r.values[:1], r.signals) for n, r in record.signals.items()}
    )
    page = make_animation(loop, start, loop.diagram.CreateDefaultContext())
    path = f"/contact/{loop.plant.model.constraints[0].name}/force"
    assert len(animation(page)[path, "position"].times) == 1


def test_frames():
    np.testing.assert_array_equal(frame_times(0.0), [0.0])
    np.testing.assert_array_equal(frame_times(1.0), np.arange(33) / 32)
    # The end is shown, if need be a little late.
    np.testing.assert_array_equal(frame_times(0.05), [0.0, 1 / 32, 2 / 32])


@pytest.mark.parametrize("constraints", [[], [Mirror(0, 1, -0.4)]])
def test_a_robot_that_is_held_at_no_point_is_animated_too(constraints):
    """A free one, and one whose constraint force is a moment between joints."""
    plant = parse("two_link_arm")
    outputs = [JointPositions(["joint1", "joint2"][len(constraints) :])]
    model = RobotModel.from_multibody(plant, constraints, outputs, [1.2, -1.6])
    controls = TrackingLaw(model.dae, poles(-4.0))
    loop = make_closed_loop(RobotPlant(model), controls, [ConstantReference([0.3, 0.4])])
    context = loop.diagram.CreateDefaultContext()
    own = loop.plant.GetMyMutableContextFromRoot(context)
    loop.plant.set_consistent_state(own, loop.plant.state(own))
    simulate(loop.diagram, context, 0.1, fixed_step())
    page = make_animation(loop, loop.record(context), context)
    assert not [path for path in objects(page) if path.startswith(("/contact", "/paths"))]


@pytest.mark.slow
def test_a_cone_has_the_plants_coefficient_and_holds_the_force_of_a_tool_that_slides():
    """The law of this scenario knows 0; the tool slides at 0.1 m/s, so that F leans by atan 0.3."""
    own = "plant=!CompliantContact {stiffness: 1.0e5, friction: 0.3}"
    page = recorded("wall_point_contact", "duration=1.2", own)[2]
    assert any("0.3" in text for _, text in overlay(page)["legend"] if "cone" in text)
    tracks = animation(page)
    axis, force = (
        rotation(tracks[f"/contact/wall/{what}", "quaternion"].values[-1])[:, 2]
        for what in ("cone", "force")
    )
    assert np.arccos(-axis @ force) == pytest.approx(np.arctan(0.3), rel=0.02)


LABELS = """
return JSON.stringify({
  clock: document.getElementById('run-clock').textContent,
  top: document.getElementById('run').getBoundingClientRect().bottom,
  bar: document.getElementById('run-bar').getBoundingClientRect().top,
  boxes: [...document.querySelectorAll('.run-force')].filter(one => one.style.display !== 'none')
    .map(one => one.getBoundingClientRect()).map(one => [one.left, one.top, one.right, one.bottom]),
});
"""


@needs_chromium
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "size"), some([("biped", "900,700"), ("three_fingers", "420,760")])
)
def test_labels_do_not_cover_each_other_and_the_title_no_scene(name, size, tmp_path):
    path = tmp_path / "page.html"
    path.write_text(recorded(name, "duration=1.0")[2], "utf-8")
    said = json.loads(in_browser(path, LABELS, "#t=0.5", size))
    assert said["clock"].startswith("t = 0.50 s")
    boxes = np.array(said["boxes"])
    assert len(boxes) >= 3
    for number, (left, top, right, bottom) in enumerate(boxes):
        for other in boxes[:number]:
            assert right <= other[0] or other[2] <= left or bottom <= other[1] or other[3] <= top
        # Between title and bar, which cover nothing of the scene.
        assert said["top"] <= top
        assert bottom <= said["bar"]
