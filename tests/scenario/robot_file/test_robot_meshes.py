"""Meshes that Drake cannot read or draw are left out by name; the rest of a robot is as it was."""

import json
from pathlib import Path

import numpy as np
import pytest
from pydrake.geometry import Role, SceneGraph

from drake_dae.errors import GeometryWarning
from drake_dae.scenario.robot_file.reading import read_robot
from drake_dae.scenario.robot_file.robot import Robot


def count(scene_graph: SceneGraph, role: Role) -> int:
    return len(scene_graph.model_inspector().GetAllGeometryIds(role))


def read(file: Path, scene_graph: SceneGraph, **more: object):
    return read_robot(Robot(str(file), **more), scene_graph=scene_graph)[0]


LEFT_OUT = {
    "missing": ("none.dae", lambda folder: None),
    "package": ("package://unknown/part.obj", lambda folder: None),
    "web": ("https://example.org/part.obj", lambda folder: None),
    "cycle": ("link.obj", lambda folder: (folder / "robots" / "link.obj").symlink_to("link.obj")),
    "text": ("text.stl", lambda folder: (folder / "robots" / "text.stl").write_text("no mesh")),
}


@pytest.mark.parametrize("kind", ["urdf", "sdf", "xml"])
@pytest.mark.parametrize(("name", "prepare"), LEFT_OUT.values(), ids=LEFT_OUT)
def test_geometry_stops_no_robot(kind: str, name: str, prepare, tmp_path: Path):
    """Both shapes go with one line."""
    (tmp_path / "robots").mkdir()
    prepare(tmp_path)
    if kind == "xml" and "://" in name:
        pytest.skip("MJCF names no addresses")
    mesh = f'<geometry><mesh filename="{name}"/></geometry>'
    tagged = f"<geometry><mesh><uri>{name}</uri></mesh></geometry>"
    texts = {
        "urdf": f'<robot><link name="a"><visual>{mesh}</visual><collision>{mesh}</collision>'
        "</link></robot>",
        "sdf": f'<sdf version="1.9"><model><link name="a"><visual name="v">{tagged}</visual>'
        f'<collision name="c">{tagged}</collision></link></model></sdf>',
        "xml": f'<mujoco><asset><mesh name="m" file="{name}"/></asset><worldbody><body name="a">'
        '<geom type="mesh" mesh="m"/></body></worldbody></mujoco>',
    }
    file = tmp_path / "robots" / f"robot.{kind}"
    file.write_text(texts[kind])
    scene_graph = SceneGraph()
    with pytest.warns(GeometryWarning) as told:
        plant = read(file, scene_graph)
    lines = [str(one.message) for one in told]
    assert [line.count(Path(name).name) for line in lines] == [1] * len(set(lines))
    assert plant.HasModelInstanceNamed("robot")
    assert count(scene_graph, Role.kProximity) == 0
    assert count(scene_graph, Role.kIllustration) == 0


COLLADA = """<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="UNIT" name="own"/></asset><library_effects><effect id="paint"><profile_COMMON>
<technique sid="c"><phong><diffuse><color>1 0 0 1</color></diffuse></phong></technique>
</profile_COMMON></effect></library_effects><library_materials><material id="m">
<instance_effect url="#paint"/></material></library_materials><library_geometries>
<geometry id="g"><mesh><source id="v"><float_array id="a" count="24">POINTS</float_array>
<technique_common><accessor source="#a" count="8" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="w"><input semantic="POSITION" source="#v"/></vertices>
<triangles count="12" material="r"><input semantic="VERTEX" source="#w" offset="0"/><p>0 1 3 0 3 2
4 6 7 4 7 5 0 4 5 0 5 1 2 3 7 2 7 6 0 2 6 0 6 4 1 5 7 1 7 3</p></triangles></mesh></geometry>
</library_geometries><library_visual_scenes><visual_scene id="s"><node id="n">
<instance_geometry url="#g"><bind_material><technique_common><instance_material symbol="r"
target="#m"/></technique_common></bind_material></instance_geometry></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


@pytest.mark.parametrize("unit", [1.0, 0.001])
def test_a_dae_is_drawn_in_its_unit_and_its_colors_by_films_as_well(unit: float, tmp_path: Path):
    """Drake's renderer of films takes a .gltf and no .dae; a .gltf has y upward, Drake turns it."""
    pytest.importorskip("collada")
    points = (f"{x} {y} {z}" for x in (-50, 50) for y in (-100, 100) for z in (-150, 150))
    text = COLLADA.replace("UNIT", str(unit)).replace("POINTS", " ".join(points))
    (tmp_path / "box.dae").write_text(text)
    (tmp_path / "robot.urdf").write_text(
        '<robot name="r"><link name="a"><inertial><mass value="1"/><inertia ixx="1" iyy="1" '
        'izz="1" ixy="0" ixz="0" iyz="0"/></inertial><visual><geometry>'
        '<mesh filename="box.dae" scale="2 1 1"/></geometry></visual></link></robot>'
    )
    scene_graph = SceneGraph()
    read_robot(Robot(str(tmp_path / "robot.urdf")), None, scene_graph, drawn=False)
    inspector = scene_graph.model_inspector()
    (one,) = inspector.GetAllGeometryIds(Role.kPerception)
    assert Path(inspector.GetShape(one).source().path()).name == "box.dae"
    read(tmp_path / "robot.urdf", scene_graph := SceneGraph())
    inspector = scene_graph.model_inspector()
    (one,) = inspector.GetAllGeometryIds(Role.kPerception)
    drawn = Path(inspector.GetShape(one).source().path())
    assert drawn.name == "box.gltf"
    (material,) = json.loads(drawn.read_text())["materials"]
    assert material["pbrMetallicRoughness"]["baseColorFactor"] == [1.0, 0.0, 0.0, 1.0]
    box = inspector.GetObbInGeometryFrame(one)
    corners = box.pose().multiply(
        np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1) * box.half_width()[:, None]
    )
    # .gltf has single precision; Drake's box has a margin of its own.
    np.testing.assert_allclose(np.ptp(corners, axis=1), unit * np.array([200, 200, 300]), rtol=1e-3)


def test_names_of_colours_mean_what_other_parsers_take_them_for(tmp_path: Path):
    """One has two colours in two links, of which the first counts, one is defined later, one not.

    Drake refuses each of these.
    """
    box = '<visual><geometry><box size="1 1 1"/></geometry><material name="{}">{}</material>'
    red = '<color rgba="{} 0 0 1"/>'
    one = f"{box.format('two', red.format(1.0))}</visual>{box.format('later', '')}</visual>"
    other = f"{box.format('two', red.format(0.5))}</visual>{box.format('none', '')}</visual>"
    text = (
        f'<robot name="r"><link name="a">{one}</link><link name="b">{other}</link>'
        f'<material name="later">{red.format(0.2)}</material></robot>'
    )
    (tmp_path / "robot.urdf").write_text(text)
    read(tmp_path / "robot.urdf", scene_graph := SceneGraph())
    inspector = scene_graph.model_inspector()
    found = []
    for geometry in inspector.GetAllGeometryIds(Role.kIllustration):
        properties = inspector.GetIllustrationProperties(geometry)
        has = properties.HasProperty("phong", "diffuse")
        found.append(properties.GetProperty("phong", "diffuse").r() if has else None)
    assert sorted(found, key=str) == [0.2, 1.0, 1.0, None]


@pytest.mark.parametrize("kind", ["urdf", "sdf"])
def test_no_texture_of_a_file_is_read(kind: str, tmp_path: Path):
    """It could be any file of this machine, which a page would take along."""
    (tmp_path / "secret.png").write_bytes(b"secret")
    box = "<box><size>1 1 1</size></box>" if kind == "sdf" else '<box size="1 1 1"/>'
    texture = (
        "<drake:diffuse_map>secret.png</drake:diffuse_map>"
        if kind == "sdf"
        else '<texture filename="secret.png"/>'
    )
    body = (
        f'<link name="a"><visual name="v"><geometry>{box}</geometry><material name="m">{texture}'
        "</material></visual></link>"
    )
    drake = 'xmlns:drake="http://drake.mit.edu"'
    whole = f'<sdf version="1.9" {drake}><model name="r">{body}</model></sdf>'
    file = tmp_path / f"robot.{kind}"
    file.write_text(whole if kind == "sdf" else f'<robot name="r" {drake}>{body}</robot>')
    read(file, scene_graph := SceneGraph())
    inspector = scene_graph.model_inspector()
    (one,) = inspector.GetAllGeometryIds(Role.kIllustration)
    assert not inspector.GetIllustrationProperties(one).HasProperty("phong", "diffuse_map")
