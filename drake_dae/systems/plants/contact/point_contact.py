"""Contacts of balls with surfaces as expressions, as Drake's point contact defines them."""

from dataclasses import dataclass

import casadi as ca

from drake_dae.errors import ModelError
from drake_dae.robots import Constraint, RobotModel, Touch
from drake_dae.trace.expressions import length_of

TURNS = 4
"""The number of iterations for the deepest point of a ball, if a distance is exact only on the
surface: they reduce the error of its direction by (radius / radius of curvature)^4."""


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
    contacts = []
    for constraint in model.constraints:
        touch = constraint.touch(model.links)
        if touch is None:
            raise ModelError(
                f"'{constraint.name}' is no contact of a point with a surface, so it cannot be "
                "compliant: take an ideal plant, or a PointOnSurface"
            )
        contacts.append((constraint, touch))
    return contacts


def ball_normals(model: RobotModel) -> ca.SX:
    """The normals of the surfaces in the frames of their constraints, stacked, shape (3 k, 1).

    Those of the nominal configuration determine the balls: there a ball touches at the point of its
    constraint, so that its center is that point plus the radius times the normal.
    """
    touches = [touch for _, touch in touching(model)]
    return ca.vertcat(*(ca.mtimes(model.links.rotation(t.frame).T, t.normal) for t in touches))


def point_contacts(
    model: RobotModel,
    normals: ca.SX,
    radius: ca.SX,
    friction: ca.SX | None,
) -> list[PointContact]:
    """The contact of a robot's ball with the surface of each constraint.

    Args:
        model: The robot.
        normals: Symbols for the values of `ball_normals` in the nominal configuration.
        radius: The radius of the balls, in m.
        friction: The coefficient of all contacts; None for those of the constraints.
    """
    kinematics, links = model.links.kinematics(), model.links
    contacts = []
    for i, (constraint, touch) in enumerate(touching(model)):
        point = ca.SX.sym("point", 3)
        lever = point - kinematics.position(touch.frame, touch.point)
        moving = kinematics.velocity(touch.frame, touch.point)
        moving += ca.cross(kinematics.angular_velocity(touch.frame), lever)
        jacobian = ca.jacobian(kinematics.value(moving), links.v)
        velocity = kinematics.value(touch.velocity(point))
        parameters = {
            p.name.removeprefix(f"{constraint.name}."): p.symbol for p in constraint.parameters
        }
        coefficient = parameters.get("friction", ca.SX(0)) if friction is None else friction
        viscous = parameters.get("viscous_friction", ca.SX(0))
        arm = radius * normals[3 * i : 3 * i + 3]
        ball = links.position(touch.frame, touch.point) + ca.mtimes(
            links.rotation(touch.frame), arm
        )
        normal, depth = _overlap(touch, ball, radius)
        contact = ball - normal * (radius - depth / 2)
        moves, drags = ca.substitute([jacobian, velocity], [point], [contact])
        contacts.append(PointContact(depth, normal, moves, drags, coefficient, viscous))
    return contacts


def _overlap(touch: Touch, ball: ca.SX, radius: ca.SX) -> tuple[ca.SX, ca.SX]:
    """The unit normal of the surface and the depth of the overlap of a ball there.

    If the distance is exact only on the surface, the depth is that of the deepest point of the
    ball, p = ball - radius n(p), by fixed-point iteration.
    """
    point = ca.SX.sym("point", 3)
    clearance = touch.clearance(point)
    slope = ca.gradient(clearance, point)
    if touch.is_exact:
        normal, gap = ca.substitute([slope, clearance], [point], [ball])
        return normal, radius - gap
    slope = slope / length_of(slope)
    normal = ca.substitute(slope, point, ball)
    for _ in range(TURNS):
        normal = ca.substitute(slope, point, ball - radius * normal)
    return normal, -ca.substitute(clearance, point, ball - radius * normal)
