"""Tasks that a person leads, and walls of compliant contact that a person moves."""

import numpy as np
import pytest
from browser import in_page, needs_chromium, opened, with_script
from numpy.testing import assert_allclose
from runs import scenario
from test_live import serving
from test_page import needs_zig

from drake_dae import Approach, Move, Wait, build_commanded, write_page
from drake_dae.running.bench.description import bench_of
from drake_dae.running.bench.run import HandRun
from drake_dae.systems.task.phases import Moment
from drake_dae.systems.task.phases.by_hand import ended_by_hand


@pytest.fixture(scope="module")
def guarded():
    settings = "task.phases.0.retries=9", "task.phases.0.distance=0.04", "task.phases.0.speed=0.06"
    built = build_commanded(scenario("wall_guarded", *settings))
    return built, bench_of(built.loop, built.context, "guarded")


def placed(run):
    return run.loop.changes(run.context)[-1].place


def advance_until(run, is_over, ticks):
    for _ in range(ticks):
        if is_over():
            return
        run.advance()
    raise AssertionError(f"not over after {ticks} ticks: phase {placed(run)}")


def test_a_phase_ends_when_it_would_or_by_hand():
    phase = ended_by_hand(Move({"tool.z": 0.4}, duration=2.0, name="slide"), 3)
    assert (phase.name, phase.signal, phase.duration) == ("slide", "by_hand_3", 2.0)
    quiet = Moment(time=0.5, force=0.0, distance=0.0, rate=0.0, wanted=0.0)
    assert phase.margin(quiet, 0.5) > 0.0
    assert phase.margin(Moment(0.5, 0.0, 0.0, 0.0, 0.0, signal=1.0), 0.5) < 0.0
    assert phase.margin(Moment(2.1, 0.0, 0.0, 0.0, 0.0), 0.5) < 0.0


@pytest.mark.slow
@pytest.mark.thorough
def test_phases_are_ended_by_hand_and_a_lost_wall_is_sought_again(guarded):
    built, bench = guarded
    phases = bench.data["phases"]
    # It feels, presses, waits, slides, releases, retreats: what makes or breaks contact ends alone.
    names = [phase.name for phase in built.scenario.task.phases]
    by_itself = [name for name, ends in zip(names, phases, strict=False) if ends is None]
    assert by_itself == ["feel", "Release", "Retreat"]
    run = HandRun(built.loop, built.context, scenario("wall_guarded").integrator)
    advance_until(run, lambda: placed(run) == names.index("Wait"), 240)
    run.set({phases[placed(run)]: 1.0})
    run.advance()
    assert placed(run) == names.index("slide")
    # The wall goes away by 15 cm, which no law knows; lost, the arm feels for it.
    (wall,) = (each for each in bench.controls.sliders if each.label == "wall.position[0]")
    assert (wall.kind, wall.value) == ("surface", 1.208)
    run.set({wall.inputs[0]: 1.358, phases[names.index("Wait")]: 0.0})
    advance_until(run, lambda: placed(run) == names.index("feel"), 60)
    assert run.loop.plant.GetOutputPort("constraint_force").Eval(
        run.loop.plant.GetMyContextFromRoot(run.context)
    ) == pytest.approx(0.0, abs=1e-9)
    # It comes back, to 10 cm behind its place, and is found there.
    run.set({wall.inputs[0]: 1.308})
    advance_until(run, lambda: placed(run) == names.index("Press"), 480)
    # The distance from where the wall is now, by 15 N at 100 kN/m.
    assert run.record()["distance"][-1, 0] == pytest.approx(0.0, abs=1e-3)


BUTTONS = """
  const press = (name) => document.getElementById(`bench-${name}`).click();
  const found = { hidden: document.getElementById("bench-next").hidden };
  const until = async (place, most) => {
    for (let k = 0; k < most && now().place !== place; k++) await run(1 / 60);
    return now().place;
  };
  press("next");
  found.said = (await run(1 / 60), document.getElementById("bench-state").textContent);
  found.waits = await until(2, 150);
  press("next");
  found.slides = await until(3, 3);
  await run(0.1);
  found.given = bench.panel.present[bench.data.phases[2]];
  press("lose");
  found.lost = await until(0, 60);
  const [wall] = bench.data.controls.find(({ label }) => label === "wall.position[0]").inputs;
  const gone = bench.panel.present[wall];
  await run(0.2);
  found.wall = [gone, gone - bench.panel.present[wall]];
  return found;
"""


@needs_chromium
@pytest.mark.slow
@pytest.mark.parametrize(
    "is_live",
    [True, pytest.param(False, marks=[needs_zig, pytest.mark.thorough])],
)
def test_buttons_end_phases_and_lose_the_contact(is_live, guarded, tmp_path):
    """Of a live bench, and of a page, where the supervisor runs as WebAssembly."""
    built = guarded[0]
    if is_live:
        with serving(built, "wall_guarded") as server:
            server.page = with_script(server.page, BUTTONS)
            found = opened(server.address, tmp_path / "profile")
    else:
        (file,) = write_page(built.loop, built.context, tmp_path / "page.html")
        found = in_page(file.read_text(), BUTTONS, file)
    assert found["hidden"] is False
    assert found["said"] == "this phase makes or breaks the contact, and ends by itself"
    assert (found["waits"], found["slides"], found["lost"]) == (2, 3, 0)
    assert found["given"] == 0
    # The wall comes back at 5 cm/s.
    assert found["wall"] == [pytest.approx(1.358, abs=2e-3), pytest.approx(0.01, abs=1e-6)]


FOLLOWS = """
  const found = [];
  for (let turn = 0; turn < 3; turn++) {
    await run(1);
    found.push([now().time, now().phase, ...now().error]);
  }
  return found;
"""


@needs_chromium
@needs_zig
@pytest.mark.slow
@pytest.mark.thorough
def test_a_page_follows_an_edge_as_a_rollout_does(tmp_path):
    """On springs, since Drake's own contact is not exported; with the steps of the page."""
    chosen = scenario("edge_follow", "plant=!CompliantContact {radius: 0.001, friction: 0.2}")
    built = build_commanded(chosen)
    (file,) = write_page(built.loop, built.context, tmp_path / "page.html", chosen.integrator)
    found = in_page(file.read_text(), FOLLOWS, file)
    run = HandRun(built.loop, built.context, chosen.integrator)
    names, reached = [phase.name for phase in chosen.task.make().phases], []
    for time, phase, *errors in found:
        while run.record().time[-1] < time - 1e-9:
            run.advance()
        reached.append(phase)
        assert phase == names[placed(run)]
        # A page shows the outputs that the phase controls; the others follow them.
        wanted = run.record()["tracking_error"][-1, : len(errors)]
        assert_allclose(errors, wanted, rtol=0.0, atol=1e-9)
    assert reached[-1] == "Follow"


def test_links_are_pushed_in_compliant_contact():
    name, setting = "two_link_wall", "plant=!CompliantContact {stiffness: 1.0e5}"
    built = build_commanded(scenario(name, setting))
    assert built.left_out == ()
    bench = bench_of(built.loop, built.context, name)
    assert bench.data["opens"]
    place = bench.data["pushes"]["two_link_arm::link2"]["input"]
    heights = []
    for force in (0.0, 30.0):
        run = HandRun(built.loop, built.context, scenario(name).integrator)
        run.set({place + 2: force})
        for _ in range(12):
            run.advance()
        heights.append(run.record()["controlled_output"][-1, 0])
    assert heights[1] - heights[0] > 1e-3


def test_a_wait_has_its_own_signal():
    assert Wait("ready").signal == "ready"
    assert Approach(0.05).signal == ""
    assert np.isfinite(ended_by_hand(Wait(duration=1.0), 0).margin(Moment(0, 0, 0, 0, 0), 0.5))
