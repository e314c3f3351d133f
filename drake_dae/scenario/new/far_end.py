"""The far end of the last link of a chain, if a file has no frame there."""

import warnings
from collections.abc import Iterator

import numpy as np
from pydrake.geometry import Role, SceneGraph
from pydrake.multibody.parsing import GetScopedFrameByName
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Joint, RevoluteJoint, RigidBody

from drake_dae.arrays import FloatArray
from drake_dae.errors import GeometryWarning, RobotFileWarning
from drake_dae.robots.surfaces.surface import Vector
from drake_dae.scenario.robot_file.changes import finalize
from drake_dae.scenario.robot_file.reading import read_robot
from drake_dae.scenario.robot_file.robot import Robot


def far_end(robot: Robot, body: RigidBody, last: Joint, size: float) -> Vector | None:
    """The point of a link that is farthest from the joint that moves it, m in the link's frame.

    It is the center of a face of a bounding box of the link's geometry; without geometry it is
    beyond the center of mass, at the end of an equivalent rod.

    Args:
        robot: The value of the scenario's key `robot`.
        body: The link, of a finalized plant of that robot.
        last: The joint of the same plant that moves it.
        size: The size of the robot, m: points within a hundredth of it count as at the joint.

    Returns:
        The point; None if there is none off the axis of the joint.
    """
    scene_graph = SceneGraph()
    with warnings.catch_warnings():  # They are repeated by the run.
        warnings.simplefilter("ignore", GeometryWarning)
        warnings.simplefilter("ignore", RobotFileWarning)
        plant, _ = read_robot(robot, scene_graph)
    finalize(plant)
    name = body.scoped_name().get_full()
    link = GetScopedFrameByName(plant, name).body()
    joint = plant.GetJointByName(last.name(), last.model_instance())
    X_BJ = joint.frame_on_child().CalcPose(plant.CreateDefaultContext(), link.body_frame())
    axis = X_BJ.rotation() @ joint.revolute_axis() if isinstance(joint, RevoluteJoint) else None

    def distance(point: FloatArray) -> float:
        lever = point - X_BJ.translation()
        return float(np.linalg.norm(lever if axis is None else np.cross(axis, lever)))

    mass_at = link.default_com() if link.default_mass() > 0.0 else X_BJ.translation()
    beyond = [2.0 * mass_at - X_BJ.translation()]
    for points in (list(_faces(plant, link, scene_graph)), beyond):
        farthest = max(points, key=distance, default=None)
        if farthest is not None and distance(farthest) > 0.01 * size:
            x, y, z = (float(value) + 0.0 for value in np.round(farthest, 4))
            return (x, y, z)
    return None


def _faces(plant: MultibodyPlant, link: RigidBody, scene_graph: SceneGraph) -> Iterator[FloatArray]:
    """The middles of the faces of boxes around the geometries of a link, m, each of shape (3,)."""
    inspector = scene_graph.model_inspector()
    frame = plant.GetBodyFrameIdIfExists(link.index())
    if frame is None:
        return
    for role in (Role.kIllustration, Role.kProximity):
        for geometry in inspector.GetGeometries(frame, role):
            try:
                box = inspector.GetObbInGeometryFrame(geometry)
            except RuntimeError:  # Of a mesh that Drake cannot read.
                continue
            if box is None:
                continue
            X_BO = inspector.GetPoseInFrame(geometry) @ box.pose()
            for k, half in enumerate(box.half_width()):
                for sign in (-1.0, 1.0):
                    yield X_BO @ (sign * half * np.eye(3)[k])
