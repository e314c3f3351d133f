"""Pages with large meshes stay small, and say so."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from pydrake.geometry import Role, SceneGraph

from drake_dae.errors import GeometryWarning
from drake_dae.scenario.robot_file.reading import read_robot
from drake_dae.scenario.robot_file.robot import Robot
from drake_dae.scene.view import MOST_BYTES, shrink_meshes

URDF = '<robot name="r"><link name="a">{}</link></robot>'
VISUAL = '<visual name="v{}"><geometry><mesh filename="{}" scale="2 1 1"/></geometry></visual>'


def scene_of(folder: Path, files: list[str]):
    visuals = "".join(VISUAL.format(k, file) for k, file in enumerate(files))
    (folder / "robot.urdf").write_text(URDF.format(visuals))
    scene_graph = SceneGraph()
    plant, _ = read_robot(Robot(str(folder / "robot.urdf")), None, scene_graph)
    return scene_graph, plant.get_source_id()


@pytest.mark.parametrize("kind", ["obj", "gltf"])
def test_large_meshes_are_coarser_and_of_the_same_form(kind: str, tmp_path: Path):
    """An ellipsoid of 20,480 triangles keeps its half axes, to the width of two cells."""
    trimesh = pytest.importorskip("trimesh")
    sphere = trimesh.creation.icosphere(subdivisions=5)
    sphere.apply_scale([1.0, 0.5, 0.25])
    if kind == "gltf":
        written = sphere.scene().export(file_type="gltf", merge_buffers=True, embed_buffers=True)
        (tmp_path / "large.gltf").write_bytes(written["model.gltf"])
    else:
        sphere.export(tmp_path / f"large.{kind}")
    trimesh.creation.box().export(tmp_path / "small.obj")
    scene_graph, source = scene_of(tmp_path, [f"large.{kind}"] * 9 + ["small.obj"])
    with pytest.warns(GeometryWarning, match="large"):
        shrink_meshes(scene_graph, source)
    inspector = scene_graph.model_inspector()
    total = 0
    for geometry in inspector.GetAllGeometryIds(Role.kIllustration):
        data = inspector.GetShape(geometry).source()
        if data.is_path():
            total += Path(data.path()).stat().st_size
            assert Path(data.path()).name == "small.obj"
            continue
        text = data.in_memory().mesh_file.contents().decode()
        total += len(text)
        points = np.array([row.split()[1:] for row in text.splitlines() if row[0] == "v"], float)
        half = [1.0, 0.25, 0.5] if kind == "gltf" else [1.0, 0.5, 0.25]
        np.testing.assert_allclose(np.abs(points).max(axis=0), half, atol=2 * 2 / 48)
        assert len(points) > 500
    assert total <= MOST_BYTES


def test_small_meshes_stay(tmp_path: Path):
    pytest.importorskip("trimesh").creation.icosphere(3).export(tmp_path / "small.obj")
    scene_graph, source = scene_of(tmp_path, ["small.obj"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        shrink_meshes(scene_graph, source)
