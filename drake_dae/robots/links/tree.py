"""Recursive algorithms on a tree of links, each in its own frame (Featherstone 2008, ch. 5, 6).

Frame names: P is the frame of a link's parent, L its own, W the world's. Quantities of a link are
expressed in L unless said otherwise. A link moves by one elementary motion, so that its rotation
is sparse; a joint with several is a chain of links, of which the last carries the inertia.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray


def _zero(rows: int, columns: int = 1) -> ca.SX:
    return ca.SX.zeros(rows, columns)


@dataclass(frozen=True, eq=False)
class Motion:
    """An elementary motion X_FM(q): a turn about a coordinate axis of F, or a shift.

    A joint is a sequence of these; each starts from the frame where the one before ends.

    Attributes:
        axis: The coordinate axis of the turn (0, 1, 2), or None for a shift.
        positions: Indices in q: of the angle in rad, or of the lengths along `directions` in m.
        velocities: Indices in v that belong to the columns of `directions`.
        directions: Shape (3, k), constant in F: the angular velocity of M in F (turn), or the
            velocity of M's origin in F (shift), for a unit of each of these velocities.
    """

    axis: int | None
    positions: tuple[int, ...]
    velocities: tuple[int, ...]
    directions: FloatArray

    @property
    def is_turn(self) -> bool:
        """Whether its positions and velocities are angular."""
        return self.axis is not None


@dataclass(eq=False)
class Inertia:
    """Mass, and its first and second moment about an origin.

    Attributes:
        mass: m in kg, a scalar.
        first: m c in kg m with c the centre of mass, shape (3, 1).
        second: The integral of r r^T dm in kg m^2, shape (3, 3). The rotational inertia is
            tr(second) 1 - second.
    """

    mass: ca.SX = field(default_factory=lambda: _zero(1))
    first: ca.SX = field(default_factory=lambda: _zero(3))
    second: ca.SX = field(default_factory=lambda: _zero(3, 3))

    @classmethod
    def of_mass(cls, mass: ca.SX, centre: FloatArray, second: FloatArray) -> "Inertia":
        """From a mass symbol, the centre of mass in m and the second moment per mass in m^2."""
        return cls(mass, mass * ca.SX(centre), mass * ca.SX(second))

    def __add__(self, other: "Inertia") -> "Inertia":
        return Inertia(self.mass + other.mass, self.first + other.first, self.second + other.second)


@dataclass(eq=False)
class Link:
    """A frame that one elementary motion moves, with the inertia of the bodies fixed to it.

    Attributes:
        parent: Index of its parent; -1 for the world, which is link 0.
        fixed: Constant R_PF, shape (3, 3), where the motion starts.
        axis: Of the turn, 0, 1 or 2; None for a shift.
        turn: R_FL(q), shape (3, 3).
        offset: p_PL in m, expressed in P, shape (3, 1).
        turning: Index in v -> angular velocity in L for a unit of it, shape (3, 1).
        shifting: Index in v -> velocity of L's origin in P for a unit of it, shape (3, 1).
        inertia: About L's origin.
        weightless: The part of `inertia` that gravity does not act on.
    """

    parent: int = -1
    fixed: FloatArray = field(default_factory=lambda: np.eye(3))
    axis: int | None = None
    turn: ca.SX = field(default_factory=lambda: ca.SX.eye(3))
    offset: ca.SX = field(default_factory=lambda: _zero(3))
    turning: dict[int, ca.SX] = field(default_factory=dict)
    shifting: dict[int, ca.SX] = field(default_factory=dict)
    inertia: Inertia = field(default_factory=Inertia)
    weightless: Inertia = field(default_factory=Inertia)

    def __post_init__(self) -> None:
        self.rotation = ca.densify(ca.SX(self.fixed) @ self.turn)

    @classmethod
    def moved(
        cls, parent: int, fixed: FloatArray, offset: FloatArray, motion: Motion, q: ca.SX
    ) -> "Link":
        """A link without inertia that `motion` moves, starting at a constant pose in P."""
        if motion.axis is None:
            directions = ca.SX(fixed @ motion.directions)
            lengths = ca.vertcat(*[q[i] for i in motion.positions])
            shifting = {j: directions[:, c] for c, j in enumerate(motion.velocities)}
            moved = ca.SX(offset) + directions @ lengths
            return cls(parent, fixed, offset=moved, shifting=shifting)
        turn = _turn_about(motion.axis, q[motion.positions[0]])
        directions = turn.T @ ca.SX(motion.directions)
        turning = {j: ca.densify(directions[:, c]) for c, j in enumerate(motion.velocities)}
        return cls(parent, fixed, motion.axis, turn, ca.SX(offset), turning)

    def force_to_parent(self, moment: ca.SX, force: ca.SX) -> tuple[ca.SX, ca.SX]:
        """A moment about L's origin and a force, moved to P's origin and expressed in P."""
        force = self.rotation @ force
        return self.rotation @ moment + ca.cross(self.offset, force), force

    def generalized_force(self, moment: ca.SX, force: ca.SX) -> list[tuple[int, ca.SX]]:
        """What a moment about L's origin and a force do on this motion: index in v, scalar."""
        turning = [(j, ca.dot(d, moment)) for j, d in self.turning.items()]
        return turning + [(j, ca.dot(self.rotation.T @ d, force)) for j, d in self.shifting.items()]

    def inertia_to_parent(self, inertia: Inertia) -> Inertia:
        """An inertia in L, moved to P's origin and expressed in P."""
        first = self.rotation @ inertia.first
        fixed = ca.SX(self.fixed)
        second = _symmetric(fixed @ self._turn_second(inertia.second) @ fixed.T)
        half = first + inertia.mass / 2 * self.offset
        outer = self.offset @ half.T
        return Inertia(
            inertia.mass, first + inertia.mass * self.offset, second + _symmetric(outer + outer.T)
        )

    def _turn_second(self, second: ca.SX) -> ca.SX:
        """turn second turn^T with 16 operations instead of 75."""
        if self.axis is None:
            return second
        k, i, j = self.axis, (self.axis + 1) % 3, (self.axis + 2) % 3
        s, c = self.turn[j, i], self.turn[i, i]
        g = s * (second[i, i] - second[j, j]) + 2 * c * second[i, j]
        result = ca.SX(second)
        result[i, i] = second[i, i] - s * g
        result[j, j] = second[j, j] + s * g
        result[i, j] = result[j, i] = c * g - second[i, j]
        result[i, k] = result[k, i] = c * second[i, k] - s * second[j, k]
        result[j, k] = result[k, j] = s * second[i, k] + c * second[j, k]
        return result


def link_poses(links: Sequence[Link]) -> list[tuple[ca.SX, ca.SX]]:
    """R_WL, shape (3, 3), and p_WL in m, shape (3, 1), of every link."""
    poses = [(ca.SX(np.eye(3)), _zero(3))]
    for link in links[1:]:
        rotation, origin = poses[link.parent]
        poses.append((rotation @ link.rotation, origin + rotation @ link.offset))
    return poses


def mass_matrix(links: Sequence[Link], reflected_inertia: FloatArray) -> ca.SX:
    """M, shape (nv, nv), by the composite rigid body algorithm.

    Args:
        links: The tree, parents before children; the world is link 0.
        reflected_inertia: Of the rotors, shape (nv,), added to the diagonal.
    """
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
    return ca.sparsify(_symmetric(M))


def frame_jacobian(links: Sequence[Link], index: int, origin: ca.SX, size: int) -> ca.SX:
    """Velocity in m/s and angular velocity of a frame for a unit of each entry of v, in the world.

    Args:
        links: The tree, parents before children; the world is link 0.
        index: Of the link that the frame is fixed to.
        origin: Of the frame, p_W in m, shape (3, 1).
        size: nv.

    Returns:
        Shape (6, nv): the velocity of the origin above the angular velocity.
    """
    poses, result = link_poses(links), ca.SX(6, size)
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
    """How a link moves, in its own axes; each of shape (3, 1), except as noted.

    Attributes:
        spin: Angular velocity in rad/s.
        spin_rate: Its derivative in rad/s^2.
        velocity: Of the origin, in m/s.
        acceleration: Of the origin, less gravity, in m/s^2: the world is accelerated upward, which
            pulls every body down.
        gradient: A point r of the link has the acceleration `acceleration` + gradient r, in 1/s^2,
            shape (3, 3).
    """

    spin: ca.SX
    spin_rate: ca.SX
    velocity: ca.SX
    acceleration: ca.SX
    gradient: ca.SX


def link_motions(
    links: Sequence[Link], v: ca.SX, acceleration: ca.SX, gravity: FloatArray
) -> list[LinkMotion]:
    """How every link moves.

    Args:
        links: The tree, parents before children; the world is link 0.
        v: Velocities, shape (nv, 1).
        acceleration: v', shape (nv, 1).
        gravity: In the world, shape (3,), in m/s^2.
    """
    motions = [LinkMotion(_zero(3), _zero(3), _zero(3), ca.SX(-gravity), _zero(3, 3))]
    for link in links[1:]:
        parent, to_link = motions[link.parent], link.rotation.T
        turning, turning_rate, shifting, shifting_rate = (
            sum((rates[j] * d for j, d in directions.items()), _zero(3))
            for directions in (link.turning, link.shifting)
            for rates in (v, acceleration)
        )
        carried = to_link @ parent.spin
        spin = carried + turning
        spin_rate = to_link @ parent.spin_rate + ca.cross(carried, turning) + turning_rate
        velocity = parent.velocity + ca.cross(parent.spin, link.offset) + shifting
        moved = parent.gradient @ link.offset + 2 * ca.cross(parent.spin, shifting) + shifting_rate
        outer = _symmetric(spin @ spin.T)
        motions.append(
            LinkMotion(
                spin,
                spin_rate,
                to_link @ velocity,
                to_link @ (parent.acceleration + moved),
                ca.skew(spin_rate) + outer - ca.trace(outer) * ca.SX.eye(3),
            )
        )
    return motions


def inverse_dynamics(
    links: Sequence[Link],
    motions: Sequence[LinkMotion],
    gravity: FloatArray,
    size: int,
    wrenches: Mapping[int, tuple[ca.SX, ca.SX]] = MappingProxyType({}),
) -> ca.SX:
    """Generalized forces, shape (nv, 1), by the recursive Newton-Euler algorithm.

    Args:
        links: The tree, parents before children; the world is link 0.
        motions: Of the links.
        gravity: In the world, shape (3,), in m/s^2.
        size: nv.
        wrenches: Index of a link -> moment about its origin in N m and force in N that act on it,
            in the link's axes, each of shape (3, 1).
    """
    tau = _zero(size)
    moments, forces = [_zero(3) for _ in links], [_zero(3) for _ in links]
    poses = link_poses(links)
    for index in range(len(links) - 1, 0, -1):
        link, inertia, weightless = links[index], links[index].inertia, links[index].weightless
        acceleration, gradient = motions[index].acceleration, motions[index].gradient
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


def _symmetric(matrix: ca.SX) -> ca.SX:
    """The lower triangle mirrored: equal entries become one expression."""
    return ca.tril2symm(ca.tril(matrix))


def _turn_about(axis: int, angle: ca.SX) -> ca.SX:
    """The rotation about a coordinate axis, shape (3, 3)."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    s, c = ca.sin(angle), ca.cos(angle)
    turn = ca.SX.eye(3)
    turn[i, i], turn[i, j], turn[j, i], turn[j, j] = c, -s, s, c
    return turn
