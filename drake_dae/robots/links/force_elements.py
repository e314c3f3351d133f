"""The springs and dampers of a MultibodyPlant.

Each has a generalized force and an energy. A new kind of force element is added only here.
"""

from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    ForceElementIndex,
    Joint,
    LinearSpringDamper,
    PrismaticSpring,
    RevoluteSpring,
    UniformGravityFieldElement,
)

from drake_dae.dae.signals import LARGEST
from drake_dae.errors import ModelError
from drake_dae.robots.links.frames import PlantFrames, position_of
from drake_dae.trace.expressions import length_of

SUPPORTED_FORCE_ELEMENTS = (
    UniformGravityFieldElement,
    RevoluteSpring,
    PrismaticSpring,
    LinearSpringDamper,
)


def force_elements(plant: MultibodyPlant) -> list[Any]:
    """All force elements of a plant; the field of gravity is the first."""
    count = plant.num_force_elements()
    return [plant.get_force_element(ForceElementIndex(i)) for i in range(count)]


def check_force_elements(plant: MultibodyPlant) -> None:
    """Refuses a plant with a force element that is not represented.

    Raises:
        ModelError: The plant has one, whose type the message names.
    """
    for element in force_elements(plant):
        if not isinstance(element, SUPPORTED_FORCE_ELEMENTS):
            names = ", ".join(supported.__name__ for supported in SUPPORTED_FORCE_ELEMENTS)
            raise ModelError(
                f"the plant has a force element of type {type(element).__name__}, which is not "
                f"supported; supported are {names}"
            )


class Springs:
    """The springs and dampers of a plant as expressions.

    Args:
        plant: One that `check_force_elements` accepts.
        joints: The joints that move, in the order of q and v.
        frames: The plant's frames.
        q, v: Positions and velocities, shapes (nq, 1) and (nv, 1).
        velocity_map: N, shape (nq, nv).
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        joints: list[Joint],
        frames: PlantFrames,
        q: ca.SX,
        v: ca.SX,
        velocity_map: ca.SX,
    ) -> None:
        self._elements = force_elements(plant)
        self._damping = np.concatenate([joint.default_damping_vector() for joint in joints])
        for joint in joints:
            largest = np.max(joint.default_damping_vector(), initial=0.0)
            if largest > LARGEST:
                raise ModelError(
                    f"joint '{joint.name()}' has a damping of {largest:g}, and the largest that "
                    f"can be computed with is {LARGEST:g}"
                )
        self._frames = frames
        self._q, self._v, self._velocity_map = q, v, velocity_map

    @cached_property
    def force(self) -> ca.SX:
        """The generalized force of joint damping and springs, shape (nv, 1)."""
        force = -ca.SX(self._damping) * self._v
        for i, stiffness, nominal in self._in_joints:
            force[i] += stiffness * (nominal - self._q[i])
        for spring, length in self._between_points:
            gradient = ca.jacobian(length, self._q) @ self._velocity_map
            tension = spring.stiffness() * (length - spring.free_length())
            tension += spring.damping() * (gradient @ self._v)
            force -= gradient.T @ tension
        return force

    @property
    def energy(self) -> ca.SX:
        """The potential energy of the springs in J, a scalar."""
        energy = ca.SX(0)
        for i, stiffness, nominal in self._in_joints:
            energy += stiffness / 2 * (nominal - self._q[i]) ** 2
        for spring, length in self._between_points:
            energy += spring.stiffness() / 2 * (length - spring.free_length()) ** 2
        return energy

    @cached_property
    def _in_joints(self) -> list[tuple[int, float, float]]:
        """The index in q and v, stiffness, and nominal position of every spring in a joint."""
        springs = []
        for element in self._elements:
            if isinstance(element, RevoluteSpring):
                stiffness, nominal = element.default_stiffness(), element.default_nominal_angle()
                springs.append((element.joint().position_start(), stiffness, nominal))
            if isinstance(element, PrismaticSpring):
                stiffness, nominal = element.stiffness(), element.nominal_position()
                springs.append((element.joint().position_start(), stiffness, nominal))
        return springs

    @cached_property
    def _between_points(self) -> list[tuple[LinearSpringDamper, ca.SX]]:
        """Every spring between two points, and its length in m."""
        springs = []
        for element in self._elements:
            if isinstance(element, LinearSpringDamper):
                start = self._frames.pose(element.bodyA().body_frame())
                end = self._frames.pose(element.bodyB().body_frame())
                apart = position_of(end, element.p_BQ()) - position_of(start, element.p_AP())
                springs.append((element, length_of(apart)))
        return springs
