"""Recursive algorithms on a tree of links (Featherstone, Rigid Body Dynamics Algorithms, 2008).

The composite rigid body algorithm and the recursive Newton-Euler algorithm (chapters 5 and 6), in
link frames; names as in `tree`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import casadi as ca

from drake_dae.arrays import FloatArray
from drake_dae.robots.links.tree import TreeLink, link_poses, symmetric, zeros


def mass_matrix(links: Sequence[TreeLink], reflected_inertia: FloatArray) -> ca.SX:
    """M, shape (nv, nv), by the composite rigid body algorithm.

    Args:
        links: The tree, parents before children; the world is link 0.
        reflected_inertia: The addition of the rotors to the diagonal, shape (nv,).
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
    return ca.sparsify(symmetric(M))


def frame_jacobian(links: Sequence[TreeLink], index: int, origin: ca.SX, size: int) -> ca.SX:
    """The Jacobian of a frame: its motion in the world per unit of each entry of v.

    Args:
        links: The tree, parents before children; the world is link 0.
        index: The index of the link that carries the frame.
        origin: The position of the frame's origin, p_W in m, shape (3, 1).
        size: The number of velocities, nv.

    Returns:
        The velocity of the origin in m/s above the angular velocity in rad/s, shape (6, nv).
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
class LinkKinematics:
    """The motion of a link, in its own axes; vectors have shape (3, 1).

    Attributes:
        spin: The angular velocity in rad/s.
        spin_rate: The derivative of the spin in rad/s^2.
        velocity: The velocity of the origin, in m/s.
        acceleration: The acceleration of the origin minus gravity, in m/s^2: gravity is represented
            by an upward acceleration of the world.
        gradient: A point r of the link has the acceleration `acceleration` + gradient r, in 1/s^2,
            shape (3, 3).
    """

    spin: ca.SX
    spin_rate: ca.SX
    velocity: ca.SX
    acceleration: ca.SX
    gradient: ca.SX


def link_kinematics(
    links: Sequence[TreeLink], v: ca.SX, acceleration: ca.SX, gravity: FloatArray
) -> list[LinkKinematics]:
    """The motion of every link.

    Args:
        links: The tree, parents before children; the world is link 0.
        v: Velocities, shape (nv, 1).
        acceleration: v', shape (nv, 1).
        gravity: Gravity in the world, m/s^2, shape (3,).
    """
    result = [LinkKinematics(zeros(3), zeros(3), zeros(3), ca.SX(-gravity), zeros(3, 3))]
    for link in links[1:]:
        parent, to_link = result[link.parent], link.rotation.T
        turning, turning_rate, shifting, shifting_rate = (
            sum((rates[j] * d for j, d in directions.items()), zeros(3))
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
            LinkKinematics(
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
    moving: Sequence[LinkKinematics],
    gravity: FloatArray,
    size: int,
    wrenches: Mapping[int, tuple[ca.SX, ca.SX]] = MappingProxyType({}),
) -> ca.SX:
    """Generalized forces, shape (nv, 1), by the recursive Newton-Euler algorithm.

    Args:
        links: The tree, parents before children; the world is link 0.
        moving: The motion of each link.
        gravity: Gravity in the world, m/s^2, shape (3,).
        size: The number of velocities, nv.
        wrenches: Index of a link -> moment about its origin in N m and force in N that act on it,
            in the link's axes, each of shape (3, 1).
    """
    tau = zeros(size)
    moments, forces = [zeros(3) for _ in links], [zeros(3) for _ in links]
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
