"""Contacts of balls with surfaces as expressions, as Drake's point contact defines them."""

from dataclasses import dataclass

import casadi as ca

from drake_dae.errors import ModelError
from drake_dae.robots.constraints.constraint import Constraint, Touch
from drake_dae.robots.model import RobotModel
from drake_dae.trace.smoothness import length_of

TURNS = 4
"""So often the deepest point of a ball is sought, where a distance is exact on the surface alone:
its direction is then wrong by (radius / radius of curvature)^4 of what it was at first."""


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


def ball_normals(model: RobotModel) -> ca.SX:
    """The normals of the surfaces in the frames of their constraints, below each other, (3 k, 1).

    Those of the nominal configuration say where the balls are: there a ball touches at the point of
    its constraint, so that its center is that point plus the radius times the normal.
    """
    both = touching(model)
    return ca.vertcat(*(ca.mtimes(model.links.rotation(t.frame).T, t.normal) for _, t in both))


def point_contacts(
    model: RobotModel, normals: ca.SX, radius: ca.SX, friction: ca.SX | None
) -> list[PointContact]:
    """The contacts of a robot's balls with the surfaces of its constraints.

    Args:
        model: The robot.
        normals: Symbols for the values of `ball_normals` in the nominal configuration.
        radius: The radius of the balls, in m.
        friction: The coefficient of all contacts; None for those of the constraints.
    """
    kinematics, links = model.links.kinematics(), model.links
    found = []
    for i, (constraint, touch) in enumerate(touching(model)):
        point = ca.SX.sym("point", 3)
        arm = radius * ca.mtimes(links.rotation(touch.frame), normals[3 * i : 3 * i + 3])
        ball = links.position(touch.frame, touch.point) + arm
        normal, depth = _overlap(touch, ball, radius)
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


def _overlap(touch: Touch, ball: ca.SX, radius: ca.SX) -> tuple[ca.SX, ca.SX]:
    """The unit normal of the surface and the depth of the overlap of a ball there.

    The distance of a surface may be exact on it alone. Then it is that of the deepest point of the
    ball, p = ball - radius n(p), which is found by repetition.
    """
    place = ca.SX.sym("place", 3)
    clearance = touch.clearance(place)
    slope = ca.gradient(clearance, place)
    if touch.is_exact:
        normal, gap = ca.substitute([slope, clearance], [place], [ball])
        return normal, radius - gap
    slope = slope / length_of(slope)
    normal = ca.substitute(slope, place, ball)
    for _ in range(TURNS):
        normal = ca.substitute(slope, place, ball - radius * normal)
    return normal, -ca.substitute(clearance, place, ball - radius * normal)
