"""Applied forces that a robot's model contains: known forces on frames, and friction of joints."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import each, positive
from drake_dae.dae import Parameter
from drake_dae.errors import ModelError
from drake_dae.robots.links import Kinematics, Reaction, position_index
from drake_dae.robots.surface import Vector


class Load(ABC):
    """Applied forces on a robot that its model contains.

    1. `reaction` are the forces, as a function of positions, velocities and `parameters`.
    2. `resistance` is D(q, v), positive semidefinite, if they are -D v; zero otherwise. A plant in
       discrete steps uses D v of the velocities after the step, which is stable for any step.
    3. `dry` are the names of the parameters that are coefficients of Coulomb friction.
    """

    def __post_init__(self) -> None:
        _ = self.parameters  # They check themselves.

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return ()

    @property
    def dry(self) -> tuple[str, ...]:
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

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter(f"{self.name}.force", np.zeros(3), "N"),)

    def reaction(self, kinematics: Kinematics) -> Reaction:
        return kinematics.push(self.frame, self.parameters[0].symbol, self.point)


@checked(ModelError)
@dataclass(frozen=True)
class KnownWrench(KnownForce):
    """A force and a moment "<name>.moment", N m, on a frame: so any point of it can be pushed."""

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        force = Parameter(f"{self.name}.force", np.zeros(3), "N")
        return force, Parameter(f"{self.name}.moment", np.zeros(3), "N m")

    def reaction(self, kinematics: Kinematics) -> Reaction:
        moment, spin = self.parameters[1].symbol, kinematics.angular_velocity(self.frame)
        return super().reaction(kinematics) + kinematics.reaction(ca.dot(moment, spin))


@dataclass(frozen=True)
class ScaledForce(KnownForce):
    """A force s(t) F: "<name>.force" is F, and "<name>.course" s, zero by default."""

    force: Vector = (0.0, 0.0, 0.0)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        force = Parameter(f"{self.name}.force", np.array(self.force), "N")
        return force, Parameter(f"{self.name}.course", np.zeros(1))

    def reaction(self, kinematics: Kinematics) -> Reaction:
        force, course = (parameter.symbol for parameter in self.parameters)
        return kinematics.push(self.frame, course * force, self.point)


@checked(ModelError)
@dataclass(frozen=True)
class JointFriction(Load):
    """Coulomb and viscous friction of joints, regularized Coulomb friction with the speed v_s:

        tau = -(F_c / sqrt(q'^2 + v_s^2) + d) q'.

    It does not stick: below the Coulomb torque a joint creeps with at most v_s. The parameters
    "<joint>.coulomb" and "<joint>.viscous" are F_c and d. A law compensates the friction that its
    model has; with the values 0 in the model, and others in `plant.parameters`, it is unknown.

    Attributes:
        joints: Names of joint positions.
        coulomb: F_c in N m (N), not negative, a number or one for each joint.
        viscous: d in N m s (N s/m), likewise.
        stiction_tolerance: v_s in rad/s (m/s), positive.

    Raises:
        ModelError: A number is negative or not positive, or the joints are not names, each once.
    """

    joints: Sequence[str]
    coulomb: ArrayLike = 0.0
    viscous: ArrayLike = 0.0
    stiction_tolerance: float = 0.001

    def __post_init__(self) -> None:
        if not self.joints or len(set(self.joints)) != len(self.joints):
            raise ModelError(
                f"the joints of a friction must be names, each once, got {list(self.joints)}"
            )
        positive("the stiction_tolerance of joints", self.stiction_tolerance)
        super().__post_init__()

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        parameters = []
        for name, unit in (("coulomb", "N m"), ("viscous", "N m s")):
            values = each(f"the {name} friction of joints", getattr(self, name), len(self.joints))
            for joint, value in zip(self.joints, values, strict=True):
                parameters.append(Parameter(f"{joint}.{name}", value, unit, nonnegative=True))
        return tuple(parameters)

    @property
    def dry(self) -> tuple[str, ...]:
        return tuple(f"{joint}.coulomb" for joint in self.joints)

    def reaction(self, kinematics: Kinematics) -> Reaction:
        return Reaction(-ca.mtimes(self.resistance(kinematics), kinematics.v))

    def resistance(self, kinematics: Kinematics) -> ca.SX:
        symbols = {parameter.name: parameter.symbol for parameter in self.parameters}
        size = kinematics.v.numel()
        total = ca.SX(size, size)
        for joint in self.joints:
            i = position_index(kinematics, joint)
            rate = kinematics.value(kinematics.derivative(kinematics.q[i]))
            row = ca.sparsify(ca.simplify(ca.jacobian(rate, kinematics.v)))
            speed = ca.sqrt(rate**2 + self.stiction_tolerance**2)
            factor = symbols[f"{joint}.viscous"] + symbols[f"{joint}.coulomb"] / speed
            total += factor * ca.mtimes(row.T, row)
        return total
