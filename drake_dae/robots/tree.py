"""A tree of links, each with its own frame, its inertia and one elementary joint to its parent.

Its algorithms are the composite rigid body algorithm and the recursive Newton-Euler algorithm in
link frames (Featherstone, Rigid Body Dynamics Algorithms, 2008, chapters 5 and 6). P is the frame
of a link's parent, L its own, W the world's. Quantities of a link are expressed in L unless said
otherwise. A link moves by one elementary joint, so that its rotation is sparse; a joint with
several is a chain of links, of which the last carries the inertia.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class ElementaryJoint:
    """X_FM(q), a rotation about an axis of F or a translation; a joint is a chain of these."""

    axis: int | None  # Of the turn, 0, 1 or 2; None for a shift.
    positions: tuple[int, ...]  # In q: of the angle, or of the lengths along `directions`.
    velocities: tuple[int, ...]  # In v, one for each column of `directions`.
    directions: FloatArray  # (Angular) velocity of M in F for a unit of each of them, (3, k).


@dataclass(eq=False)
class Inertia:
    """Mass, and the integrals of r dm and r r^T dm about an origin."""

    mass: ca.SX = field(default_factory=lambda: ca.SX.zeros(1))
    first: ca.SX = field(default_factory=lambda: ca.SX.zeros(3))
    second: ca.SX = field(default_factory=lambda: ca.SX.zeros(3, 3))

    def __add__(self, other: "Inertia") -> "Inertia":
        return Inertia(self.mass + other.mass, self.first + other.first, self.second + other.second)


@dataclass(eq=False)
class TreeLink:
    """A frame that one elementary joint moves, with the inertia of the bodies fixed to it."""

    parent: int = -1  # Of the world, which is link 0.
    fixed: FloatArray = field(default_factory=lambda: np.eye(3))  # R_PF, where the joint starts.
    axis: int | None = None  # Of the turn, 0, 1 or 2; None for a shift.
    turn: ca.SX = field(default_factory=lambda: ca.SX.eye(3))  # R_FL(q)
    offset: ca.SX = field(default_factory=lambda: ca.SX.zeros(3))  # p_PL in P
    turning: dict[int, ca.SX] = field(default_factory=dict)  # Index in v -> w in L of a unit.
    shifting: dict[int, ca.SX] = field(default_factory=dict)  # ... -> velocity of L's origin in P.
    inertia: Inertia = field(default_factory=Inertia)  # About L's origin.
    weightless: Inertia = field(default_factory=Inertia)  # What gravity does not act on.

    def __post_init__(self) -> None:
        self.rotation = ca.densify(ca.SX(self.fixed) @ self.turn)

    @classmethod
    def moved(
        cls, parent: int, fixed: FloatArray, offset: FloatArray, joint: ElementaryJoint, q: ca.SX
    ) -> "TreeLink":
        """A link without inertia that `joint` moves, starting at a constant pose in P."""
        if joint.axis is None:
            directions = ca.SX(fixed @ joint.directions)
            lengths = ca.vertcat(*[q[i] for i in joint.positions])
            shifting = {j: directions[:, c] for c, j in enumerate(joint.velocities)}
            moved = ca.SX(offset) + directions @ lengths
            return cls(parent, fixed, offset=moved, shifting=shifting)
        i, j = (joint.axis + 1) % 3, (joint.axis + 2) % 3
        s, c = ca.sin(q[joint.positions[0]]), ca.cos(q[joint.positions[0]])
        turn = ca.SX.eye(3)
        turn[i, i], turn[i, j], turn[j, i], turn[j, j] = c, -s, s, c
        directions = turn.T @ ca.SX(joint.directions)
        turning = {j: ca.densify(directions[:, c]) for c, j in enumerate(joint.velocities)}
        return cls(parent, fixed, joint.axis, turn, ca.SX(offset), turning)

    def force_to_parent(self, moment: ca.SX, force: ca.SX) -> tuple[ca.SX, ca.SX]:
        """A moment about L's origin and a force, transformed to P's origin and axes."""
        force = self.rotation @ force
        return self.rotation @ moment + ca.cross(self.offset, force), force

    def generalized_force(self, moment: ca.SX, force: ca.SX) -> list[tuple[int, ca.SX]]:
        """The generalized force of a wrench at L's origin: (index in v, component) pairs."""
        turning = [(j, ca.dot(d, moment)) for j, d in self.turning.items()]
        return turning + [(j, ca.dot(self.rotation.T @ d, force)) for j, d in self.shifting.items()]

    def inertia_to_parent(self, inertia: Inertia) -> Inertia:
        """An inertia in L, transformed to P's origin and axes."""
        first = self.rotation @ inertia.first
        second = symmetric(self.to_parent_axes(inertia.second))
        half = first + inertia.mass / 2 * self.offset
        outer = self.offset @ half.T
        return Inertia(
            inertia.mass, first + inertia.mass * self.offset, second + symmetric(outer + outer.T)
        )

    def to_parent_axes(self, matrix: ca.SX) -> ca.SX:
        """A symmetric matrix in L, shape (3, 3), in the axes of P.

        turn matrix turn^T takes 16 operations here, and 75 as products.
        """
        turned = ca.SX(matrix)
        if self.axis is not None:
            k, i, j = self.axis, (self.axis + 1) % 3, (self.axis + 2) % 3
            s, c = self.turn[j, i], self.turn[i, i]
            g = s * (matrix[i, i] - matrix[j, j]) + 2 * c * matrix[i, j]
            turned[i, i] = matrix[i, i] - s * g
            turned[j, j] = matrix[j, j] + s * g
            turned[i, j] = turned[j, i] = c * g - matrix[i, j]
            turned[i, k] = turned[k, i] = c * matrix[i, k] - s * matrix[j, k]
            turned[j, k] = turned[k, j] = s * matrix[i, k] + c * matrix[j, k]
        fixed = ca.SX(self.fixed)
        return fixed @ turned @ fixed.T


def link_poses(links: Sequence[TreeLink]) -> list[tuple[ca.SX, ca.SX]]:
    """R_WL, shape (3, 3), and p_WL in m, shape (3, 1), of every link."""
    poses = [(ca.SX(np.eye(3)), ca.SX.zeros(3))]
    for link in links[1:]:
        rotation, origin = poses[link.parent]
        poses.append((rotation @ link.rotation, origin + rotation @ link.offset))
    return poses


def symmetric(matrix: ca.SX) -> ca.SX:
    """The lower triangle mirrored: equal entries become one expression."""
    return ca.tril2symm(ca.tril(matrix))


def mass_matrix(links: Sequence[TreeLink], reflected_inertia: FloatArray) -> ca.SX:
    """M, shape (nv, nv), by the composite rigid body algorithm; rotors add to its diagonal."""
    M = ca.SX(ca.diag(reflected_inertia))
    composite = [link.inertia for link in links]
    for index in range(len(links) - 1, 0, -1):
        link, inertia = links[index], composite[index]
        composite[link.parent] += link.inertia_to_parent(inertia)
        columns = []
        for j, direction in link.turning.items():
            moment = ca.trace(inertia.second) * direction - inertia.second @ direction
            columns.append((j, moment, ca.cross(direction, inertia.first)))
        for j, direction in link.shifting.items():
            direction = link.rotation.T @ direction
            columns.append((j, ca.cross(inertia.first, direction), inertia.mass * direction))
        for j, moment, force in columns:
            at = link
            while at.parent >= 0:
                for i, entry in at.generalized_force(moment, force):
                    M[i, j] += entry
                    if at is not link:
                        M[j, i] += entry
                moment, force = at.force_to_parent(moment, force)
                at = links[at.parent]
    return ca.sparsify(symmetric(M))


def frame_jacobian(
    links: Sequence[TreeLink],
    poses: Sequence[tuple[ca.SX, ca.SX]],
    index: int,
    origin: ca.SX,
    size: int,
) -> ca.SX:
    """The velocity of a link's point above its spin in the world, per unit of v, shape (6, nv)."""
    result = ca.SX(6, size)
    while index > 0:
        link, (rotation, position) = links[index], poses[index]
        for j, direction in link.turning.items():
            axis = rotation @ direction
            result[:, j] += ca.vertcat(ca.cross(axis, origin - position), axis)
        for j, direction in link.shifting.items():
            result[:3, j] += poses[link.parent][0] @ direction
        index = link.parent
    return result


@dataclass(frozen=True, eq=False)
class LinkMotion:
    """The motion of a link, in its own axes; a point r has `acceleration` + gradient r."""

    spin: ca.SX
    spin_rate: ca.SX
    velocity: ca.SX  # Of the origin.
    acceleration: ca.SX  # Of the origin, minus gravity.
    gradient: ca.SX  # Shape (3, 3).


def link_motions(
    links: Sequence[TreeLink], v: ca.SX, acceleration: ca.SX, gravity: FloatArray
) -> list[LinkMotion]:
    """The motion of every link, with v' = `acceleration`; gravity is in the world, in m/s^2."""
    zero = ca.SX.zeros(3)
    result = [LinkMotion(zero, zero, zero, ca.SX(-gravity), ca.SX.zeros(3, 3))]
    for link in links[1:]:
        parent, to_link = result[link.parent], link.rotation.T
        turning, turning_rate, shifting, shifting_rate = (
            sum((rates[j] * d for j, d in directions.items()), ca.SX.zeros(3))
            for directions in (link.turning, link.shifting)
            for rates in (v, acceleration)
        )
        carried = to_link @ parent.spin
        spin = carried + turning
        spin_rate = to_link @ parent.spin_rate + ca.cross(carried, turning) + turning_rate
        velocity = parent.velocity + ca.cross(parent.spin, link.offset) + shifting
        moved = parent.gradient @ link.offset + 2 * ca.cross(parent.spin, shifting) + shifting_rate
        outer = symmetric(spin @ spin.T)
        result.append(
            LinkMotion(
                spin,
                spin_rate,
                to_link @ velocity,
                to_link @ (parent.acceleration + moved),
                ca.skew(spin_rate) + outer - ca.trace(outer) * ca.SX.eye(3),
            )
        )
    return result


def inverse_dynamics(
    links: Sequence[TreeLink],
    moving: Sequence[LinkMotion],
    gravity: FloatArray,
    size: int,
    wrenches: Mapping[int, tuple[ca.SX, ca.SX]] = MappingProxyType({}),
) -> ca.SX:
    """Generalized forces, shape (nv, 1), by the recursive Newton-Euler algorithm; `size` is nv.

    `wrenches` are index of a link -> moment about its origin and force on it, in its axes.
    """
    tau = ca.SX.zeros(size)
    moments, forces = [ca.SX.zeros(3) for _ in links], [ca.SX.zeros(3) for _ in links]
    poses = link_poses(links)
    for index in range(len(links) - 1, 0, -1):
        link, inertia, weightless = links[index], links[index].inertia, links[index].weightless
        acceleration, gradient = moving[index].acceleration, moving[index].gradient
        T = gradient @ inertia.second
        force = forces[index] + inertia.mass * acceleration + gradient @ inertia.first
        moment = moments[index] + ca.cross(inertia.first, acceleration)
        moment += ca.vertcat(T[2, 1] - T[1, 2], T[0, 2] - T[2, 0], T[1, 0] - T[0, 1])
        if not weightless.mass.is_zero():
            lift = poses[index][0].T @ ca.SX(gravity)
            force += weightless.mass * lift
            moment += ca.cross(weightless.first, lift)
        if index in wrenches:
            moment, force = moment - wrenches[index][0], force - wrenches[index][1]
        for j, entry in link.generalized_force(moment, force):
            tau[j] += entry
        moment, force = link.force_to_parent(moment, force)
        moments[link.parent] += moment
        forces[link.parent] += force
    return tau
