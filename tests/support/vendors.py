"""Robots as vendors write them: no base, no transmissions, meshes of packages, mimic fingers."""

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

COLLADA = "<COLLADA xmlns='http://www.collada.org/2005/11/COLLADASchema' version='1.4.1'/>"


def binary_stl() -> bytes:
    """A tetrahedron of 0.1 m."""
    corners = 0.1 * np.vstack([np.zeros(3), np.eye(3)])
    faces = [corners[list(face)] for face in ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))]
    body = b"".join(struct.pack("<12fH", *np.zeros(3), *face.ravel(), 0) for face in faces)
    return b" " * 80 + struct.pack("<I", len(faces)) + body


def link(name: str, mass: float, visual: str = "", collision: str = "") -> str:
    """A rod along z with its meshes."""
    parts = "".join(
        f'<{kind}>\n<geometry><mesh filename="{mesh}" scale="1 1 1"/></geometry>\n</{kind}>\n'
        for kind, mesh in (("visual", visual), ("collision", collision))
        if mesh
    )
    small, large = 0.004 * mass, 0.02 * mass
    return (
        f'<link name="{name}"><inertial><origin xyz="0.01 -0.02 0.12"/><mass value="{mass}"/>'
        f'<inertia ixx="{large}" iyy="{large}" izz="{small}" ixy="0" ixz="0" iyz="0"/></inertial>'
        f"\n{parts}</link>\n"
    )


def joint(
    name: str,
    parent: str,
    child: str,
    axis: str,
    place: Sequence[float] = (0.0, 0.0, 0.25),
    kind: str = "revolute",
    rest: str = "",
    limits: tuple[float, float] = (-2.9, 2.9),
    effort: float = 87.0,
) -> str:
    """A joint with limits, and no transmission."""
    x, y, z = place
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="{x} {y} {z}"/><parent link="{parent}"/>'
        f'<child link="{child}"/><axis xyz="{axis}"/><limit lower="{limits[0]}" '
        f'upper="{limits[1]}" effort="{effort}" velocity="2"/>{rest}</joint>\n'
    )


def robot(name: str, *parts: str) -> str:
    return f'<?xml version="1.0"?>\n<robot name="{name}">\n{"".join(parts)}</robot>\n'


def panda() -> str:
    """Seven joints, a hand and two fingers, the second of which mimics the first."""
    meshes = "package://panda_description/meshes"
    arms = [f"panda_link{k}" for k in range(8)]
    axes = ["0 0 1", "0 1 0", "0 0 1", "0 -1 0", "0 0 1", "0 -1 0", "0 0 1"]
    fingers = ("panda_leftfinger", "panda_rightfinger")
    mimic = '<mimic joint="panda_finger_joint1"/>'
    return robot(
        "panda",
        *(
            link(arm, 3.0 - 0.3 * k, f"{meshes}/visual/{arm}.dae", f"{meshes}/collision/{arm}.stl")
            for k, arm in enumerate(arms)
        ),
        *(joint(f"panda_joint{k + 1}", arms[k], arms[k + 1], axis) for k, axis in enumerate(axes)),
        link("panda_hand", 0.7, f"{meshes}/visual/hand.dae", f"{meshes}/collision/hand.stl"),
        '<joint name="panda_hand_joint" type="fixed"><origin xyz="0 0 0.1" rpy="0 0 -0.785"/>'
        '<parent link="panda_link7"/><child link="panda_hand"/></joint>\n',
        *(
            link(finger, 0.1, f"{meshes}/visual/finger.dae", f"{meshes}/collision/finger.stl")
            for finger in fingers
        ),
        *(
            joint(
                f"panda_finger_joint{k + 1}",
                "panda_hand",
                fingers[k],
                f"0 {1 - 2 * k} 0",
                (0.0, 0.0, 0.06),
                "prismatic",
                mimic if k else "",
                (0.0, 0.04),
                20.0,
            )
            for k in range(2)
        ),
    )


def write_panda(folder: Path) -> Path:
    """The panda in a package: folder/panda_description/urdf/panda.urdf."""
    home = folder / "panda_description"
    text = panda()
    for kind, content in (("visual", COLLADA.encode()), ("collision", binary_stl())):
        (home / "meshes" / kind).mkdir(parents=True)
        for part in ("hand", "finger", *(f"panda_link{k}" for k in range(8))):
            suffix = "dae" if kind == "visual" else "stl"
            (home / "meshes" / kind / f"{part}.{suffix}").write_bytes(content)
    (home / "package.xml").write_text("<package><name>panda_description</name></package>")
    (home / "urdf").mkdir()
    (home / "urdf" / "panda.urdf").write_text(text)
    return home / "urdf" / "panda.urdf"


def mobile_arm() -> str:
    """An arm of two joints on a base with two wheels that nothing holds."""
    return robot(
        "mobile_arm",
        link("base_footprint", 20.0),
        link("left_wheel", 1.0),
        link("right_wheel", 1.0),
        link("upper_arm", 3.0),
        link("forearm", 2.0),
        joint("left_axle", "base_footprint", "left_wheel", "0 1 0", (0, 0.2, 0.1), "continuous"),
        joint("right_axle", "base_footprint", "right_wheel", "0 1 0", (0, -0.2, 0.1), "continuous"),
        joint("shoulder", "base_footprint", "upper_arm", "0 1 0", (0, 0, 0.5)),
        joint("elbow", "upper_arm", "forearm", "0 1 0", (0, 0, 0.4)),
    )
