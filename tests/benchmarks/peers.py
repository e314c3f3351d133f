"""A MultibodyPlant of joints that turn, as it is for Pinocchio and for MuJoCo.

Both are made of the same numbers, which Drake has read from the robot's files: where the joints
are, the inertias of what turns with each, the rotors.
"""

from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, RigidBody, SpatialInertia

WORLD = -1


@dataclass(frozen=True)
class Turning:
    """What one joint turns, in the frame of the joint.

    Attributes:
        parent: The joint before it; -1 for the world.
        placement: The pose of its frame in that of the parent, where all angles are zero.
        axis: The axis that it turns about, shape (3,).
        inertia: Of all bodies that are fixed to it.
        rotor: The reflected inertia of its motor, kg m^2.
    """

    parent: int
    placement: RigidTransform
    axis: np.ndarray
    inertia: SpatialInertia
    rotor: float


class Tree:
    """The joints of a plant, in the order of its velocities; none has damping."""

    def __init__(self, plant: MultibodyPlant) -> None:
        self.plant = plant
        context = plant.CreateDefaultContext()
        plant.SetPositions(context, np.zeros(plant.num_positions()))
        joints = [plant.get_joint(i) for i in plant.GetJointIndices()]
        self._onto = {j.child_body().index(): j for j in joints}
        moving = sorted((j for j in joints if j.num_velocities()), key=lambda j: j.velocity_start())
        self._frames = [j.frame_on_child() for j in moving]
        self._number = {j.index(): number for number, j in enumerate(moving)}
        poses = [frame.CalcPoseInWorld(context) for frame in self._frames]
        inertias = [SpatialInertia.Zero() for _ in moving]
        for index in range(1, plant.num_bodies()):
            body = plant.get_body(BodyIndex(index))
            number = self.joint_of(body)
            if number == WORLD:
                continue
            pose = poses[number].inverse() @ plant.EvalBodyPoseInWorld(context, body)
            own = body.CalcSpatialInertiaInBodyFrame(context)
            inertias[number] += own.ReExpress(pose.rotation()).Shift(-pose.translation())
        rotors = np.zeros(len(moving))
        for i in plant.GetJointActuatorIndices():
            motor = plant.get_joint_actuator(i)
            reflected = motor.default_rotor_inertia() * motor.default_gear_ratio() ** 2
            rotors[motor.joint().velocity_start()] = reflected
        self.joints = []
        for number, joint in enumerate(moving):
            assert not np.any(joint.default_damping_vector())
            parent = self.joint_of(joint.parent_body())
            before = RigidTransform() if parent == WORLD else poses[parent]
            placement = before.inverse() @ poses[number]
            axis = joint.revolute_axis()
            self.joints.append(Turning(parent, placement, axis, inertias[number], rotors[number]))
        self._poses = poses

    def joint_of(self, body: RigidBody) -> int:
        """The joint that turns a body; -1 if none does."""
        while body.index() in self._onto:
            joint = self._onto[body.index()]
            if joint.num_velocities():
                return self._number[joint.index()]
            body = joint.parent_body()
        return WORLD

    def place(self, name: str, pose: RigidTransform | None = None) -> tuple[int, RigidTransform]:
        """The joint that turns a frame, and where the frame, or a pose in it, is on it."""
        context = self.plant.CreateDefaultContext()
        self.plant.SetPositions(context, np.zeros(self.plant.num_positions()))
        body, _, rest = name.rpartition("::")
        plant = self.plant
        instance = [plant.GetModelInstanceByName(body)] if body else []
        frame = plant.GetFrameByName(rest, *instance)
        number = self.joint_of(frame.body())
        there = frame.CalcPoseInWorld(context) @ (pose or RigidTransform())
        before = RigidTransform() if number == WORLD else self._poses[number]
        return number, before.inverse() @ there


def pinocchio_model(tree: Tree):
    """The tree as a `pinocchio.Model`."""
    import pinocchio

    model = pinocchio.Model()
    plain = {(1, 0, 0): "RX", (0, 1, 0): "RY", (0, 0, 1): "RZ"}
    for number, joint in enumerate(tree.joints):
        kind = plain.get(tuple(joint.axis))
        turns = (
            getattr(pinocchio, f"JointModel{kind}")()
            if kind
            else pinocchio.JointModelRevoluteUnaligned(joint.axis)
        )
        index = model.addJoint(joint.parent + 1, turns, se3(joint.placement), f"joint{number}")
        mass, center = joint.inertia.get_mass(), joint.inertia.get_com()
        about = joint.inertia.Shift(center).CalcRotationalInertia().CopyToFullMatrix3()
        model.appendBodyToJoint(
            index, pinocchio.Inertia(mass, center, about), pinocchio.SE3.Identity()
        )
    model.armature = np.array([joint.rotor for joint in tree.joints])
    return model


def se3(pose: RigidTransform):
    """A pose as Pinocchio has it."""
    import pinocchio

    return pinocchio.SE3(pose.rotation().matrix(), pose.translation())


def mujoco_model(tree: Tree, equality: str, *sites: tuple[int, RigidTransform]):
    """The tree as a `mujoco.MjModel`, without contact and limits.

    Args:
        tree: The tree.
        equality: What stands in <equality>.
        sites: "site0", "site1", ...: the joint that turns it, -1 for the world, and its pose there.
    """
    import mujoco

    inside: list[list[int]] = [[] for _ in range(len(tree.joints) + 1)]
    for number, joint in enumerate(tree.joints):
        inside[joint.parent + 1].append(number)

    def fixed(to: int) -> str:
        return "".join(
            f'<site name="site{k}" pos="{text(pose.translation())}" '
            f'quat="{quaternion(pose.rotation())}"/>'
            for k, (number, pose) in enumerate(sites)
            if number == to
        )

    def body(number: int) -> str:
        joint = tree.joints[number]
        center = joint.inertia.get_com()
        about = joint.inertia.Shift(center).CalcRotationalInertia().CopyToFullMatrix3()
        entries = [about[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
        return (
            f'<body name="body{number}" pos="{text(joint.placement.translation())}" '
            f'quat="{quaternion(joint.placement.rotation())}">'
            f'<inertial pos="{text(center)}" mass="{text([joint.inertia.get_mass()])}" '
            f'fullinertia="{text(entries)}"/>'
            f'<joint axis="{text(joint.axis)}" armature="{text([joint.rotor])}"/>'
            + fixed(number)
            + "".join(map(body, inside[number + 1]))
            + "</body>"
        )

    bodies = fixed(WORLD) + "".join(map(body, inside[0]))
    return mujoco.MjModel.from_xml_string(
        '<mujoco><compiler angle="radian" autolimits="false"/>'
        '<option><flag contact="disable" limit="disable" island="disable"/></option>'
        f"<worldbody>{bodies}</worldbody><equality>{equality}</equality></mujoco>"
    )


def text(numbers) -> str:
    """Numbers in all their digits, as XML has them."""
    return " ".join(repr(float(number)) for number in numbers)


def quaternion(rotation: RotationMatrix) -> str:
    """A rotation in MuJoCo's order, w first."""
    return text(rotation.ToQuaternion().wxyz())
