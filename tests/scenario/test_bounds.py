"""The bounds of a scenario's parameters."""

import pytest
from runs import scenario

from drake_dae import build_scenario
from drake_dae.errors import ScenarioError

TILTED = (
    "constraints=[{name: wall, frame: tool, surface: !ImplicitSurface "
    "{function: 'a * (1.2 - x) + (1 - a) * y', parameters: {a: 1.0}}}]"
)


def test_bounds_of_parameters_are_those_at_which_the_structure_is_looked_at():
    """At a = 0 the wall is y = 0, along which the whole arm moves: A(x) is zero."""
    loop, _ = build_scenario(scenario("two_link_wall", TILTED, "bounds={wall.a: [0.5, 2]}"))
    for system in (loop.plant.dae, loop.controller.law.system):
        assert {p.name: p.bounds for p in system.parameters if p.bounds} == {"wall.a": (0.5, 2.0)}
    with pytest.raises(ScenarioError, match=r"A\(x\).*'wall\.a'"):
        build_scenario(scenario("two_link_wall", TILTED, "bounds={wall.a: [0, 2]}"))


@pytest.mark.parametrize(
    ("bounds", "words"),
    [
        ("{link2.mass: [12, 6]}", r"bounds: .*'link2\.mass'"),
        ("{link2.mass: [8, 9]}", r"bounds: .*'link2\.mass'"),
        ("{link2.mas: [6, 9]}", r"bounds: .*'link2\.mas'"),
        ("{link2.mass: [6]}", r"bounds\.link2\.mass: .*\[6\]"),
    ],
)
def test_bounds_that_make_no_sense_are_refused(bounds, words):
    with pytest.raises(ScenarioError, match=words):
        build_scenario(scenario("two_link_wall", f"bounds={bounds}"))
