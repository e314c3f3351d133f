"""Links behind the surface that a robot touches, against the signs of its normals."""

import re

import numpy as np
import pytest
from runs import some

from drake_dae.cli import main
from drake_dae.robots.geometry.clearances import links_behind
from drake_dae.scenario.build import build_scenario
from drake_dae.scenario.feasibility.feasibility import find_feasibility
from tests.support.runs import scenario

TURNED = (
    "constraints=[{{name: wall, frame: tool, "
    "surface: !Plane {{point: [{0}, 0, 0], normal: [{1}, 0, 0]}}}}]"
)


def at_start(case):
    """What is behind at the start of a scenario, and q there."""
    loop, context = build_scenario(case)
    plant = loop.plant
    at_plant = plant.GetMyContextFromRoot(context)
    state, own = plant.state(at_plant), plant.current_parameters(at_plant)
    return links_behind(plant.model, np.array([0.5]), state[None], own[None]), state


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "place", "link"),
    [("two_link_wall", 1.2, "link2"), ("seven_joint_wall", 0.7, "link6")],
)
def test_the_free_side_decides(name, place, link):
    assert at_start(scenario(name, TURNED.format(place, -1.0)))[0] == ()
    ((one,), _) = at_start(scenario(name, TURNED.format(place, 1.0)))
    assert (one.constraint, one.link, one.since, one.time) == ("wall", link, 0.5, 0.5)


def test_the_depth_is_that_by_hand():
    """The second link of the arm begins at x = cos q_1, before a wall at 1.2 m."""
    ((one,), state) = at_start(scenario("two_link_wall", TURNED.format(1.2, 1.0)))
    assert one.depth == pytest.approx(1.2 - np.cos(state[0]), rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", some(["cart_wall", "biped", "three_fingers", "seven_joint_moving_plate"])
)
def test_robots_on_the_free_side_have_no_link_behind(name):
    assert at_start(scenario(name))[0] == ()


@pytest.mark.slow
def test_analysis_and_summary_tell_it(tmp_path, capsys):
    turned = TURNED.format(1.2, 1.0)
    found = find_feasibility(scenario("two_link_wall", turned, "duration=0.2"))
    (text,) = [text for text in found.problems if "behind" in text]
    assert re.search(r"^link2 is behind the surface of 'wall' .* by up to .* m: turn its", text)
    assert found.to_dict()["behind"][0]["depth"] == found.behind[0].depth
    settings = [turned, "duration=0.2", "write.plots=false", "write.animation=false"]
    options = [word for setting in settings for word in ("--set", setting)]
    main(["simulate", "two_link_wall", *options, "--out", str(tmp_path / "run")])
    told = " ".join(capsys.readouterr().out.split())
    assert "BAD: link2 is behind the surface of 'wall' from 0 s on" in told
