"""Which axis of a tool's frame points out of the robot."""

from dataclasses import dataclass

import numpy as np
from pydrake.multibody.parsing import GetScopedFrameByName
from pydrake.multibody.tree import WeldJoint

from drake_dae.robots.constraints.constraint import Touch
from drake_dae.robots.links.links import Links


@dataclass(frozen=True)
class ToolAxis:
    """An axis of a frame, and its direction that points outward.

    Attributes:
        axis: "x", "y" or "z".
        sign: 1, or -1 where the negative axis points outward.
    """

    axis: str
    sign: float

    @property
    def column(self) -> int:
        """Which column of a rotation it is."""
        return "xyz".index(self.axis)


def tool_axis(links: Links, touch: Touch) -> ToolAxis:
    """The axis of the touching frame along which the tool sticks out of the last joint that moves.

    It is the axis closest to the line from that joint to the touching point; z where the point is
    at the joint, which is what vendors mean by it.
    """
    plant = links.plant
    if plant is None:
        return ToolAxis("z", 1.0)
    frame = GetScopedFrameByName(plant, touch.frame)
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    above = {joint.child_body().index(): joint for joint in joints}
    body = frame.body()
    while isinstance(above.get(body.index()), WeldJoint):
        body = above[body.index()].parent_body()
    joint = above.get(body.index())
    origin = body.body_frame() if joint is None else joint.frame_on_child()
    context = plant.CreateDefaultContext()
    offset = np.array(touch.point) - origin.CalcPose(context, frame).translation()
    largest = int(np.argmax(np.abs(offset)))
    if abs(offset[largest]) < 1e-6:
        return ToolAxis("z", 1.0)
    return ToolAxis("xyz"[largest], float(np.sign(offset[largest])))
