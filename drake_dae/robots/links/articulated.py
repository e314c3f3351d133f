"""The articulated-body algorithm (Featherstone, Rigid Body Dynamics Algorithms, 2008, chapter 7).

As a factorization of M (Jain, Robot and Multibody Dynamics, 2011, chapter 7): with the articulated
inertia I of each link, its joint axis S, U = I S and D = S' U + rotor,

    M = L D L',

where L and its inverse are recursions along the tree: the operations grow with the number of links
and not, as those of a triangular factor, with its square or cube.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca

from drake_dae.arrays import FloatArray
from drake_dae.robots.links.tree import TreeLink, symmetric, zeros


def is_one_by_one(links: Sequence[TreeLink]) -> bool:
    """Whether each link moves by one velocity of its own at most, as `ArticulatedBodies` need it.

    A free body, a ball joint or a screw has links that share velocities.
    """
    moved = [[*link.turning, *link.shifting] for link in links]
    owned = [index for indices in moved for index in indices]
    return len(owned) == len(set(owned)) and all(len(indices) <= 1 for indices in moved)


@dataclass(frozen=True, eq=False)
class ArticulatedInertia:
    """Moment J w + H a and force H' w + M a of a link's acceleration (w, a), at its origin."""

    J: ca.SX
    H: ca.SX
    M: ca.SX

    def __add__(self, other: "ArticulatedInertia") -> "ArticulatedInertia":
        return ArticulatedInertia(self.J + other.J, self.H + other.H, self.M + other.M)

    def without(self, moment: ca.SX, force: ca.SX, size: ca.SX) -> "ArticulatedInertia":
        """The inertia that remains where a joint with U = (moment, force) and D = size is free."""
        return ArticulatedInertia(
            symmetric(self.J - moment @ moment.T / size),
            self.H - moment @ force.T / size,
            symmetric(self.M - force @ force.T / size),
        )

    def to_parent(self, link: TreeLink) -> "ArticulatedInertia":
        """The same inertia in the axes of the parent, at its origin."""
        arm, coupling = ca.skew(link.offset), link.rotation @ self.H @ link.rotation.T
        force = symmetric(link.to_parent_axes(self.M))
        shifted = arm @ force
        half = coupling @ arm.T
        moment = link.to_parent_axes(self.J) + half + half.T + shifted @ arm.T
        return ArticulatedInertia(symmetric(moment), coupling + shifted, force)


class ArticulatedBodies:
    """M = L D L' of a tree of links that move one by one, as a `PositiveDefiniteFactorization`.

    `rotors`, shape (nv,), are added to the diagonal of M.
    """

    def __init__(self, links: Sequence[TreeLink], rotors: FloatArray) -> None:
        self._links = links
        self._axes: list[list[tuple[int, ca.SX, ca.SX]]] = []
        self._gains: list[tuple[ca.SX, ca.SX]] = [(zeros(3), zeros(3)) for _ in links]
        self._sizes = zeros(len(rotors))
        for link in links:
            turns = [(j, direction, zeros(3)) for j, direction in link.turning.items()]
            shifts = [
                (j, zeros(3), link.rotation.T @ direction) for j, direction in link.shifting.items()
            ]
            self._axes.append(turns + shifts)
        bodies = [
            ArticulatedInertia(
                ca.trace(link.inertia.second) * ca.SX.eye(3) - link.inertia.second,
                ca.skew(link.inertia.first),
                link.inertia.mass * ca.SX.eye(3),
            )
            for link in links
        ]
        for index in range(len(links) - 1, 0, -1):
            body = bodies[index]
            for j, turn, shift in self._axes[index]:
                moment, force = body.J @ turn + body.H @ shift, body.H.T @ turn + body.M @ shift
                size = ca.dot(turn, moment) + ca.dot(shift, force) + rotors[j]
                self._gains[index], self._sizes[j] = (moment, force), size
                body = body.without(moment, force, size)
            parent = links[index].parent
            if parent > 0:
                bodies[parent] += body.to_parent(links[index])

    def solve(self, right: ca.SX) -> ca.SX:
        """Returns X of M X = B, shape (nv, k)."""
        return self.backward(self.forward(right))

    def forward(self, right: ca.SX) -> ca.SX:
        """Returns Y = L^-1 B, shape (nv, k): from the tips to the base."""
        return _by_columns(right, self._forward)

    def scaled(self, half: ca.SX) -> ca.SX:
        """Returns D^-1 Y, shape (nv, k)."""
        return half / ca.repmat(self._sizes, 1, half.shape[1])

    def backward(self, half: ca.SX) -> ca.SX:
        """Returns X = L^-T D^-1 Y, shape (nv, k): from the base to the tips."""
        return _by_columns(half, self._backward)

    def _forward(self, tau: ca.SX) -> ca.SX:
        result = ca.densify(tau)
        moments, forces = [zeros(3) for _ in self._links], [zeros(3) for _ in self._links]
        for index in range(len(self._links) - 1, 0, -1):
            link, moment, force = self._links[index], moments[index], forces[index]
            for j, turn, shift in self._axes[index]:
                result[j] -= ca.dot(turn, moment) + ca.dot(shift, force)
                along = result[j] / self._sizes[j]
                gain = self._gains[index]
                moment, force = moment + gain[0] * along, force + gain[1] * along
            moment, force = link.force_to_parent(moment, force)
            moments[link.parent] += moment
            forces[link.parent] += force
        return result

    def _backward(self, half: ca.SX) -> ca.SX:
        result = ca.densify(half / self._sizes)
        moving = [(zeros(3), zeros(3))]
        for index, link in enumerate(self._links[1:], 1):
            turning, shifting = moving[link.parent]
            shifting = link.rotation.T @ (shifting + ca.cross(turning, link.offset))
            turning = link.rotation.T @ turning
            for j, turn, shift in self._axes[index]:
                moment, force = self._gains[index]
                carried = ca.dot(moment, turning) + ca.dot(force, shifting)
                result[j] -= carried / self._sizes[j]
                turning, shifting = turning + turn * result[j], shifting + shift * result[j]
            moving.append((turning, shifting))
        return result


def _by_columns(matrix: ca.SX, function: Callable[[ca.SX], ca.SX]) -> ca.SX:
    """The function of all columns that are not structurally zero."""
    result = ca.SX(*matrix.shape)
    for column in range(matrix.shape[1]):
        if matrix[:, column].nnz():
            result[:, column] = function(matrix[:, column])
    return ca.sparsify(result)
