"""Contacts of balls with surfaces as expressions, as Drake's point contact defines them."""

from dataclasses import dataclass

import casadi as ca

from drake_dae.arrays import FloatArray
from drake_dae.dae.structure.constrained import ConstraintStructure
from drake_dae.errors import ModelError
from drake_dae.robots.constraints.constraint import Constraint, Touch
from drake_dae.robots.model import RobotModel


@dataclass(frozen=True, eq=False)
class PointContact:
    """The contact of a ball of a robot with a surface, at the point halfway into their overlap.

    Attributes:
        depth: The depth of the overlap in m, negative without contact.
        normal: The unit normal of the surface, toward the robot, in the world, shape (3, 1).
        jacobian: J of the velocity J(q) v of the robot at the point, in the world, shape (3, nv).
        velocity: The velocity of the surface at the point in m/s, in the world, shape (3, 1).
        friction: The coefficient of friction.
        viscous_friction: The coefficient of viscous friction in N s/m.
    """

    depth: ca.SX
    normal: ca.SX
    jacobian: ca.SX
    velocity: ca.SX
    friction: ca.SX
    viscous_friction: ca.SX

    def along(self, velocity: ca.SX) -> ca.SX:
        """The part of a velocity along the surface, shape (3, 1)."""
        return velocity - self.normal * ca.dot(self.normal, velocity)


def touching(model: RobotModel) -> list[tuple[Constraint, Touch]]:
    """The constraints of a robot with their contact points.

    Raises:
        ModelError: It has none, or one that is no contact of a point with a surface.
    """
    if not model.constraints:
        raise ModelError("the robot has no constraints, so there is nothing to touch")
    found = []
    for constraint in model.constraints:
        touch = constraint.touch(model.links)
        if touch is None:
            raise ModelError(
                f"'{constraint.name}' is no contact of a point with a surface, so it cannot be "
                "compliant: take an ideal plant, or a PointOnSurface"
            )
        found.append((constraint, touch))
    return found


def ball_normals(
    model: RobotModel, structure: ConstraintStructure, values: FloatArray
) -> FloatArray:
    """The normals of the surfaces in the frames of their constraints, below each other, (3 k,).

    They are those of the nominal configuration, where a ball touches at the point of its
    constraint: its center is that point plus the radius times the normal.

    Args:
        model: The robot.
        structure: The structure of its system.
        values: The values of all parameters.
    """
    both = touching(model)
    normals = [ca.mtimes(model.links.rotation(t.frame).T, t.normal) for _, t in both]
    function = model.dae.trace("normals", {"normals": ca.vertcat(*normals)}, often=False)
    state = structure.manifold.project(model.dae.nominal_state, values)
    return function(state, values)[0]


def point_contacts(
    model: RobotModel, normals: ca.SX, radius: ca.SX, friction: ca.SX | None
) -> list[PointContact]:
    """The contacts of a robot's balls with the surfaces of its constraints.

    Args:
        model: The robot.
        normals: What `ball_normals` returns, as symbols.
        radius: The radius of the balls, in m.
        friction: The coefficient of all contacts; None for those of the constraints.
    """
    kinematics, links = model.links.kinematics(), model.links
    found = []
    for i, (constraint, touch) in enumerate(touching(model)):
        place, point = ca.SX.sym("place", 3), ca.SX.sym("point", 3)
        arm = radius * ca.mtimes(links.rotation(touch.frame), normals[3 * i : 3 * i + 3])
        ball = links.position(touch.frame, touch.point) + arm
        clearance = touch.clearance(place)
        normal, gap = ca.substitute([ca.gradient(clearance, place), clearance], [place], [ball])
        depth = radius - gap
        contact = ball - normal * (radius - depth / 2)
        lever = point - kinematics.position(touch.frame, touch.point)
        moving = kinematics.velocity(touch.frame, touch.point)
        moving += ca.cross(kinematics.angular_velocity(touch.frame), lever)
        jacobian = ca.jacobian(kinematics.value(moving), links.v)
        velocity = kinematics.value(touch.velocity(point))
        jacobian, velocity = ca.substitute([jacobian, velocity], [point], [contact])
        own = {p.name.removeprefix(f"{constraint.name}."): p.symbol for p in constraint.parameters}
        coefficient = own.get("friction", ca.SX(0)) if friction is None else friction
        viscous = own.get("viscous_friction", ca.SX(0))
        found.append(PointContact(depth, normal, jacobian, velocity, coefficient, viscous))
    return found
