"""A loop as one HTML file: in Chromium, from file://."""

import json
import re
from importlib.util import find_spec

import numpy as np
import pytest
from browser import LOW_CONTRAST, in_page, needs_chromium
from runs import scenario

from drake_dae import build_scenario, write_page
from drake_dae.cli import main
from drake_dae.errors import MachineCodeError
from drake_dae.pictures import page as module
from drake_dae.scenario import build_commanded
from drake_dae.scenario.build import for_rollout, roll_scenario

needs_zig = pytest.mark.skipif(find_spec("ziglang") is None, reason="there is no ziglang")

TITLE = "</script><img src=x onerror=alert(1)> & 'wall'"


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The page of the two-link arm, whose title has markup."""
    if find_spec("ziglang") is None:
        pytest.skip("there is no ziglang")
    file = tmp_path_factory.mktemp("page") / "arm.html"
    built = build_commanded(scenario("two_link_wall"))
    given = built.loop, built.context, file, scenario("two_link_wall").integrator
    assert write_page(*given, TITLE, ["not <b>this</b>"]) == file
    return file


@needs_zig
@pytest.mark.slow
@needs_chromium
def test_drakes_contact_is_shown_in_steps_with_the_errors_of_a_rollout(tmp_path):
    """Compared at another moment of a step than its end, 0.3 m/s would look like 0.3 mm."""
    point = "{time_step: 0.001, contact_model: point, stiffness: 1.0e5, friction: 0}"
    chosen = scenario(
        *("two_link_wall", f"plant=!MultibodyPlant {point}", "law.gains=null", "duration=3"),
        *("sampling={period: 0.001, delay: 0.001}", "estimator.parameters=[]"),
    )
    built, file = build_commanded(chosen), tmp_path / "contact.html"
    assert "MultibodyPlant" in built.left_out[0]
    write_page(built.loop, built.context, file, chosen.integrator)
    script = "await run(3); return bench.samples.slice(-100).map(({ error }) => error);"
    found = np.array(in_page(file.read_text(), script, tmp_path / "script.html"))
    rolled = for_rollout(chosen)[0]
    record = roll_scenario(rolled, *build_scenario(rolled)).record
    wanted = (record["controlled_output"] - record["desired_output"])[record.time > 2.2]
    assert np.abs(wanted).max() > 0.0
    assert np.all(np.abs(found).max(axis=0) < 1.2 * np.abs(wanted).max(axis=0) + 1e-9)


@pytest.mark.slow
@needs_chromium
def test_sliders_drags_and_pushes_move_the_robot_as_predicted(page, tmp_path):
    found = in_page(
        page.read_text(),
        """
  const found = { start: now().error };
  await run(3);
  found.off = [bench.off];
  slide("wall.force", 12);
  await run(1.5);
  found.force = [now().z[1], now().r[1]];
  found.off.push(bench.off);
  // The wall, at its ball, which is dragged toward the robot.
  const where = () => now().scene.slice(-6, -3);
  found.before = [where(), now().scene.slice(-3)];
  const wall = bench.view.surfaces[0];
  const toward = bench.view.on_screen(wall.position.clone().add({ x: -0.1, y: 0, z: 0 }));
  point("pointerdown", place(wall));
  point("pointermove", toward);
  await run(3);
  point("pointerup", toward);
  found.after = [where(), now().scene.slice(-3)];
  found.off.push(bench.off);
  // The target, at its ball; the reference itself moves.
  const wanted = (t) => 0.3 + 0.3 * Math.sin(1.5 * t);
  const target = bench.view.targets[0];
  await run(1);
  const { time } = now();
  found.target = [now().r[0] - wanted(time)];
  point("pointerdown", place(target));
  const up = bench.view.on_screen(target.position.clone().add({ x: 0, y: 0, z: 0.1 }));
  point("pointermove", up);
  point("pointerup", up);
  await run(1.5);
  found.target.push(now().r[0] - wanted(now().time));
  found.off.push(bench.off);
  // The second link, at its middle, which is pulled upwards, against the law.
  const { name } = bench.data.bodies[1];
  const origin = () => now().scene.slice(12 + 9, 12 + 12);
  const half = bench.view.targets[0].position.clone();
  half.add({ x: origin()[0], y: origin()[1], z: origin()[2] }).multiplyScalar(0.5);
  const at = bench.view.on_screen(half);
  found.origin = origin();
  const canvas = viewer.renderer.domElement, cursors = [];
  for (const where of [at, [at[0], 60]]) {
    point("pointermove", where);
    cursors.push(canvas.style.cursor);
  }
  found.cursors = cursors;
  point("pointerdown", at);
  point("pointermove", besides(at, 0, -70));
  found.isPushed = Boolean(bench.push);
  await run(1 / 120);
  const { input } = bench.data.pushes[name];
  found.wrench = bench.panel.present.slice(input, input + 6);
  found.point = bench.view.push.position.toArray();
  found.half = half.toArray();
  bench.view.place_labels(now());
  found.label = bench.view.push_label.textContent;
  await run(0.4);
  found.pushed = bench.off;
  point("pointerup", at);
  await run(1);
  found.off.push(bench.off);
  found.failure = bench.failure;
  return found;
""",
        tmp_path / "x.html",
    )
    assert found["start"][0] == pytest.approx(0.05, abs=1e-9)
    # The issue asks for 1e-9; errors are m and N.
    assert max(found["off"]) <= 1e-9
    assert found["force"][0] == pytest.approx(found["force"][1], abs=1e-9)
    assert found["force"][0] > 30.0
    (wall, tool), (wall_after, tool_after) = found["before"], found["after"]
    assert wall_after[0] - wall[0] == pytest.approx(-0.1, abs=5e-3)  # A pixel is 3 mm.
    assert tool_after[0] - tool[0] == pytest.approx(wall_after[0] - wall[0], abs=1e-6)
    assert found["target"][1] - found["target"][0] == pytest.approx(0.1, abs=5e-3)
    assert found["isPushed"]
    # At the point that was taken, on the surface of the link whose radius is 3 cm.
    np.testing.assert_allclose(found["point"], found["half"], atol=0.06)
    force, moment = np.split(np.array(found["wrench"]), 2)
    lever = np.array(found["point"]) - found["origin"]
    np.testing.assert_allclose(moment, np.cross(lever, force), atol=1e-9)
    assert np.linalg.norm(lever) > 0.3
    assert force[2] > 1.0
    assert found["pushed"] > 1e-3
    assert found["label"] == f"{np.linalg.norm(force):.3g} N"
    assert found["cursors"] == ["grab", ""]
    assert not found["failure"]


@pytest.mark.slow
@needs_chromium
def test_names_stay_text_a_phone_shows_all_of_it_and_a_screen_reader_names_it(page, tmp_path):
    found = in_page(
        page.read_text(),
        """
  const box = (id) => document.getElementById(id).getBoundingClientRect();
  const controls = [...document.querySelectorAll("body > :not(.dg) :is(button, select, input)")];
  const isNamed = (one) => one.ariaLabel || (one.matches("button") && one.textContent.trim())
    || [...one.labels].some(({ control }) => control === one);
  return {
    language: document.documentElement.lang,
    controls: controls.length,
    hidden: controls.filter((one) => one.tabIndex < 0).map(({ outerHTML }) => outerHTML),
    nameless: controls.filter((one) => !isNamed(one)).map(({ outerHTML }) => outerHTML),
    value: document.querySelector("input[type=range]").ariaValueText,
    title: document.title, head: document.getElementById("bench-title").textContent,
    images: document.images.length, bold: document.querySelectorAll("#bench-panel b").length,
    wide: [document.documentElement.scrollWidth, innerWidth],
    boxes: ["meshcat-pane", "bench-plots", "bench-bar", "bench-panel"].map((id) => {
      const { left, right, top, bottom } = box(id);
      return [left, right, top, bottom];
    }),
    tall: innerHeight,
    loaded: performance.getEntriesByType("resource").map(({ name }) => name.slice(0, 5)),
  };
""",
        tmp_path / "x.html",
        390,
        844,
    )
    assert found["title"] == found["head"] == TITLE
    assert found["images"] == found["bold"] == 0
    assert found["language"] == "en"
    assert found["controls"] > 15
    assert found["hidden"] == found["nameless"] == []
    assert found["value"] == "0 N"
    assert set(found["loaded"]) <= {"data:", "blob:"}
    assert found["wide"][0] <= found["wide"][1]
    below = 0.0
    for left, right, top, bottom in found["boxes"]:
        assert 0.0 <= left < right <= found["wide"][1] + 1e-6
        assert below <= top < bottom <= found["tall"] + 1e-6
        below = bottom - 1e-6


@needs_chromium
@pytest.mark.slow
@pytest.mark.thorough
def test_its_words_stand_out(page, tmp_path):
    found = in_page(
        page.read_text(), f"return (() => {{ {LOW_CONTRAST} }})();", tmp_path / "x.html"
    )
    assert json.loads(found) == [True, {}]


def test_a_page_is_small_and_loads_nothing(page):
    text = page.read_text()
    assert len(text.encode()) <= 4e6
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1]
    assert "http" not in policy
    assert "default-src 'none'" in policy
    own = text[text.rindex("<style>") :]
    assert not re.search(r"""(src|href)\\s*=\\s*["']?(https?:)?//""", own)


@pytest.mark.slow
def test_hydroelastic_contact_is_refused_with_what_takes_its_place(tmp_path, capsys):
    assert main(["page", "wall_hydroelastic", f"--out={tmp_path / 'no.html'}"]) == 1
    assert "!CompliantContact" in capsys.readouterr().err
    assert not (tmp_path / "no.html").exists()


def test_without_a_compiler_it_says_how_to_get_one(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "find_spec", lambda name: None)
    built = build_commanded(scenario("two_link_wall"))
    with pytest.raises(MachineCodeError, match="pip install ziglang"):
        write_page(built.loop, built.context, tmp_path / "no.html")
