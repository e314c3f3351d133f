"""The head of a screw that a tool turns and presses."""

from dataclasses import dataclass, field
from math import isfinite, pi

import casadi as ca
import numpy as np

from drake_dae.arguments import checked
from drake_dae.dae.system.signals import Parameter
from drake_dae.errors import ModelError
from drake_dae.robots.constraints.constraint import Application
from drake_dae.robots.constraints.points import PointOnSurface
from drake_dae.robots.links.kinematics import Frames, Kinematics, position_index


@checked(ModelError)
@dataclass(frozen=True)
class ScrewHead(PointOnSurface):
    """A point of a frame stays on the head of a screw, which advances as a joint turns it:

        phi(q) = d(p_W(q)) + pitch (q_j - angle) / (2 pi),

    with the signed distance d from the surface, and the position q_j of the joint. At q_j = angle
    the head is the surface. With a positive pitch, a rising q_j moves the head away from the tool.

    The constraint force is the force on the head in N, and unilateral: the tool can leave the head.
    The thread also exerts the torque pitch / (2 pi) times this force on the joint, and no friction;
    friction of the thread is friction of the joint (`JointFriction`). The screw turns with the
    joint also while the tool is away from it. Parameters are those of a `PointOnSurface` and
    "<name>.pitch". Plants with compliant contact do not support it.

    Attributes:
        turned_by: The name of the position that turns the screw, "joint7" for example.
        pitch: The advance in m per turn; 0 for a screw that turns without advance, negative for a
            left-handed thread.
        angle: The position of the joint at which the head is the surface, in rad.

    Raises:
        ModelError: A number is not valid.
    """

    turned_by: str = field(kw_only=True)
    pitch: float = field(kw_only=True)
    angle: float = field(default=0.0, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("pitch", "angle"):
            if not isfinite(value := getattr(self, name)):
                raise ModelError(f"ScrewHead: {name} must be finite, got {value}")
        pitch = Parameter(f"{self.name}.pitch", np.array([self.pitch]), "m")
        # Those of the shape of the surface are the last ones.
        end = len(self.parameters) - len(self.surface.shape)
        parameters = (*self.parameters[:end], pitch, *self.parameters[end:])
        object.__setattr__(self, "parameters", parameters)

    @property
    def _per_radian(self) -> ca.SX:
        (pitch,) = (p.symbol for p in self.parameters if p.name == f"{self.name}.pitch")
        return pitch / (2.0 * pi)

    def residual(self, frames: Frames) -> ca.SX:
        turned = frames.q[position_index(frames, self.turned_by)] - self.angle
        return super().residual(frames) + self._per_radian * turned

    def applications(self, kinematics: Kinematics) -> tuple[Application, ...]:
        axis = kinematics.joint_axis(self.turned_by)
        if axis is None:
            return ()
        torque = self._per_radian * axis.force, self._per_radian * axis.moment
        turning = Application(axis.point, *torque, axis.child, axis.parent)
        return (*super().applications(kinematics), turning)

    def touch(self, frames: Frames) -> None:  # type: ignore[override]
        """None: the free side moves with the joint, which compliant contacts do not know."""
