"""A tree of links, each with its own frame, its inertia and one elementary joint to its parent.

Frame names: P is the frame of a link's parent, L its own, W the world's. Quantities of a link are
expressed in L unless said otherwise. A link moves by one elementary joint, so that its rotation
is sparse; a joint with several is a chain of links, of which the last carries the inertia.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray


def zeros(rows: int, columns: int = 1) -> ca.SX:
    """A dense column or matrix of zeros, whose entries can be set one by one."""
    return ca.SX.zeros(rows, columns)


@dataclass(frozen=True, eq=False)
class ElementaryJoint:
    """X_FM(q) of one elementary joint: a rotation about a coordinate axis of F, or a translation.

    A joint of a plant is a sequence of these; each starts from the frame where the one before ends.

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

    mass: ca.SX = field(default_factory=lambda: zeros(1))
    first: ca.SX = field(default_factory=lambda: zeros(3))
    second: ca.SX = field(default_factory=lambda: zeros(3, 3))

    @classmethod
    def of_mass(cls, mass: ca.SX, centre: FloatArray, second: FloatArray) -> "Inertia":
        """The inertia of a mass symbol with its centre in m and second moment per mass in m^2."""
        return cls(mass, mass * ca.SX(centre), mass * ca.SX(second))

    @classmethod
    def of_point(cls, mass: ca.SX, place: ca.SX) -> "Inertia":
        """The inertia of a point mass at a place in m, both symbolic."""
        return cls(mass, mass * place, mass * (place @ place.T))

    def __add__(self, other: "Inertia") -> "Inertia":
        return Inertia(self.mass + other.mass, self.first + other.first, self.second + other.second)


@dataclass(eq=False)
class TreeLink:
    """A frame that one elementary joint moves, with the inertia of the bodies fixed to it.

    Attributes:
        parent: The index of its parent; -1 for the world, which is link 0.
        fixed: The constant R_PF, shape (3, 3), where the joint starts.
        axis: The coordinate axis of the turn, 0, 1 or 2; None for a shift.
        turn: R_FL(q), shape (3, 3).
        offset: p_PL in m, expressed in P, shape (3, 1).
        turning: Index in v -> angular velocity in L for a unit of it, shape (3, 1).
        shifting: Index in v -> velocity of L's origin in P for a unit of it, shape (3, 1).
        inertia: The inertia about L's origin.
        weightless: The part of `inertia` that gravity does not act on.
    """

    parent: int = -1
    fixed: FloatArray = field(default_factory=lambda: np.eye(3))
    axis: int | None = None
    turn: ca.SX = field(default_factory=lambda: ca.SX.eye(3))
    offset: ca.SX = field(default_factory=lambda: zeros(3))
    turning: dict[int, ca.SX] = field(default_factory=dict)
    shifting: dict[int, ca.SX] = field(default_factory=dict)
    inertia: Inertia = field(default_factory=Inertia)
    weightless: Inertia = field(default_factory=Inertia)

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
        turn = _turn_about(joint.axis, q[joint.positions[0]])
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
        """A symmetric matrix in L, shape (3, 3), in the axes of P."""
        fixed = ca.SX(self.fixed)
        return fixed @ self._turn_second(matrix) @ fixed.T

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


def link_poses(links: Sequence[TreeLink]) -> list[tuple[ca.SX, ca.SX]]:
    """R_WL, shape (3, 3), and p_WL in m, shape (3, 1), of every link."""
    poses = [(ca.SX(np.eye(3)), zeros(3))]
    for link in links[1:]:
        rotation, origin = poses[link.parent]
        poses.append((rotation @ link.rotation, origin + rotation @ link.offset))
    return poses


def symmetric(matrix: ca.SX) -> ca.SX:
    """The lower triangle mirrored: equal entries become one expression."""
    return ca.tril2symm(ca.tril(matrix))


def _turn_about(axis: int, angle: ca.SX) -> ca.SX:
    """The rotation about a coordinate axis, shape (3, 3)."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    s, c = ca.sin(angle), ca.cos(angle)
    turn = ca.SX.eye(3)
    turn[i, i], turn[i, j], turn[j, i], turn[j, j] = c, -s, s, c
    return turn
