"""Scenarios with robots of one's own."""

import numpy as np
import pytest
from scenario_texts import LEVER, lever, run

from drake_dae import build_scenario, load_scenario
from drake_dae.errors import ScenarioError

MESH = """v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"""


def test_a_lever_has_nothing_to_move_but_presses(tmp_path):
    """One joint, one contact: the force alone is an output, and needs no gain."""
    loop, record, _ = run(load_scenario(lever(tmp_path)))
    assert loop.controller.law.degrees == (0,)
    # The wall helps against gravity: u + lambda sin(q) 1 m = m g cos(q) 0.5 m, and cos(q) = 0.8.
    np.testing.assert_allclose(record["state"][:, 0], np.arccos(0.8), rtol=1e-12)
    np.testing.assert_allclose(record["control"], 2.0 * 9.81 * 0.5 * 0.8 - 10.0 * 0.6, rtol=1e-12)


def test_a_robot_with_a_mesh(tmp_path):
    path = lever(tmp_path, shape='<mesh filename="shape.obj"/>')
    (tmp_path / "shape.obj").write_text(MESH)
    loop, _ = build_scenario(load_scenario(path))
    links = loop.plant.model.links
    assert len(links.plant.GetVisualGeometriesForBody(links.plant.GetBodyByName("arm"))) == 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"drive": ""}, ["robot.actuators: ", "'lever.urdf'", "all"]),
        ({"drive": "<transmission>"}, ["robot.file: ", "lever.urdf", "XML"]),
        ({"world": "base"}, ["robot.file: ", "'base'", "quaternion", "{weld: "]),
        ({"scenario": LEVER.replace("0.8", "1.8")}, ["start.positions: ", "wall.distance"]),
    ],
)
def test_a_robot_that_does_not_fit(change, words, tmp_path):
    world = change.pop("world", None)
    path = lever(tmp_path, **change)
    if world:
        inertia = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" '
        text = (tmp_path / "lever.urdf").read_text()
        text = text.replace(
            '<link name="world"/>', f'<link name="base">{inertia}iyz="0"/></inertial></link>'
        )
        (tmp_path / "lever.urdf").write_text(text.replace('link="world"', 'link="base"'))
    with pytest.raises(ScenarioError) as caught:
        build_scenario(load_scenario(path))
    message = str(caught.value)
    assert "\n" not in message
    assert [word for word in words if word not in message] == [], message
