"""The springs and dampers of a MultibodyPlant: generalized forces and energies."""

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
from drake_dae.robots.links.plant_frames import PlantFrames, position_of
from drake_dae.trace.expressions import length_of

SUPPORTED_FORCE_ELEMENTS = (
    UniformGravityFieldElement,
    RevoluteSpring,
    PrismaticSpring,
    LinearSpringDamper,
)


def force_elements(plant: MultibodyPlant) -> list[Any]:
    """All force elements of a plant; refuses a type that is not represented."""
    count = plant.num_force_elements()
    elements = [plant.get_force_element(ForceElementIndex(i)) for i in range(count)]
    for element in elements:
        if not isinstance(element, SUPPORTED_FORCE_ELEMENTS):
            names = ", ".join(supported.__name__ for supported in SUPPORTED_FORCE_ELEMENTS)
            raise ModelError(
                f"the plant has a force element of type {type(element).__name__}, which is not "
                f"supported; supported are {names}"
            )
    return elements


class Springs:
    """The springs and dampers of a plant as expressions of q and v.

    Attributes:
        force: The generalized force of joint damping and springs, shape (nv, 1).
        energy: The potential energy of the springs in J, a scalar.
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
        for joint in joints:
            largest = np.max(joint.default_damping_vector(), initial=0.0)
            if largest > LARGEST:
                raise ModelError(
                    f"joint '{joint.name()}' has a damping of {largest:g}, and the largest that "
                    f"can be computed with is {LARGEST:g}"
                )
        damping = np.concatenate([joint.default_damping_vector() for joint in joints])
        self.force, self.energy = -ca.SX(damping) * v, ca.SX(0)
        elements = force_elements(plant)
        for element in elements:
            if isinstance(element, RevoluteSpring):
                stiffness, rest = element.default_stiffness(), element.default_nominal_angle()
            elif isinstance(element, PrismaticSpring):
                stiffness, rest = element.stiffness(), element.nominal_position()
            else:
                continue
            i = element.joint().position_start()
            self.force[i] += stiffness * (rest - q[i])
            self.energy += stiffness / 2 * (rest - q[i]) ** 2
        for spring in (e for e in elements if isinstance(e, LinearSpringDamper)):
            start = position_of(frames.pose(spring.bodyA().body_frame()), spring.p_AP())
            end = position_of(frames.pose(spring.bodyB().body_frame()), spring.p_BQ())
            length = length_of(end - start)
            gradient = ca.jacobian(length, q) @ velocity_map
            tension = spring.stiffness() * (length - spring.free_length())
            tension += spring.damping() * (gradient @ v)
            self.force -= gradient.T @ tension
            self.energy += spring.stiffness() / 2 * (length - spring.free_length()) ** 2
