"""Where cameras, labels and floors are: nothing is cut off, and no label covers a tool."""

import numpy as np
import pytest
from matplotlib.figure import Figure
from runs import scenario, some

from drake_dae.pictures.film import _HEIGHT, _TOP, _WIDTH, _Scene
from drake_dae.pictures.labels import label_box, overlap, reserved_pixels
from drake_dae.pictures.run_motion import follow, run_points
from drake_dae.running.simulate import simulate
from drake_dae.scenario.build import build_scenario
from drake_dae.scene.floor import floor_below
from drake_dae.scene.framing import ViewAngles, direction_of, framed
from drake_dae.scene.surroundings import scene_points, surroundings

WITHIN = (0.0, 0.0, 480.0, 400.0)


def course(name, *settings):
    case = scenario(name, *settings)
    loop, context = build_scenario(case)
    simulate(loop.diagram, context, case.duration, case.integrator)
    return follow(loop, loop.record(context), context, 10.0), loop.scene_graph


def seen_from(eye, at, points):
    """Right and up, each relative to the depth: tangents of angles around the camera's axis."""
    forward = (at - eye) / np.linalg.norm(at - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    depth = (points - eye) @ forward
    up = np.cross(right, forward)
    return (points - eye) @ right / depth, (points - eye) @ up / depth, depth


@pytest.mark.parametrize("seed", range(20))
def test_a_camera_shows_all_points_and_stands_no_farther_than_it_must(seed):
    random = np.random.default_rng(seed)
    points = random.normal(size=(30, 3)) * random.uniform(0.1, 3.0, 3)
    direction = random.normal(size=3) * [1.0, 1.0, 0.5]
    direction /= np.linalg.norm(direction)
    view = ViewAngles(*random.uniform(0.2, 1.0, 3))
    eye, at = framed(points, direction, view)
    x, y, depth = seen_from(eye, at, points)
    # Round-off of a few steps.
    assert depth.min() > 0.0
    assert np.abs(x).max() <= view.side * (1 + 1e-9)
    assert y.max() <= view.up * (1 + 1e-9)
    assert -y.min() <= view.down * (1 + 1e-9)
    # In one direction the points reach both ends, in the other they stand in the middle.
    across = [x.max() / view.side, -x.min() / view.side]
    upward = [y.max() / view.up, -y.min() / view.down]
    assert max(min(across), min(upward)) == pytest.approx(1.0, abs=1e-9)


def test_the_camera_goes_where_nothing_hides_the_contact():
    contact, none = np.array([[0.5, 0.0, 0.0]]), np.zeros((1, 3))
    corners = np.array([[-0.5, -0.5, 0.0], [0.6, 0.5, 1.0]])
    usual = direction_of(corners, contact, none)
    # A link stands in the way.
    link = contact + usual * np.linspace(0.2, 0.6, 20)[:, None]
    turned = direction_of(np.vstack([corners, link]), contact, none)
    assert turned @ usual < 0.95
    assert turned[2] == pytest.approx(usual[2])
    # A wall is looked at from its free side; at a right angle, which is a turn, round-off decides.
    c, s = np.cos(0.2), np.sin(0.2)
    free = -np.array([[c * usual[0] - s * usual[1], s * usual[0] + c * usual[1], 0.0]])
    assert usual @ free[0] < 0.0
    assert direction_of(corners, contact, free) @ free[0] > 0.0
    # What is flat is looked at more from above.
    assert direction_of(corners * [1.0, 1.0, 0.1], contact * 0, none)[2] > usual[2] + 0.2


@pytest.mark.slow
@pytest.mark.parametrize("name", some(["cart_wall", "three_fingers", "planar_3rrr"]))
def test_a_film_shows_the_whole_robot_at_all_times_below_its_clock(name):
    """Of all recorded states, also those that the camera was not placed by."""
    run, scene_graph = course(name, "duration=3.0")
    scene = _Scene(run, scene_graph)
    for number in range(len(run.times)):
        now = scene_points(run.model, run.acting, run.states[number][None], scene_graph)
        pixels = scene._camera.project(np.vstack([now, run.points[number]]))
        assert np.all(pixels > [0.0, _TOP * _HEIGHT])
        assert np.all(pixels < [_WIDTH, _HEIGHT])
    # They fill the picture in one direction, up to the margins.
    all_of_it = scene._camera.project(run_points(run, scene_graph))
    used = np.ptp(all_of_it, axis=0) / [_WIDTH, _HEIGHT * (1 - _TOP)]
    assert used.max() > 0.6


def test_labels_do_not_cover_tools_arrows_or_each_other():
    """Up to six arrows at random, of which some end at one place, as on a foot."""
    random = np.random.default_rng(0)
    for _ in range(200):
        heads = random.uniform(60.0, 340.0, (random.integers(1, 7), 2))
        heads[1:] = np.where(random.random((len(heads) - 1, 1)) < 0.4, heads[0], heads[1:])
        tails = heads + random.uniform(-60.0, 60.0, heads.shape)
        arrows = [np.array(pair) for pair in zip(heads, tails, strict=True)]
        kept, boxes = reserved_pixels(arrows), []
        for head, tail in arrows:
            size = np.array([random.uniform(40.0, 120.0), 16.0])
            boxes.append(label_box(size, head, tail, boxes, kept, WITHIN))
        for number, box in enumerate(boxes):
            assert not any(overlap(box, other) for other in boxes[:number])
            assert np.all(box[:2] >= 0.0)
            assert np.all(box[:2] + box[2:] <= WITHIN[2:])
            low, high = box[:2], box[:2] + box[2:]
            assert not np.any(np.all((kept > low) & (kept < high), axis=1))


@pytest.mark.slow
@pytest.mark.parametrize("name", some(["biped", "three_fingers"]))
def test_labels_of_a_film_are_apart_as_matplotlib_draws_them(name):
    """The widths by which labels are placed are guesses; here they are measured."""
    run, scene_graph = course(name, "duration=1.0")
    scene = _Scene(run, scene_graph)
    for number in (0, 5, 10):
        figure = Figure(figsize=(_WIDTH / 100, _HEIGHT / 100), dpi=100)
        axis = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        scene.draw(axis, number)
        figure.draw_without_rendering()
        texts = [text for text in axis.texts if text.get_text().endswith(" N")]
        boxes = [text.get_window_extent().extents for text in texts]
        assert len(boxes) == np.count_nonzero(np.linalg.norm(run.wrenches[number].forces, axis=1))
        for i, (left, low, right, high) in enumerate(boxes):
            for other in boxes[:i]:
                assert right < other[0] or other[2] < left or high < other[1] or other[3] < low


def test_a_floor_has_round_cells_and_is_below_all():
    random = np.random.default_rng(1)
    for _ in range(50):
        points = random.normal(size=(10, 3)) * 10.0 ** random.uniform(-3.0, 3.0)
        floor = floor_below(points)
        assert f"{floor.cell:.0e}"[0] in "125"
        assert floor.cell == pytest.approx(float(f"{floor.cell:.0e}"), rel=1e-12)
        assert floor.height < points[:, 2].min()
        assert np.all(floor.low <= points[:, :2].min(axis=0))
        assert np.all(floor.high >= points[:, :2].max(axis=0))
        begin, end = floor.lines
        lengths = np.abs(end - begin)
        assert np.all(np.count_nonzero(lengths, axis=1) == 1)  # Each along x or along y.
        assert 10 < len(begin) < 80


@pytest.mark.slow
def test_the_floor_of_who_stands_is_the_ground():
    run, scene_graph = course("biped", "duration=0.2")
    touched = surroundings(run.model, run.acting, run.points, run.parameters[0], 1.0)
    floor = floor_below(run_points(run, scene_graph), touched)
    assert 0.0 < floor.height < 0.02  # Its feet stand on the plane z = 0.
