"""The compliance and friction of Drake's own contact."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydrake.geometry import Sphere

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, positive
from drake_dae.dae import Signal
from drake_dae.errors import ModelError
from drake_dae.robots import RobotModel, own_values

FRICTION = Signal("plant.friction")
"""The coefficient of friction of all contacts, among `PointMaterial.signals`."""


@checked(ModelError)
@dataclass(frozen=True)
class PointMaterial:
    """The point contact of a robot's balls with surfaces.

    If the robot tilts by an angle a from its nominal orientation, the ball rolls: it touches at a
    distance 2 radius sin(a / 2) from the point of the constraint, and that point is radius (1 - cos
    a) off the surface. A smaller radius reduces this deviation from ideal contact, a stiffer
    contact does not. A tool that stays normal to its surface does not roll.

    Attributes:
        time_step: The step of the plant in s; 0 for a continuous plant.
        stiffness: The stiffness of point contact, N/m.
        dissipation: The Hunt-Crossley dissipation, s/m.
        friction: The coefficient of friction of all contacts; None for those of the constraints.
        stiction_tolerance: v_s of Drake's regularized friction, m/s. In a continuous plant, fixed
            steps of an explicit scheme must not exceed m v_s / (mu f_n), with the mass m that
            slides and the normal force f_n: the slope of friction over velocity is 15/8 mu f_n /
            v_s, and the velocity of a point that sticks would alternate from step to step. Where
            the steps of a scenario are longer, `analyze` and `simulate` say so.
        radius: The radius of the ball, m.
    """

    time_step: float = 1e-3
    stiffness: float = 1e5
    dissipation: float = 0.0
    friction: float | None = None
    stiction_tolerance: float = 1e-4
    radius: float = 0.01

    def __post_init__(self) -> None:
        for name in ("stiffness", "stiction_tolerance", "radius"):
            positive(name, getattr(self, name))
        for name in ("time_step", "dissipation", "friction"):
            value = getattr(self, name)
            if value is not None and not value >= 0.0:
                raise ModelError(f"{name} must be 0 or more, got {value:g}")

    def stiffness_on(self, model: RobotModel, force: float) -> float:
        """The largest slope, in N/m, of normal force over depth at contacts with this force."""
        return self.stiffness

    @property
    def signals(self) -> tuple[Signal, ...]:
        """Names and units of `values`, named by the keys of a scenario's `plant`."""
        named = {"stiffness": "N/m", "dissipation": "s/m"}
        first = (Signal(f"plant.{name}", unit) for name, unit in named.items())
        return (*first, FRICTION, Signal("plant.radius", "m"))

    @property
    def values(self) -> FloatArray:
        """The numbers that are parameters of a `CompliantPlant`: k, d, mu and the radius."""
        friction = 0.0 if self.friction is None else self.friction
        return np.array([self.stiffness, self.dissipation, friction, self.radius])


@checked(ModelError)
@dataclass(frozen=True)
class ContactMaterial(PointMaterial):
    """The contact model of Drake's MultibodyPlant for a robot, in steps, and as `PointMaterial`.

    The robot touches with a ball; the surfaces are those of its constraints. With point contact the
    force is stiffness times depth. With hydroelastic contact the ball is rigid, and the surface has
    the pressure modulus times depth / thickness; curved surfaces are meshes.

    Attributes:
        contact_model: "point" or "hydroelastic".
        modulus: The hydroelastic modulus, Pa.
        thickness: The thickness of the compliant layer of a plane, m; hydroelastic contact only. A
            sphere is compliant to its center.
        piece: The length of the sides of the piece of an unbounded curved surface that is a solid
            in hydroelastic contact, around the nominal contact point, m.

    Raises:
        ModelError: A number is not valid.
    """

    contact_model: Literal["point", "hydroelastic"] = "point"
    modulus: float = 1e7
    thickness: float = 0.01
    piece: float = 0.4

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("time_step", "modulus", "thickness", "piece"):
            positive(name, getattr(self, name))

    def stiffness_at(self, force: float, sphere: float | None = None) -> float:
        """The slope of the hydroelastic force over depth, in N/m, on a plane or a sphere.

        A ball of radius R, pressed by d into a layer with the pressure E s / h at depth s, has a
        patch of radius sqrt(2 R d): F = pi E R d^2 / h, so k = dF/dd = 2 sqrt(pi E R F / h). In a
        sphere of radius S, whose pressure rises to E at its center, h = S and 1 / R + 1 / S takes
        the place of 1 / R. Drake's mesh of a sphere has edges of about R, so that the contact is
        softer at small depths: by a third at R = 20 mm, S = 100 mm and d = 1 mm.
        """
        bend, depth = 1.0 / self.radius, self.thickness
        if sphere is not None:
            bend, depth = bend + 1.0 / sphere, sphere
        return float(2.0 * np.sqrt(np.pi * self.modulus * force / (bend * depth)))

    def stiffness_on(self, model: RobotModel, force: float) -> float:
        if self.contact_model == "point":
            return self.stiffness
        values = model.dae.parameter_values
        forms = [
            solid.form
            for constraint in model.constraints
            if (surface := constraint.surface_at(own_values(constraint, model.dae, values)))
            for solid in surface.solids()
        ]
        spheres = {form.radius() if isinstance(form, Sphere) else None for form in forms}
        return max(self.stiffness_at(force, sphere) for sphere in spheres or {None})
