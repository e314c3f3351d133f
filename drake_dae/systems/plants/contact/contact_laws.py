"""Drake's laws of point contact, continuous and discrete, as expressions."""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from drake_dae.systems.plants.contact.point_contact import PointContact
from drake_dae.trace.expressions import as_constant
from drake_dae.trace.factorization import Factorization, PositiveDefiniteFactorization

ITERATIONS = 10
"""The number of Newton steps for the velocities of contacts. A robot in contact needs 3 to 5. Among
random problems far beyond those of robots (W over 2.5 decades, impulses over 6, sliding from 0.1 to
1000 v_s), one contact in 1,000 and one pair in 200 need more."""

SOLVED = 1e-9
"""The allowed residual of these velocities, relative to the velocities themselves."""

AT_REST = 1e-6
"""Velocities below this, in m/s, count as this large there."""

SOFT = 1e-3
"""Drake's `sigma`: the speed scale of friction relative to the change of speed by an impulse."""


@dataclass(frozen=True, eq=False)
class Compliance:
    """The contact parameters that all contacts of a plant share.

    Attributes:
        stiffness: k in N/m.
        dissipation: d of Hunt and Crossley in s/m.
        stiction_tolerance: v_s in m/s.
    """

    stiffness: ca.SX
    dissipation: ca.SX
    stiction_tolerance: float


def contact_force(contact: PointContact, v: ca.SX, compliance: Compliance) -> ca.SX:
    """The force on the robot of a continuous MultibodyPlant, in N, shape (3, 1):

        f_n = k x max(0, 1 + d x'),    f_t = -mu f_n step5(|v_t| / v_s) v_t / |v_t| - c v_t,

    with the depth x > 0 and step5(s) = s^3 (10 - 15 s + 6 s^2) up to s = 1, and 1 beyond. Viscous
    friction c is not Drake's.

    Args:
        contact: The contact.
        v: The generalized velocities, shape (nv, 1).
        compliance: Its numbers.
    """
    relative = _relative(contact, v)
    sliding, tolerance = contact.along(relative), compliance.stiction_tolerance
    approach = -ca.dot(contact.normal, relative)
    damping = ca.fmax(0, 1 + compliance.dissipation * approach)
    push = compliance.stiffness * contact.depth * damping
    speed = ca.sqrt(ca.sumsqr(sliding))
    s = speed / tolerance
    slow = s**2 * (10 - 15 * s + 6 * s**2) / tolerance
    slope = ca.if_else(s < 1, slow, 1 / ca.fmax(speed, tolerance))
    traction = slope * sliding
    along = -contact.friction * push * traction - contact.viscous_friction * sliding
    return ca.if_else(contact.depth > 0, contact.normal * push + along, ca.SX(3, 1))


def _relative(contact: PointContact, v: ca.SX) -> ca.SX:
    """The velocity of the robot relative to the surface at the contact, m/s, shape (3, 1)."""
    return ca.mtimes(contact.jacobian, v) - contact.velocity


@dataclass(frozen=True, eq=False)
class ContactStep:
    """A step of velocities through contact.

    Attributes:
        velocities: The generalized velocities after the step, shape (nv, 1).
        forces: The mean forces of the contacts on the robot in the step, in N, shape (3 k, 1).
        slack: Negative where Newton's method did not find them.
    """

    velocities: ca.SX
    forces: ca.SX
    slack: ca.SX


def contact_step(
    contacts: Sequence[PointContact],
    v: ca.SX,
    free: ca.SX,
    mass: ca.SX,
    time_step: float,
    compliance: Compliance,
) -> ContactStep:
    """The step of a discrete MultibodyPlant with Drake's default, the "lagged" approximation:

        A (v_+ - v*) = J^T gamma(v_c),    v_c = J v_+ - v_surface,
        gamma_n = h (k x - h k v_n)_+ (1 - d v_n)_+,    gamma_t = -mu gamma_0 v_t / |v_t|_s,

    with |v_t|_s = sqrt(|v_t|^2 + e^2), e = max(v_s, sigma mu w gamma_0), and gamma_0 = h k x (1 - d
    v_n0)_+ and x of the state before the step, for contacts with x > 0 there (Castro et al. 2024,
    "Irrotational contact fields"). Drake's solver stops at a relative residual of 1e-6; this one
    solves for v_c to round-off by a primal-dual Newton's method: since p = v_t / |v_t|_s are
    separate unknowns, it also converges if the sliding direction turns (Chan, Golub and Mulet
    1999). Velocities and impulses of a contact have the normal as their first axis. For n
    velocities of joints it solves n equations if these are fewer than the 3 k of the contacts: with
    the slope G of the impulses and W = J A^-1 J^T

        (1 - W G)^-1 = 1 + J (A - J^T G J)^-1 J^T G.

    Only the last step is differentiated, with the velocity before it and the matrix as
    constants: by the implicit function theorem, first derivatives are then those of the solution,
    at a third of the operations.

    Args:
        contacts: The contacts.
        v: The velocities before the step.
        free: v*, the velocities after a step without contact.
        mass: A = M + h D, with the damping D of the joints.
        time_step: h in s.
        compliance: The numbers of the contacts.
    """
    h, count = time_step, len(contacts)
    factored = PositiveDefiniteFactorization(mass)
    axes = ca.diagcat(*(_axes(contact.normal) for contact in contacts))
    jacobian = ca.mtimes(axes, ca.vertcat(*(contact.jacobian for contact in contacts)))
    response = factored.solve(jacobian.T)
    is_reduced = 3 * count > v.numel()
    delassus = None if is_reduced else ca.mtimes(jacobian, response)
    surface = ca.mtimes(axes, ca.vertcat(*(contact.velocity for contact in contacts)))
    before = ca.mtimes(jacobian, v) - surface
    target = ca.mtimes(jacobian, free) - surface
    parts = [slice(3 * i, 3 * i + 3) for i in range(count)]
    laws = [
        (p, _Lagged.of(contact, before[p], jacobian[p, :], mass, h, compliance))
        for p, contact in zip(parts, contacts, strict=True)
    ]

    def impulses(velocity: ca.SX) -> ca.SX:
        return ca.vertcat(*(law.impulse(velocity[p]) for p, law in laws))

    def residual(velocity: ca.SX) -> ca.SX:
        gamma = impulses(velocity)
        moved = ca.mtimes(response, gamma)
        changed = ca.mtimes(jacobian, moved) if is_reduced else ca.mtimes(delassus, gamma)
        return velocity - target - changed

    velocity = before
    shares = [law.share(before[p]) for p, law in laws]
    for remaining in reversed(range(ITERATIONS)):
        slopes = (
            law.slope(velocity[p], share) for (p, law), share in zip(laws, shares, strict=True)
        )
        slope = ca.diagcat(*slopes)
        if is_reduced:
            matrix = mass - ca.mtimes([jacobian.T, slope, jacobian])
        else:
            matrix = ca.SX.eye(3 * count) - ca.mtimes(delassus, slope)
        if not remaining:
            velocity, matrix, slope = map(as_constant, (velocity, matrix, slope))
        change = -residual(velocity)
        if is_reduced:
            pushed = ca.mtimes([jacobian.T, slope, change])
            change += ca.mtimes(jacobian, Factorization(matrix).solve(pushed))
        else:
            change = _solved(matrix, change)
        shares = [
            law.next_share(velocity[p], share, change[p])
            for (p, law), share in zip(laws, shares, strict=True)
        ]
        velocity += change
    slack = SOLVED * ca.fmax(ca.norm_2(target), AT_REST) - ca.norm_2(residual(velocity))
    impulse = impulses(velocity)
    forces = ca.mtimes(axes.T, impulse) / h
    return ContactStep(free + ca.mtimes(response, impulse), forces, slack)


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


@dataclass(frozen=True, eq=False)
class _Lagged:
    """The impulse of one contact as a function of its velocity, in its axes."""

    viscous: ca.SX
    elastic: ca.SX
    lagged: ca.SX
    softness: ca.SX
    time_step: float
    compliance: Compliance

    @classmethod
    def of(
        cls,
        contact: PointContact,
        before: ca.SX,
        jacobian: ca.SX,
        mass: ca.SX,
        h: float,
        compliance: Compliance,
    ) -> "_Lagged":
        """The impulse, with constants from the state before the step.

        Args:
            contact: The contact.
            before: Its velocity before the step, in its axes.
            jacobian: J, in these axes.
            mass, h, compliance: As of `contact_step`.
        """
        elastic = compliance.stiffness * ca.fmax(contact.depth, 0)
        damping = ca.fmax(0, 1 - compliance.dissipation * before[0])
        lagged = contact.friction * h * elastic * damping
        response = ca.mtimes(jacobian / ca.repmat(ca.diag(mass).T, 3, 1), jacobian.T)
        softness = ca.fmax(compliance.stiction_tolerance, SOFT * ca.norm_fro(response) / 3 * lagged)
        viscous = h * contact.viscous_friction * (elastic > 0)
        return cls(viscous, elastic, lagged, softness, h, compliance)

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
        h, k, d = self.time_step, self.compliance.stiffness, self.compliance.dissipation
        leaving = velocity[0]
        elastic, damping = self.elastic - h * k * leaving, 1 - d * leaving
        touches = (self.elastic > 0) * (elastic > 0) * (damping > 0)
        return touches * h * elastic * damping, -touches * h * (h * k * damping + d * elastic)

    def slope(self, velocity: ca.SX, share: ca.SX) -> ca.SX:
        """The derivative of the impulse, with p in place of one of its directions, shape (3, 3)."""
        sliding, size = self._size(velocity)
        plane = ca.SX.eye(2)
        along = self.lagged / size * (plane - ca.mtimes(share, (sliding / size).T))
        return ca.diagcat(self._push(velocity)[1], -along - self.viscous * plane)
