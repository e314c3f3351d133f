"""What robots touch, as it is drawn: once, around the whole run, with all of the robot in sight."""

import re
import shutil
import subprocess
from functools import cache

import numpy as np
import pytest
from runs import some

from drake_dae.pictures.animation import animate
from drake_dae.pictures.plots import plot_paths
from drake_dae.pictures.run_motion import contact_paths, follow, run_points
from drake_dae.running.simulate import simulate
from drake_dae.scenario.build import build_scenario
from drake_dae.scene.surroundings import surroundings
from tests.support.runs import scenario


@cache
def course(name, *settings):
    """A short run of a shipped scenario, and its loop."""
    case = scenario(name, *settings)
    loop, context = build_scenario(case)
    simulate(loop.diagram, context, case.duration, case.integrator)
    return follow(loop, loop.record(context), context, 8.0), loop


def seen(run):
    return surroundings(run.model, run.acting, run.points, run.parameters[0], 0.5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "names"),
    some(
        [
            ("biped", ["front"]),  # Two feet on one floor.
            ("cart_wall", ["wall"]),  # What wheels roll on is not drawn.
            ("three_fingers", None),  # Each finger on its own side.
        ]
    ),
)
def test_each_surface_is_drawn_once(name, names):
    run, _ = course(name, "duration=0.5")
    found = seen(run)
    if names is not None:
        assert [one.constraint.name for one in found] == names
    places = [(one.pose @ one.picture.pose).GetAsMatrix4() for one in found]
    pairs = [(a, b) for i, a in enumerate(places) for b in places[:i]]
    assert not any(np.allclose(a, b, atol=1e-9) for a, b in pairs)


@pytest.mark.slow
def test_a_wall_is_as_long_as_the_way_along_it():
    """The cart goes 1.2 m in 4 s, more than the 0.5 m that are asked for."""
    run, _ = course("cart_wall", "duration=4.0")
    (one,) = seen(run)
    touched = run.points[:, 0]
    local = (one.pose @ one.picture.pose).inverse().multiply(touched.T)
    half = np.array([one.picture.form.width(), one.picture.form.depth()]) / 2
    assert np.ptp(touched[:, 0]) > 0.5
    assert np.all(np.abs(local[:2]) <= half[:, None])


@pytest.mark.slow
def test_the_head_of_the_biped_is_in_sight():
    """Its hip is at 0.7 m, and the trunk and the head stand 0.6 m above it."""
    run, loop = course("biped", "duration=0.5")
    assert run_points(run, loop.scene_graph)[:, 2].max() >= 1.3
    assert run_points(run, None)[:, 2].max() < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["seven_joint_wall", "cart_wall"])
def test_paths_are_seen_from_the_free_side(name):
    """Who looks against the normal n, with e up, has e x n to the right."""
    run, _ = course(name, "duration=0.5")
    path = contact_paths(run)[0]
    row = next(i for i, c in enumerate(run.acting.constraints) if c.name == path.name)
    constraint = run.acting.constraints[row]
    normal = np.array(constraint.surface.normal)
    up = np.array([0.0, 0.0, 1.0]) if abs(normal[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    right = np.cross(up, normal)
    across = (run.points[:, row] - run.points[0, row]) @ right
    axis = plot_paths([path]).axes[0]
    to_pixels = axis.transData.transform(path.actual)[:, 0]
    assert np.sign(to_pixels[-1] - to_pixels[0]) == np.sign(across[-1])


@pytest.mark.slow
@pytest.mark.thorough
@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs a browser")
@pytest.mark.parametrize("size", ["1200,800", "500,360"])
def test_the_title_of_a_page_is_above_the_scene_and_not_on_it(size, tmp_path):
    run, loop = course("two_link_wall", "duration=0.1")
    page = tmp_path / "page.html"
    page.write_text(animate(run, loop.scene_graph, 8 * "a long title ", []))
    words = "--headless --no-sandbox --disable-gpu --enable-unsafe-swiftshader --no-first-run"
    command = ["chromium", *words.split(), f"--window-size={size}", "--virtual-time-budget=3000"]
    command += [f"--user-data-dir={tmp_path}/user", "--dump-dom", page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    (style,) = re.findall(r'id="meshcat-pane"[^>]*style="([^"]*)"', done.stdout)
    (top,) = re.findall(r"top: (\d+)px", style)
    assert int(top) > 60  # Three lines or more.
