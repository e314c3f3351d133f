"""The animation takes along no file that the model has no business to read."""

import base64
import json
from pathlib import Path

import pytest

from drake_dae import build_scenario, load_scenario
from drake_dae.errors import GeometryWarning
from drake_dae.scene.view import start_meshcat

SECRET = "the secret of this machine, 36 bytes"

SCENARIO = """
robot: {file: robot/arm.urdf}
constraints: []
outputs: [!JointPositions {joints: [joint]}]
law:
  gains: !Poles {all: [-3.0]}
references: {joint: 0.2}
duration: 0.01
"""

URDF = """<robot name="arm"><link name="rod">
<inertial><origin xyz="0.5 0 0"/><mass value="1"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
<visual><geometry><mesh filename="MESH"/></geometry></visual></link>
<joint name="joint" type="revolute"><parent link="world"/><child link="rod"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="9" velocity="9"/></joint>
<transmission><type>transmission_interface/SimpleTransmission</type>
<joint name="joint"/><actuator name="joint"/></transmission></robot>"""

OBJ = "mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvn 0 0 1\nusemtl a\nf 1/1/1 2/1/1 3/1/1\n"


def gltf(uri: str) -> str:
    """A triangle whose vertices are the bytes of a file."""
    return json.dumps(
        {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
            "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
            "bufferViews": [{"buffer": 0, "byteLength": 36}],
            "buffers": [{"uri": uri, "byteLength": 36}],
        }
    )


def collada(image: str) -> str:
    return f"<COLLADA><image><init_from>{image}</init_from></image></COLLADA>"


def robot(folder: Path, mesh: str, **files: str) -> Path:
    """A scenario beside a folder with its robot, and beside a secret."""
    (folder / "secret.txt").write_text(SECRET)
    (folder / "robot").mkdir()
    for name, text in files.items():
        place = folder / "robot" / name.replace("_", ".")
        place.write_text(text.replace("ROOT", str(folder)))
    (folder / "robot" / "arm.urdf").write_text(URDF.replace("MESH", mesh))
    (folder / "arm.yaml").write_text(SCENARIO)
    return folder / "arm.yaml"


OUTSIDE = {
    "gltf, relative": ("m.gltf", {"m_gltf": gltf("../secret.txt")}),
    "gltf, encoded": ("m.gltf", {"m_gltf": gltf("%2e%2e/secret.txt")}),
    "gltf, by a link": ("m.gltf", {"m_gltf": gltf("link/secret.txt")}),
    "gltf, key twice": (
        "m.gltf",
        {"m_gltf": gltf("a").replace('"uri": "a"', '"uri": "../secret.txt", "uri": "b"')},
    ),
    "texture": ("m.obj", {"m_obj": OBJ, "m_mtl": "newmtl a\nmap_Kd -clamp on ../secret.txt\n"}),
    "collada": ("m.dae", {"m_dae": collada("file://ROOT/secret.txt")}),
    "mesh": ("../secret.txt", {}),
}


@pytest.mark.parametrize(("mesh", "files"), OUTSIDE.values(), ids=OUTSIDE)
def test_what_is_outside_of_the_model_is_left_out_by_name(
    mesh: str, files: dict[str, str], tmp_path: Path
):
    path = robot(tmp_path, mesh, **files)
    (tmp_path / "robot" / "link").symlink_to(tmp_path)
    with pytest.warns(GeometryWarning, match=Path(mesh).name.replace(".", r"\.")):
        loop, context = build_scenario(load_scenario(path), meshcat := start_meshcat())
    loop.diagram.ForcedPublish(context)
    page = meshcat.StaticHtml()
    assert SECRET not in page
    assert base64.b64encode(SECRET.encode()).decode() not in page


def test_files_of_the_model_are_drawn_also_through_links(tmp_path: Path):
    path = robot(tmp_path, "m.gltf", m_gltf=gltf("data.bin"))
    (tmp_path / "robot" / "data.bin").write_bytes(bytes(range(36)))
    (tmp_path / "robot").rename(tmp_path / "elsewhere")
    (tmp_path / "robot").symlink_to(tmp_path / "elsewhere")
    loop, context = build_scenario(load_scenario(path), meshcat := start_meshcat())
    loop.diagram.ForcedPublish(context)
    assert base64.b64encode(bytes(range(36))).decode() in meshcat.StaticHtml()
