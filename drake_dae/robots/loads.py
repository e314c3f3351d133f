"""Known forces on a robot that are none of constraints.                       (37)"""

from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from drake_dae.arguments import checked
from drake_dae.dae.system.signals import Parameter
from drake_dae.errors import ModelError
from drake_dae.robots.links.kinematics import Kinematics, Reaction
from drake_dae.robots.surfaces.surface import Vector


@checked(ModelError)
@dataclass(frozen=True)
class KnownForce:
    """A force F on a point of a frame, which the right side of (37) then holds as J_p^T F.

    The parameter "<name>.force" is F in N, in the world, zero by default. As an exogenous signal
    (see `RobotModel`) it is a push, a weight that is picked up, or a force that a sensor measures:
    the law, which knows it too, makes up for it. A force that the law does not know is set in the
    plant's context alone.

    Attributes:
        frame: Name of the frame.
        point: The point in the frame, m, shape (3,).
        name: Stands before the name of its parameter.
    """

    frame: str
    point: Vector = (0.0, 0.0, 0.0)
    name: str = "load"
    parameters: tuple[Parameter, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        force = Parameter(f"{self.name}.force", np.zeros(3), "N")
        object.__setattr__(self, "parameters", (force,))

    def reaction(self, kinematics: Kinematics) -> Reaction:
        """What it does to the robot."""
        velocity = kinematics.velocity(self.frame, self.point)
        return kinematics.reaction(ca.dot(self.parameters[0].symbol, velocity))
