"""How Drake's own contact gives way and rubs."""

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
    """How Drake's MultibodyPlant shall model the contacts of a robot.

    The robot touches with a ball, and what it touches is as in its constraints. With points the
    force is stiffness times depth; with hydroelastic patches the ball is rigid, and what it touches
    has a pressure of modulus times depth / thickness.

    Where the robot tilts by an angle a from its nominal position, the ball rolls: it touches
    2 radius sin(a / 2) beside the point of the constraint, and that point is radius (1 - cos a)
    off the surface. A stiffer contact does not come nearer to the ideal one there, a smaller
    radius does. A tool that stays normal to its surface does not roll.

    Attributes:
        time_step: The step of the plant, s.
        contact_model: "point" or "hydroelastic".
        stiffness: Of a point contact, N/m.
        modulus: The hydroelastic modulus, Pa.
        thickness: How deep the layer is that gives way, m; hydroelastic contact alone.
        dissipation: Of Hunt and Crossley, s/m.
        friction: The coefficient of friction of all contacts; None for those of the constraints.
        radius: Of the ball, m. It touches the surface where the point of the constraint is while
            the robot holds it as at its nominal positions, and rolls on it otherwise: the
            difference from an ideal contact is proportional to it, whatever the stiffness.

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
    """The properties of what the ball touches."""
    properties = _common_properties(material, friction)
    if material.contact_model == "hydroelastic" and is_half_space:
        AddCompliantHydroelasticPropertiesForHalfSpace(
            material.thickness, material.modulus, properties
        )
    elif material.contact_model == "hydroelastic":
        AddCompliantHydroelasticProperties(material.radius, material.modulus, properties)
    return properties


def _common_properties(material: ContactMaterial, friction: float) -> ProximityProperties:
    properties, rubbing = ProximityProperties(), CoulombFriction(friction, friction)
    # Two equal springs in series have half their stiffness.
    AddContactMaterial(material.dissipation, 2.0 * material.stiffness, rubbing, properties)
    return properties
