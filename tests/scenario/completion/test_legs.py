"""Force outputs of robots on legs that depend on each other."""

import pytest
from vendors import joint, link, robot

from drake_dae import load_scenario
from drake_dae.errors import ScenarioError
from drake_dae.scenario import complete_scenario

LEGS = """
robot: {{file: {folder}/legs.urdf, free: [trunk], actuators: all}}
constraints:
{feet}
law:
  gains: {{all: [-4.0]}}
forces:
{squeezes}
references: {{{held}}}
start: {{positions: {{{bent}}}}}
"""

PAIRS = ("ab", "ac", "ad", "bc", "bd", "cd")
BENT = ", ".join(f"{leg}_hip: 0.6, {leg}_knee: -1.2" for leg in "abcd")


@pytest.mark.slow
def test_of_six_squeezes_of_feet_in_one_plane_five_are_independent(tmp_path):
    """Six bars between four points of a plane bear one state of stress without any load.

    Four legs of three joints on a trunk of which nothing holds, with feet that stand.
    """
    parts, joints, feet = [link("trunk", 4.0)], [], []
    for name, x, y in (("a", 0.2, 0.1), ("b", 0.2, -0.1), ("c", -0.2, 0.1), ("d", -0.2, -0.1)):
        parts += [link(f"{name}{k}", 0.5) for k in (1, 2, 3)]
        joints += [
            joint(f"{name}_roll", "trunk", f"{name}1", "1 0 0", (x, y, 0.0)),
            joint(f"{name}_hip", f"{name}1", f"{name}2", "0 1 0", (0.0, 0.0, -0.05)),
            joint(f"{name}_knee", f"{name}2", f"{name}3", "0 1 0", (0.0, 0.0, -0.3)),
        ]
        place = f"frame_b: {name}3, point_b: [0, 0, -0.3], name: {name}"
        stands = f"!CoincidentPoints {{frame_a: world, point_a: [{x}, {y}, -0.6], {place}}}"
        feet.append(f"- {stands}")
    squeezes = [
        f"- !Squeeze {{frame: world, first: {one}, second: {two}, name: {one}{two}}}"
        for one, two in PAIRS
    ]
    held = ", ".join(f"{pair}: 1.0" for pair in PAIRS)
    lists = {"feet": "\n".join(feet), "squeezes": "\n".join(squeezes), "held": held, "bent": BENT}
    (tmp_path / "legs.urdf").write_text(robot("legs", *parts, *joints))
    (tmp_path / "legs.yaml").write_text(LEGS.format(folder=tmp_path, **lists))
    with pytest.raises(ScenarioError) as caught:
        complete_scenario(load_scenario(tmp_path / "legs.yaml"))
    assert str(caught.value).startswith("forces: ab, ac, ad, bc, bd, cd")
