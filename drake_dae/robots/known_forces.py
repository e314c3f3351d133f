"""Known applied forces on a robot.                                            (37)"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from drake_dae.arguments import checked
from drake_dae.dae import Parameter
from drake_dae.errors import ModelError
from drake_dae.robots.links.kinematics import Kinematics, Reaction
from drake_dae.robots.surfaces.surface import Vector


class Load(ABC):
    """Applied forces on a robot that its model contains.

    1. `reaction` are the forces, as a function of positions, velocities and `parameters`.
    2. `resistance` is D(q, v), positive semidefinite, if they are -D v; zero otherwise. A plant in
       discrete steps uses D v of the velocities after the step, which is stable for any step.
    3. `dry` are the names of the parameters that are coefficients of Coulomb friction.
    """

    parameters: tuple[Parameter, ...]

    @property
    def dry(self) -> tuple[str, ...]:
        """Names of the coefficients of Coulomb friction."""
        return ()

    @abstractmethod
    def reaction(self, kinematics: Kinematics) -> Reaction:
        """The reaction on the robot."""

    def resistance(self, kinematics: Kinematics) -> ca.SX:
        """D of the generalized force -D v, shape (nv, nv)."""
        return ca.SX(kinematics.v.numel(), kinematics.v.numel())


@checked(ModelError)
@dataclass(frozen=True)
class KnownForce(Load):
    """A force F on a point of a frame, which adds J_p^T F to the right side of (37).

    The parameter "<name>.force" is F in N, in the world, zero by default. As an exogenous signal
    (see `RobotModel`) it is a varying applied force, the weight of a payload, or a force that a
    sensor measures; the law has it as well and compensates it. For a force that the law does not
    know, set it in the plant's context alone.

    Attributes:
        frame: Name of the frame.
        point: The point in the frame, m, shape (3,).
        name: The prefix of its parameter's name.
    """

    frame: str
    point: Vector = (0.0, 0.0, 0.0)
    name: str = "load"
    parameters: tuple[Parameter, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        force = Parameter(f"{self.name}.force", np.zeros(3), "N")
        object.__setattr__(self, "parameters", (force,))

    def reaction(self, kinematics: Kinematics) -> Reaction:
        """The reaction on the robot."""
        velocity = kinematics.velocity(self.frame, self.point)
        return kinematics.reaction(ca.dot(self.parameters[0].symbol, velocity))


@checked(ModelError)
@dataclass(frozen=True)
class KnownWrench(KnownForce):
    """A force F on a point of a frame and a moment M on the frame.

    The parameters "<name>.force" and "<name>.moment" are F in N and M in N m, in the world, zero by
    default: so any point of the body can be pushed.
    """

    name: str = "wrench"

    def __post_init__(self) -> None:
        super().__post_init__()
        moment = Parameter(f"{self.name}.moment", np.zeros(3), "N m")
        object.__setattr__(self, "parameters", (*self.parameters, moment))

    def reaction(self, kinematics: Kinematics) -> Reaction:
        force, moment = (parameter.symbol for parameter in self.parameters)
        velocity = kinematics.velocity(self.frame, self.point)
        turning = kinematics.angular_velocity(self.frame)
        return kinematics.reaction(ca.dot(force, velocity) + ca.dot(moment, turning))


@dataclass(frozen=True)
class ScaledForce(KnownForce):
    """A force s(t) F on a point of a frame, whose course s is an exogenous signal.

    The parameter "<name>.force" is F in N, in the world, and "<name>.course" is s, zero by default:
    a study changes F without another signal.

    Attributes:
        force: The default of F.
    """

    name: str = "scaled_force"
    force: Vector = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        force = Parameter(f"{self.name}.force", np.array(self.force), "N")
        course = Parameter(f"{self.name}.course", np.zeros(1))
        object.__setattr__(self, "parameters", (force, course))

    def reaction(self, kinematics: Kinematics) -> Reaction:
        force, course = (parameter.symbol for parameter in self.parameters)
        velocity = kinematics.velocity(self.frame, self.point)
        return kinematics.reaction(course * ca.dot(force, velocity))
