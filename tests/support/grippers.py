"""A gripper whose right finger mimics the left one, as URDF."""

from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

LINK = """
  <link name="{name}"><inertial><origin xyz="{x} 0 0.1"/><mass value="{mass}"/>
    <inertia ixx="0.02" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.04"/></inertial></link>"""
JOINT = """
  <joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>
    <origin xyz="0.3 0 0.2" rpy="0.2 0.1 0"/><axis xyz="{axis}"/>
    <limit lower="-2" upper="2" effort="50" velocity="5"/>{mimic}</joint>"""
DRIVE = """
  <transmission name="{name}_t"><type>transmission_interface/SimpleTransmission</type>
    <joint name="{name}"/><actuator name="{name}_motor"/></transmission>"""


def gripper(driven=("arm", "left"), multiplier=-0.7):
    """An arm with two fingers; the right one mimics the left one and has no motor of its own."""
    mimic = f'<mimic joint="left" multiplier="{multiplier}" offset="0.05"/>'
    text = '<robot name="gripper"><link name="world"/>'
    for name, x, mass in (("palm", 0.2, 3.0), ("left_pad", 0.1, 0.5), ("right_pad", 0.1, 0.4)):
        text += LINK.format(name=name, x=x, mass=mass)
    for name, parent, child, kind, axis, copy in (
        ("arm", "world", "palm", "revolute", "0 1 0", ""),
        ("left", "palm", "left_pad", "prismatic", "0 1 0", ""),
        ("right", "palm", "right_pad", "prismatic", "0 1 0", mimic),
    ):
        text += JOINT.format(
            name=name, kind=kind, parent=parent, child=child, axis=axis, mimic=copy
        )
    text += "".join(DRIVE.format(name=name) for name in driven)
    return f"{text}\n</robot>"


def parsed(text, time_step=0.0):
    plant = MultibodyPlant(time_step)
    Parser(plant).AddModelsFromString(text, "urdf")
    plant.Finalize()
    return plant
