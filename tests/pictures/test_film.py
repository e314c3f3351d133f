"""Films: what they show, against the record and Drake's own camera."""

import json
import shutil
import subprocess

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

from drake_dae import build_scenario, load_scenario, save_film, simulate
from drake_dae.cli import main
from drake_dae.errors import ModelError
from drake_dae.pictures.film import ACTUAL, FORCE, _Camera
from drake_dae.scenario.shipped import find_scenario


def recorded(name, *settings):
    scenario = load_scenario(find_scenario(name), settings)
    loop, context = build_scenario(scenario)
    simulate(loop.diagram, context, scenario.duration, scenario.integrator)
    return loop, loop.record(context), context


def near(image, color):
    """How many pixels have nearly this color: a GIF has few of them."""
    pixels = np.asarray(image.convert("RGB"), dtype=float) / 255
    return int((np.abs(pixels - to_rgb(color)).max(axis=2) < 0.1).sum())


def frames(path):
    with Image.open(path) as film:
        for number in range(film.n_frames):
            film.seek(number)
            yield film.copy()


@pytest.mark.slow
def test_path_grows_and_arrow_is_there(tmp_path):
    loop, record, context = recorded("two_link_wall", "duration=1.5", "start.errors={}")
    save_film(loop, record, context, tmp_path / "film.gif")
    shown = list(frames(tmp_path / "film.gif"))
    assert len(shown) == 16
    assert all(near(picture, FORCE) > 150 for picture in shown)
    lengths = [near(picture, ACTUAL) for picture in shown]
    assert lengths[0] == 0
    assert lengths[-1] > lengths[5] > 10
    save_film(loop, record, context, tmp_path / "strip.png")
    with Image.open(tmp_path / "strip.png") as strip, Image.open(tmp_path / "film.gif") as film:
        assert strip.size == (4 * film.width, film.height)


@pytest.mark.slow
def test_what_moves_is_seen_to_move(tmp_path):
    loop, record, context = recorded("seven_joint_moving_plate", "duration=0.8")
    save_film(loop, record, context, tmp_path / "strip.png")
    with Image.open(tmp_path / "strip.png") as strip:
        pixels = np.asarray(strip.convert("RGB"), dtype=int)
    first, *_, last = np.split(pixels, 4, axis=1)
    assert (np.abs(first - last).max(axis=2) > 40).sum() > 1000


def test_projection_is_that_of_drakes_camera():
    camera = _Camera(np.array([-1.4, -1.0, 0.75]), np.array([0.2, 0.1, 0.3]), 10.0)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3))
    seen = camera.info.intrinsic_matrix() @ camera.pose.inverse().multiply(points.T)
    np.testing.assert_allclose(camera.project(points), (seen[:2] / seen[2]).T, atol=1e-9)
    middle = camera.project(np.array([[0.2, 0.1, 0.3], [0.2, 0.1, 0.4]]))
    assert middle[0] == pytest.approx([camera.info.center_x(), camera.info.center_y()])
    assert middle[1, 1] < middle[0, 1]  # What is higher is seen higher: rows count down.


def test_runs_that_cannot_be_filmed_are_refused(tmp_path, capsys):
    with pytest.raises(ModelError, match=r"'x\.avi'"):
        save_film(*recorded("two_link_wall", "duration=0.01"), "x.avi")
    assert main(["plot", "--film", str(tmp_path)]) == 1
    assert str(tmp_path) in capsys.readouterr().err


@pytest.mark.slow
def test_command_films_a_run(tmp_path, capsys):
    folder = tmp_path / "run"
    assert main(["simulate", "two_link_wall", "--set", "duration=0.3", "--out", str(folder)]) == 0
    assert main(["plot", "--film", str(folder)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"written to {folder}/film.gif"
    assert len(list(frames(folder / "film.gif"))) == 4


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs ffmpeg")
def test_an_mp4_has_all_moments_and_is_seen_by_any_browser(tmp_path):
    loop, record, context = recorded("two_link_wall", "duration=0.4")
    save_film(loop, record, context, tmp_path / "film.mp4")
    asked = "stream=codec_name,width,height,pix_fmt,nb_frames,r_frame_rate"
    command = ["ffprobe", "-v", "error", "-show_entries", asked, "-of", "json"]
    done = subprocess.run([*command, tmp_path / "film.mp4"], capture_output=True, check=True)
    (stream,) = json.loads(done.stdout)["streams"]
    assert (stream["codec_name"], stream["pix_fmt"]) == ("h264", "yuv420p")
    assert (stream["nb_frames"], stream["r_frame_rate"]) == ("11", "25/1")
    assert (stream["width"], stream["height"]) == (960, 800)


def test_without_ffmpeg_an_mp4_is_refused_before_anything_is_drawn(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ModelError, match="ffmpeg"):
        save_film(*recorded("two_link_wall", "duration=0.01"), tmp_path / "film.mp4")
    assert not list(tmp_path.iterdir())
