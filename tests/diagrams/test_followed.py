"""A tool follows a wall and an edge that are not where the law has them, and finds their line."""

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydrake.math import RollPitchYaw
from runs import scenario
from scipy.optimize import brentq

from drake_dae import (
    Plate,
    build_scenario,
    followed_lines,
    grid_variations,
    load_scenario,
    rollout,
    start_values,
    sweep,
)

# 20 mm before the wall, at rest.
WALL = """
robot: {file: "package://drake_dae_models/two_link_arm.urdf"}
constraints:
- name: wall
  frame: tool
  surface: !Plane {point: [1.2, 0, 0.3], normal: [-1, 0, 0]}
  rpy: [0, 0, 0]
outputs: [!PointCoordinates {frame: tool, axes: z}]
plant: !Unilateral {}
plant_parameters: {wall.position: [1.203, 0, 0.3], wall.rpy: [0, 0.05, 0]}
gains: !Poles {all: [-25]}
sampling: {period: 0.001}
task:
  gains: !Poles {all: [-8]}
  phases:
  - !Approach {speed: 0.05, over: 0.1}
  - !Press {force: 20, over: 0.1, tolerance: 2}
  - !Follow {along: tool.z, length: 0.1, speed: 0.1, over: 0.1}
  - !Release {over: 0.2}
start: {positions: {joint1: 1.1653, joint2: -1.8326}}
duration: 3
integrator: {integration_scheme: runge_kutta3, max_step_size: 0.001, use_error_control: false}
"""


def lines_of(chosen):
    """The followed lines of a rollout, its record and its changes of phases."""
    loop, context = build_scenario(chosen)
    times = np.arange(0.0, chosen.duration + 5e-4, 1e-3)
    (run,) = rollout(loop, *start_values(loop, context), times)
    assert run.failure is None, run.failure
    changes = loop.changes(run.context)
    return followed_lines(loop, run.record, run.context), run.record, changes


@pytest.mark.slow
def test_a_point_follows_a_wall_that_is_tilted(tmp_path):
    """An ideal plant keeps the point on its wall to 1e-9 m; the wall is tilted by 0.05 rad."""
    (tmp_path / "wall.yaml").write_text(WALL)
    (line,), record, changes = lines_of(load_scenario(tmp_path / "wall.yaml"))
    assert [change.phase for change in changes][:4] == ["Approach", "Press", "Follow", "Release"]
    assert changes[3].reason == "after a length of 0.1 m"
    assert (line.phase, line.contacts) == ("Follow", ("wall",))
    turned = RollPitchYaw(0.0, 0.05, 0.0).ToRotationMatrix()
    normal, along = (
        turned @ np.array([[-1.0, 0.0], [0.0, 0.0], [0.0, 1.0]]).T[0],
        turned @ [0, 0, 1],
    )
    assert_allclose(line.direction, along, atol=1e-8)
    assert abs(normal @ (line.point - [1.203, 0.0, 0.3])) < 1e-8
    assert line.rms <= line.largest < 1e-8
    # It goes as far as it should, from rest to rest, and the force stays.
    rows = np.searchsorted(record.time, [changes[2].time, changes[3].time])
    moved = np.diff(record["controlled_output"][rows, 0])
    assert_allclose(moved, 0.1, atol=1e-3)  # It begins before the press has settled.
    assert "is the line through [1.2" in str(line)


@pytest.mark.slow
@pytest.mark.parametrize("is_rolled", [True, pytest.param(False, marks=pytest.mark.thorough)])
def test_a_sweep_follows_each_length_as_a_run_does(is_rolled, tmp_path):
    """In the lanes of one rollout, and by Drake; to what its steps at changes of phase leave."""
    (tmp_path / "wall.yaml").write_text(WALL)
    lengths = {"task.phases.2.length": [0.05, 0.02]}
    chosen = load_scenario(tmp_path / "wall.yaml", ["duration=1.8"])
    file = tmp_path / "runs.db"
    study = sweep(chosen, grid_variations(lengths), file, workers=1, rollout=is_rolled)
    assert study.table()["outcome"] == ["finished", "finished"]
    settings = ["duration=1.8", "task.phases.2.length=0.02"]
    (line,), record, changes = lines_of(load_scenario(tmp_path / "wall.yaml", settings))
    assert line.largest < 1e-8
    assert "after a length of 0.02 m" in [change.reason for change in changes]
    errors = record["tracking_error"][:, 0]
    for name, wanted in (("largest", np.abs(errors).max()), ("final", errors[-1])):
        found = study.values(f"{name} error of tool.z [m]")
        assert_allclose(found[1], wanted, rtol=0.0, atol=1e-9)
    assert found[0] != found[1]


@pytest.mark.slow
@pytest.mark.thorough
@pytest.mark.parametrize(
    "plant",
    ["!CompliantContact {radius: 0.001, friction: 0.2}", "!Unilateral {}"],
)
def test_a_tip_of_two_points_finds_an_edge(plant):
    """The direction, and the place within the angle of 0.0175 rad times 4 mm and the give."""
    (line,), record, changes = lines_of(scenario("edge_follow", f"plant={plant}"))
    names = ["Move", "Approach", "Press", "Follow", "Release", "Retreat", "done"]
    assert [change.phase for change in changes] == names
    turned = RollPitchYaw(0.035, 0.0175, -0.0175).ToRotationMatrix()
    place = np.array([0.703, -0.004, 0.603]) + turned @ [0.0, 0.05, 0.0]
    edge = turned @ [0.0, 0.0, 1.0]
    assert np.linalg.norm(np.cross(line.direction, edge)) < 2e-4
    # Each plane is off by 0.0175 * 4 mm at most, and gives way by 7 N / 1e5 N/m.
    assert np.linalg.norm(np.cross(line.point - place, edge)) < 2**0.5 * (0.0175 * 4e-3 + 7e-5)
    # At a constant speed; the integral has settled to exp(-4) of 1.6 N.
    late = (record.time > changes[3].time + 1.2) & (record.time < changes[4].time - 0.4)
    assert_allclose(record["constraint_force"][late], [[7.0, 3.0]] * late.sum(), atol=0.05)


@pytest.mark.slow
@pytest.mark.thorough
def test_an_edge_that_ends_ends_the_phase():
    """The side ends 25 mm above the start of the phase; a guard leads to `leave`."""
    settings = (
        "plant=!CompliantContact {radius: 0.001, friction: 0.2}",
        "constraints.1.surface.half_widths=[0.01, 0.02]",
        "task.phases.0.references={tool.z: 0.6, wall.distance: 0.01}",
    )
    _, _, changes = lines_of(scenario("edge_follow", *settings))
    assert [change.phase for change in changes][3:5] == ["Follow", "leave"]
    assert "Follow is ended by an eccentricity of 1" in changes[4].reason


def test_a_ball_on_an_edge_is_at_the_top_of_a_hill():
    """The docstring of `Follow`: V(a) is largest where tan a = F_2 / F_1, so the ball rolls off.

    The center is found along rays from the edge, by the clearance of the plate from a box.
    """
    plate, radius, pressing = Plate((0, 0, 0), (0, 0, 1), half_widths=(0.1, 0.1)), 0.004, (7.0, 3.0)
    offset = ca.SX.sym("offset", 3)
    clearance = ca.Function("clearance", [offset], [plate.clearance(offset)])
    edge, angles = np.array([0.1, 0.0, 0.0]), np.linspace(0.0, np.pi / 2, 901)

    def potential(angle):
        ray = np.array([np.sin(angle), 0.0, np.cos(angle)])
        far = brentq(lambda s: float(clearance(edge + s * ray)) - radius, 0.0, 0.1, xtol=1e-15)
        return pressing[0] * far * ray[2] + pressing[1] * far * ray[0]

    values = np.array([potential(angle) for angle in angles])
    # The samples are 0.1 degrees apart.
    assert_allclose(np.tan(angles[np.argmax(values)]), pressing[1] / pressing[0], atol=2e-3)
    assert np.all(np.diff(values, 2) < 0.0)
    assert max(values[0], values[-1]) < values.max()
