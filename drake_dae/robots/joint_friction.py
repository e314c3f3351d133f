"""Coulomb and viscous friction of joints."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import numbers, positive
from drake_dae.dae import Parameter
from drake_dae.errors import ModelError
from drake_dae.robots.known_forces import Load
from drake_dae.robots.links.kinematics import Kinematics, Reaction, position_index


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
    parameters: tuple[Parameter, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not self.joints or len(set(self.joints)) != len(self.joints):
            raise ModelError(
                f"the joints of a friction must be names, each once, got {list(self.joints)}"
            )
        positive("the stiction_tolerance of joints", self.stiction_tolerance)
        parameters = []
        for name, unit in (("coulomb", "N m"), ("viscous", "N m s")):
            given = numbers(f"the {name} friction of joints", getattr(self, name))
            if given.shape not in ((), (len(self.joints),)):
                raise ModelError(
                    f"the {name} friction must be a number or one for each of the "
                    f"{len(self.joints)} joints, got {given.tolist()}"
                )
            values = np.broadcast_to(given, (len(self.joints),)).tolist()
            parameters += [
                Parameter(f"{joint}.{name}", value, unit, nonnegative=True)
                for joint, value in zip(self.joints, values, strict=True)
            ]
        object.__setattr__(self, "parameters", tuple(parameters))

    @property
    def dry(self) -> tuple[str, ...]:
        return tuple(f"{joint}.coulomb" for joint in self.joints)

    def reaction(self, kinematics: Kinematics) -> Reaction:
        return Reaction(-ca.mtimes(self.resistance(kinematics), kinematics.v))

    def resistance(self, kinematics: Kinematics) -> ca.SX:
        size = kinematics.v.numel()
        total = ca.SX(size, size)
        for joint in self.joints:
            rate, row = self._rate(kinematics, joint)
            factor = self._number(f"{joint}.viscous")
            speed = ca.sqrt(rate**2 + self.stiction_tolerance**2)
            factor += self._number(f"{joint}.coulomb") / speed
            total += factor * ca.mtimes(row.T, row)
        return total

    def _number(self, name: str) -> ca.SX:
        return next(p.symbol for p in self.parameters if p.name == name)

    def _rate(self, kinematics: Kinematics, joint: str) -> tuple[ca.SX, ca.SX]:
        """q_i' of a joint, and its gradient with respect to v, shape (1, nv)."""
        i = position_index(kinematics, joint)
        rate = kinematics.value(kinematics.derivative(kinematics.q[i]))
        return rate, ca.sparsify(ca.simplify(ca.jacobian(rate, kinematics.v)))
