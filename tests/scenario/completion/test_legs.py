"""Outputs of robots on legs: dependent force outputs, and too few of them."""

import pytest
from vendors import joint, link, robot

from drake_dae import build_scenario, load_scenario
from drake_dae.errors import ScenarioError
from drake_dae.scenario import complete_scenario

LEGS = """
robot: {{file: {folder}/legs.urdf, free: [trunk], actuators: all}}
constraints:
{feet}
law:
  gains: {{all: [-4.0]}}
{rest}
"""


def refusal(scenario):
    with pytest.raises(ScenarioError) as caught:
        complete_scenario(scenario)
    return str(caught.value)


def legs(folder, rest, point=True):
    """Four legs of three joints on a trunk of which nothing holds, with feet that stand."""
    parts, joints, feet = [link("trunk", 4.0)], [], []
    for name, x, y in (("a", 0.2, 0.1), ("b", 0.2, -0.1), ("c", -0.2, 0.1), ("d", -0.2, -0.1)):
        parts += [link(f"{name}{k}", 0.5) for k in (1, 2, 3)]
        joints += [
            joint(f"{name}_roll", "trunk", f"{name}1", "1 0 0", (x, y, 0.0)),
            joint(f"{name}_hip", f"{name}1", f"{name}2", "0 1 0", (0.0, 0.0, -0.05)),
            joint(f"{name}_knee", f"{name}2", f"{name}3", "0 1 0", (0.0, 0.0, -0.3)),
        ]
        place = f"frame_b: {name}3, point_b: [0, 0, -0.3]"
        stands = f"!CoincidentPoints {{frame_a: world, point_a: [{x}, {y}, -0.6], {place}, "
        plane = "surface: !Plane {point: [0, 0, -0.6], normal: [0, 0, 1]}"
        slides = f"{{frame: {name}3, point: [0, 0, -0.3], {plane}, "
        feet.append(f"- {stands if point else slides}name: {name}}}")
    (folder / "legs.urdf").write_text(robot("legs", *parts, *joints))
    text = LEGS.format(folder=folder, feet="\n".join(feet), rest=rest)
    (folder / "legs.yaml").write_text(text)
    return load_scenario(folder / "legs.yaml")


PAIRS = ("ab", "ac", "ad", "bc", "bd", "cd")
BENT = ", ".join(f"{leg}_hip: 0.6, {leg}_knee: -1.2" for leg in "abcd")
START = f"start: {{positions: {{{BENT}}}}}"


def squeezes(pairs):
    return "forces:\n" + "\n".join(
        f"- !Squeeze {{frame: world, first: {one}, second: {two}, name: {one}{two}}}"
        for one, two in pairs
    )


@pytest.mark.slow
def test_of_six_squeezes_of_feet_in_one_plane_five_are_independent(tmp_path):
    """Six bars between four points of a plane bear one state of stress without any load."""
    held = ", ".join(f"{pair}: 1.0" for pair in PAIRS)
    rest = f"{squeezes(PAIRS)}\nreferences: {{{held}}}\n{START}"
    message = refusal(legs(tmp_path, rest))
    assert message.startswith("forces: ab, ac, ad, bc, bd, cd")
    assert "cd" in message


@pytest.mark.slow
def test_a_free_base_whose_outputs_nothing_asks_for_says_so(tmp_path):
    scenario = legs(tmp_path, "forces: []")
    with pytest.raises(ScenarioError, match="outputs: "):
        build_scenario(scenario)
