"""Contacts of balls with surfaces: their material, and Drake's laws as expressions."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np
from pydrake.geometry import Sphere

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, positive
from drake_dae.dae import Signal
from drake_dae.errors import ModelError
from drake_dae.robots import Constraint, RobotModel, Touch, own_values
from drake_dae.trace.expressions import as_constant, length_of
from drake_dae.trace.factorization import Factorization, PositiveDefiniteFactorization

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
        spring = Signal("plant.stiffness", "N/m"), Signal("plant.dissipation", "s/m")
        friction = () if self.friction is None else (FRICTION,)
        return (*spring, *friction, Signal("plant.radius", "m"))

    @property
    def values(self) -> FloatArray:
        """The numbers that are parameters of a `CompliantPlant`: k, d, mu if any, the radius."""
        friction = [] if self.friction is None else [self.friction]
        return np.array([self.stiffness, self.dissipation, *friction, self.radius])


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


ITERATIONS = 10
"""The number of Newton steps for the velocities of contacts. A robot in contact needs 3 to 5. Among
random problems far beyond those of robots (W over 2.5 decades, impulses over 6, sliding from 0.1 to
1000 v_s), one contact in 1,000 and one pair in 200 need more."""

SOLVED, AT_REST = 1e-9, 1e-6
"""The allowed residual of these velocities, relative to them, or to AT_REST in m/s if less."""

SOFT = 1e-3
"""Drake's `sigma`: the speed scale of friction relative to the change of speed by an impulse."""

TURNS = 4
"""The number of iterations for the deepest point of a ball, if a distance is exact only on the
surface: they reduce the error of its direction by (radius / radius of curvature)^4."""


@dataclass(frozen=True, eq=False)
class PointContact:
    """The contact of a ball with a surface halfway into their overlap, in the world."""

    depth: ca.SX  # m, negative without contact
    normal: ca.SX  # of the surface, toward the robot
    jacobian: ca.SX  # of the velocity J(q) v of the robot at the point
    velocity: ca.SX  # of the surface there
    friction: ca.SX
    viscous_friction: ca.SX  # N s/m
    stiffness: ca.SX  # k, N/m
    dissipation: ca.SX  # d of Hunt and Crossley, s/m
    stiction_tolerance: float  # v_s, m/s


def touching(model: RobotModel) -> list[tuple[Constraint, Touch]]:
    """The constraints of a robot with their contact points; refuses what is no such contact."""
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


def contact_force_signals(model: RobotModel) -> tuple[Signal, ...]:
    """Names and units of the contact forces F of a robot, shape (3 m,)."""
    names = (f"{each.name}.contact_f{axis}" for each in model.constraints for axis in "xyz")
    return tuple(Signal(name, "N") for name in names)


def ball_normals(model: RobotModel) -> ca.SX:
    """The normals of the surfaces in the frames of their constraints, stacked, shape (3 k, 1).

    A ball's center is the point of its constraint plus the radius times the nominal normal.
    """
    touches = [touch for _, touch in touching(model)]
    return ca.vertcat(*(ca.mtimes(model.links.rotation(t.frame).T, t.normal) for t in touches))


def point_contacts(
    model: RobotModel, normals: ca.SX, numbers: ca.SX, material: PointMaterial
) -> list[PointContact]:
    """The contact of a robot's ball with the surface of each constraint.

    `normals` are the `ball_normals` of the nominal configuration, `numbers` the material's values.
    """
    kinematics, links = model.links.kinematics(), model.links
    stiffness, dissipation, *friction, radius = ca.vertsplit(numbers)
    contacts = []
    for i, (constraint, touch) in enumerate(touching(model)):
        point = ca.SX.sym("point", 3)
        lever = point - kinematics.position(touch.frame, touch.point)
        moving = kinematics.velocity(touch.frame, touch.point)
        moving += ca.cross(kinematics.angular_velocity(touch.frame), lever)
        jacobian = ca.jacobian(kinematics.value(moving), links.v)
        velocity = kinematics.value(touch.velocity(point))
        coefficients = {"friction": ca.SX(0), "viscous_friction": ca.SX(0)}
        for parameter in constraint.parameters:
            coefficients[parameter.name.removeprefix(f"{constraint.name}.")] = parameter.symbol
        (own,) = friction or [coefficients["friction"]]
        arm = ca.mtimes(links.rotation(touch.frame), radius * normals[3 * i : 3 * i + 3])
        ball = links.position(touch.frame, touch.point) + arm
        normal, depth = _overlap(touch, ball, radius)
        contact = ball - normal * (radius - depth / 2)
        moves, drags = ca.substitute([jacobian, velocity], [point], [contact])
        resistance = own, coefficients["viscous_friction"]
        spring = stiffness, dissipation, material.stiction_tolerance
        contacts.append(PointContact(depth, normal, moves, drags, *resistance, *spring))
    return contacts


def _overlap(touch: Touch, ball: ca.SX, radius: ca.SX) -> tuple[ca.SX, ca.SX]:
    """The unit normal of the surface and the depth of a ball there, if need be by iteration."""
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


def contact_force(contact: PointContact, v: ca.SX) -> ca.SX:
    """The force on the robot of a continuous MultibodyPlant, in N, shape (3, 1):

        f_n = k x max(0, 1 + d x'),    f_t = -mu f_n step5(|v_t| / v_s) v_t / |v_t| - c v_t,

    with the depth x > 0 and step5(s) = s^3 (10 - 15 s + 6 s^2) up to s = 1, and 1 beyond. Viscous
    friction c is not Drake's.
    """
    relative = ca.mtimes(contact.jacobian, v) - contact.velocity
    approach, tolerance = -ca.dot(contact.normal, relative), contact.stiction_tolerance
    sliding = relative + contact.normal * approach
    damping = ca.fmax(0, 1 + contact.dissipation * approach)
    push = contact.stiffness * contact.depth * damping
    speed = ca.sqrt(ca.sumsqr(sliding))
    s = speed / tolerance
    slow = s**2 * (10 - 15 * s + 6 * s**2) / tolerance
    slope = ca.if_else(s < 1, slow, 1 / ca.fmax(speed, tolerance))
    traction = slope * sliding
    along = -contact.friction * push * traction - contact.viscous_friction * sliding
    return ca.if_else(contact.depth > 0, contact.normal * push + along, ca.SX(3, 1))


def contact_step(
    contacts: Sequence[PointContact], v: ca.SX, free: ca.SX, mass: ca.SX, h: float
) -> tuple[ca.SX, ca.SX, ca.SX]:
    """The step of a discrete MultibodyPlant with Drake's default, the "lagged" approximation:

        A (v_+ - v*) = J^T gamma(v_c),    v_c = J v_+ - v_surface,
        gamma_n = h (k x - h k v_n)_+ (1 - d v_n)_+,    gamma_t = -mu gamma_0 v_t / |v_t|_s,

    with |v_t|_s = sqrt(|v_t|^2 + e^2), e = max(v_s, sigma mu w gamma_0), and gamma_0 = h k x (1 - d
    v_n0)_+ and x of the state before the step, for contacts with x > 0 there (Castro et al. 2024,
    "Irrotational contact fields"). Drake's solver stops at a relative residual of 1e-6; this one
    solves for v_c to round-off by a primal-dual Newton's method: since p = v_t / |v_t|_s are
    separate unknowns, it also converges if the sliding direction turns (Chan, Golub and Mulet
    1999), with the slope G of the impulses and W = J A^-1 J^T. Velocities and impulses of a contact
    have the normal as their first axis. Only the last step is differentiated, with the velocity
    before it and the matrix as constants: by the implicit function theorem, first derivatives are
    then those of the solution, at a third of the operations.

    Returns v_+ from v before and v* = `free` after a step without contact; the mean forces of the
    contacts on the robot in N; and a number that is negative where they were not found.
    """
    count = len(contacts)
    axes = ca.diagcat(*(_axes(contact.normal) for contact in contacts))
    jacobian = ca.mtimes(axes, ca.vertcat(*(contact.jacobian for contact in contacts)))
    surface = ca.mtimes(axes, ca.vertcat(*(contact.velocity for contact in contacts)))
    before = ca.mtimes(jacobian, v) - surface
    target = ca.mtimes(jacobian, free) - surface
    response = PositiveDefiniteFactorization(mass).solve(jacobian.T)
    delassus = ca.mtimes(jacobian, response)  # W
    laws = [
        _Lagged(contact, of_one, rows, mass, h)
        for contact, of_one, rows in zip(contacts, _each(before), _each(jacobian), strict=True)
    ]

    def impulses(velocity: ca.SX) -> ca.SX:
        return ca.vertcat(
            *(law.impulse(own) for law, own in zip(laws, _each(velocity), strict=True))
        )

    def residual(velocity: ca.SX) -> ca.SX:
        return velocity - target - ca.mtimes(delassus, impulses(velocity))

    velocity = before
    shares = [law.share(own) for law, own in zip(laws, _each(before), strict=True)]
    for remaining in reversed(range(ITERATIONS)):
        now = list(zip(laws, _each(velocity), shares, strict=True))
        slope = ca.diagcat(*(law.slope(own, share) for law, own, share in now))
        matrix = ca.SX.eye(3 * count) - ca.mtimes(delassus, slope)
        if not remaining:
            velocity, matrix = map(as_constant, (velocity, matrix))
            now = list(zip(laws, _each(velocity), shares, strict=True))
        change = _solved(matrix, -residual(velocity))
        shares = [
            law.next_share(own, share, moved)
            for (law, own, share), moved in zip(now, _each(change), strict=True)
        ]
        velocity += change
    slack = SOLVED * ca.fmax(ca.norm_2(target), AT_REST) - ca.norm_2(residual(velocity))
    impulse = impulses(velocity)
    return free + ca.mtimes(response, impulse), ca.mtimes(axes.T, impulse) / h, slack


def _each(stacked: ca.SX) -> list[ca.SX]:
    """The three rows of each contact."""
    parts: list[ca.SX] = ca.vertsplit(stacked, 3)
    return parts


def _axes(normal: ca.SX) -> ca.SX:
    """Orthonormal axes as rows, the unit normal first, without a singular direction.

    Duff et al., "Building an orthonormal basis, revisited", 2017.
    """
    x, y, z = ca.vertsplit(normal)
    sign = ca.copysign(1, z)
    a = -1 / (sign + z)
    b = x * y * a
    first = ca.horzcat(1 + sign * x**2 * a, sign * b, -sign * x)
    return ca.sparsify(ca.vertcat(normal.T, first, ca.horzcat(b, sign + y**2 * a, -y)))


def _solved(matrix: ca.SX, right: ca.SX) -> ca.SX:
    """X of (1 - W G) X = B. For one contact by elimination: it has positive principal minors.

    Since W is positive definite and G has the normal apart from the tangential directions, where
    -G - G^T is positive semidefinite, no pivot is below 1 or, of the last two together, zero.
    """
    if matrix.shape != (3, 3):
        return Factorization(matrix).solve(right)
    first, *factors = ca.vertsplit(matrix[:, 0])
    lower = matrix[1:, 1:] - ca.mtimes(ca.vertcat(*factors) / first, matrix[0, 1:])
    rest = right[1:] - ca.vertcat(*factors) / first * right[0]
    (a, c), (b, d) = (ca.vertsplit(lower[:, j]) for j in range(2))
    last = ca.vertcat(d * rest[0] - b * rest[1], a * rest[1] - c * rest[0]) / (a * d - b * c)
    return ca.vertcat((right[0] - ca.mtimes(matrix[0, 1:], last)) / first, last)


class _Lagged:
    """The impulse of one contact as a function of its velocity, in its axes."""

    def __init__(
        self, contact: PointContact, before: ca.SX, jacobian: ca.SX, mass: ca.SX, h: float
    ) -> None:
        self.contact, self.h = contact, h
        self.elastic = contact.stiffness * ca.fmax(contact.depth, 0)  # k x before the step
        damping = ca.fmax(0, 1 - contact.dissipation * before[0])
        self.lagged = contact.friction * h * self.elastic * damping  # mu gamma_0
        response = ca.mtimes(jacobian / ca.repmat(ca.diag(mass).T, 3, 1), jacobian.T)
        soft = SOFT * ca.norm_fro(response) / 3 * self.lagged
        self.softness = ca.fmax(contact.stiction_tolerance, soft)  # e
        self.viscous = h * contact.viscous_friction * (self.elastic > 0)

    def _size(self, velocity: ca.SX) -> tuple[ca.SX, ca.SX]:
        """v_t and |v_t|_s."""
        sliding = velocity[1:]
        return sliding, ca.sqrt(ca.sumsqr(sliding) + self.softness**2)

    def share(self, velocity: ca.SX) -> ca.SX:
        """p = v_t / |v_t|_s."""
        sliding, size = self._size(velocity)
        return sliding / size

    def next_share(self, velocity: ca.SX, share: ca.SX, change: ca.SX) -> ca.SX:
        """p after a Newton step, with a length of at most 1."""
        sliding, size = self._size(velocity)
        moved = change[1:]
        share_after = (sliding + moved - share * ca.dot(sliding / size, moved)) / size
        return share_after / ca.fmax(1, ca.norm_2(share_after))

    def impulse(self, velocity: ca.SX) -> ca.SX:
        """gamma in N s, shape (3, 1)."""
        along = -self.lagged * self.share(velocity) - self.viscous * velocity[1:]
        return ca.vertcat(self._push(velocity)[0], along)

    def _push(self, velocity: ca.SX) -> tuple[ca.SX, ca.SX]:
        """gamma_n and its derivative."""
        h, k, d, leaving = self.h, self.contact.stiffness, self.contact.dissipation, velocity[0]
        elastic, damping = self.elastic - h * k * leaving, 1 - d * leaving
        touches = (self.elastic > 0) * (elastic > 0) * (damping > 0)
        return touches * h * elastic * damping, -touches * h * (h * k * damping + d * elastic)

    def slope(self, velocity: ca.SX, share: ca.SX) -> ca.SX:
        """The derivative of the impulse, with p in place of one of its directions, shape (3, 3)."""
        sliding, size = self._size(velocity)
        plane = ca.SX.eye(2)
        along = self.lagged / size * (plane - ca.mtimes(share, (sliding / size).T))
        return ca.diagcat(self._push(velocity)[1], -along - self.viscous * plane)
