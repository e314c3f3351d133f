"""Films: what they show, against the record and Drake's own camera."""

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image
from runs import run_scenario, scenario, some

from drake_dae.cli import main
from drake_dae.errors import ModelError
from drake_dae.pictures import save_film
from drake_dae.pictures.film import FilmScene
from drake_dae.pictures.motion import follow, run_points
from drake_dae.scene.surroundings import scene_points


def recorded(name, *settings):
    loop, context, record = run_scenario(scenario(name, *settings))
    return loop, record, context


def near(image, color):
    """How many pixels have nearly this color: a GIF has few of them."""
    pixels = np.asarray(image.convert("RGB"), dtype=float) / 255
    return int((np.abs(pixels - to_rgb(color)).max(axis=2) < 0.1).sum())


@pytest.mark.slow
def test_path_grows_and_arrow_is_there(tmp_path):
    loop, record, context = recorded("two_link_wall", "duration=1.5", "start.errors={}")
    save_film(loop, record, context, tmp_path / "film.gif")
    with Image.open(tmp_path / "film.gif") as film:
        pictures = [(film.seek(number), film.copy())[1] for number in range(film.n_frames)]
    assert len(pictures) == 16
    assert all(near(picture, "#d12b1f") > 150 for picture in pictures)
    lengths = [near(picture, "#1f3fbf") for picture in pictures]
    assert lengths[0] == 0
    assert lengths[-1] > lengths[5] > 10


@pytest.mark.slow
def test_what_moves_is_seen_to_move_in_a_strip(tmp_path):
    save_film(*recorded("seven_joint_moving_plate", "duration=0.8"), tmp_path / "strip.png")
    with Image.open(tmp_path / "strip.png") as strip:
        pixels = np.asarray(strip.convert("RGB"), dtype=int)
    first, *_, last = np.split(pixels, 4, axis=1)
    assert (np.abs(first - last).max(axis=2) > 40).sum() > 1000


@pytest.mark.slow
@pytest.mark.parametrize("name", some(["cart_wall", "three_fingers", "planar_3rrr"]))
def test_a_film_shows_the_whole_robot_at_all_times_below_its_clock(name):
    """Of all recorded states, also those that the camera was not placed by."""
    loop, record, context = recorded(name, "duration=3.0")
    motion = follow(loop, record, context, 10.0)
    scene = FilmScene(motion, loop.scene_graph)
    for number in range(len(motion.times)):
        state = motion.states[number][None]
        now = scene_points(motion.model, motion.acting, state, loop.scene_graph)
        pixels = scene.project(np.vstack([now, motion.points[number]]))
        assert np.all(pixels > [0.0, 56.0])
        assert np.all(pixels < [480.0, 400.0])
    # They fill the picture in one direction, up to the margins.
    used = np.ptp(scene.project(run_points(motion, loop.scene_graph)), axis=0) / [480.0, 344.0]
    assert used.max() > 0.6


def test_runs_that_cannot_be_filmed_are_refused(tmp_path, capsys):
    with pytest.raises(ModelError, match=r"'x\.mp4'"):
        save_film(*recorded("two_link_wall", "duration=0.01"), "x.mp4")
    assert main(["plot", "--film", str(tmp_path)]) == 1
    assert str(tmp_path) in capsys.readouterr().err
