"""The compliance and friction of Drake's own contact."""

from dataclasses import dataclass
from typing import Literal

from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddCompliantHydroelasticPropertiesForHalfSpace,
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    ProximityProperties,
)
from pydrake.multibody.plant import CoulombFriction

from drake_dae.arguments import checked
from drake_dae.arrays import positive
from drake_dae.errors import ModelError


@checked(ModelError)
@dataclass(frozen=True)
class ContactMaterial:
    """The contact model of Drake's MultibodyPlant for a robot.

    The robot touches with a ball; the surfaces are those of its constraints. With point contact the
    force is stiffness times depth. With hydroelastic contact the ball is rigid, and the surface has
    the pressure modulus times depth / thickness.

    If the robot tilts by an angle a from its nominal orientation, the ball rolls: it touches at a
    distance 2 radius sin(a / 2) from the point of the constraint, and that point is radius (1 - cos
    a) off the surface. This deviation from ideal contact is reduced by a smaller radius, not by a
    stiffer contact. A tool that stays normal to its surface does not roll.

    Attributes:
        time_step: The step of the plant, s.
        contact_model: "point" or "hydroelastic".
        stiffness: The stiffness of point contact, N/m.
        modulus: The hydroelastic modulus, Pa.
        thickness: The thickness of the compliant layer, m; hydroelastic contact only.
        dissipation: The Hunt-Crossley dissipation, s/m.
        friction: The coefficient of friction of all contacts; None for those of the constraints.
        radius: The radius of the ball, m. In the nominal orientation it touches at the point of the
            constraint; otherwise it rolls, with a deviation from ideal contact proportional to the
            radius.

    Raises:
        ModelError: A number makes no sense.
    """

    time_step: float = 1e-3
    contact_model: Literal["point", "hydroelastic"] = "point"
    stiffness: float = 1e5
    modulus: float = 1e7
    thickness: float = 0.01
    dissipation: float = 0.0
    friction: float | None = None
    radius: float = 0.01

    def __post_init__(self) -> None:
        for name in ("time_step", "stiffness", "modulus", "thickness", "radius"):
            positive(name, getattr(self, name))
        for name in ("dissipation", "friction"):
            value = getattr(self, name)
            if value is not None and not value >= 0.0:
                raise ModelError(f"{name} must be 0 or more, got {value:g}")


def ball_properties(material: ContactMaterial, friction: float) -> ProximityProperties:
    """The properties of the ball."""
    properties = _common_properties(material, friction)
    if material.contact_model == "hydroelastic":
        AddRigidHydroelasticProperties(material.radius / 8.0, properties)
    return properties


def surface_properties(
    material: ContactMaterial, friction: float, is_half_space: bool
) -> ProximityProperties:
    """The properties of the surface."""
    properties = _common_properties(material, friction)
    if material.contact_model == "hydroelastic" and is_half_space:
        AddCompliantHydroelasticPropertiesForHalfSpace(
            material.thickness, material.modulus, properties
        )
    elif material.contact_model == "hydroelastic":
        AddCompliantHydroelasticProperties(material.radius, material.modulus, properties)
    return properties


def _common_properties(material: ContactMaterial, friction: float) -> ProximityProperties:
    properties, frictional = ProximityProperties(), CoulombFriction(friction, friction)
    # Two equal springs in series have half their stiffness.
    AddContactMaterial(material.dissipation, 2.0 * material.stiffness, frictional, properties)
    return properties
