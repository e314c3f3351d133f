"""Scenarios with robots of one's own."""

import pytest
from scenario_texts import lever

from drake_dae import build_scenario, load_scenario
from drake_dae.errors import ScenarioError

MESH = """v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"""


def test_a_robot_with_a_mesh(tmp_path):
    path = lever(tmp_path, shape='<mesh filename="shape.obj"/>')
    (tmp_path / "shape.obj").write_text(MESH)
    loop, _ = build_scenario(load_scenario(path))
    links = loop.plant.model.links
    assert len(links.plant.GetVisualGeometriesForBody(links.plant.GetBodyByName("arm"))) == 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"drive": "<transmission>"}, ["robot.file: ", "lever.urdf", "XML"]),
        ({"world": "base"}, ["robot.file: ", "'base'", "quaternion", "{weld: "]),
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
