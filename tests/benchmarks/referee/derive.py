"""The reference: constraint forces to 40 digits, in the fewest coordinates, by virtual work.

Independent of drake_dae and of any engine: arrays of mpmath's numbers alone. In words:

1. Each body's velocity is linear in the rates v of the joints: omega = W v, v_c = C v. Its
   accelerations are W v' + omega_0 and C v' + a_0, where omega_0 and a_0 follow from the recursion
   from body to body for v' = 0.
2. By Newton, Euler and d'Alembert the work of all forces vanishes for each change of v:
   sum [C^T m (a - gravity) + W^T (I alpha + omega x I omega)] = M v' + h = tau + G f,
   with torques tau of joints and springs, and the constraint forces f. No matrix J M^-1 J^T and no
   multiplier rule is used: f are the unknown forces at the cut closures.
3. The closures give v = T v_free, and v' = T v_free' + gamma: the rates of the joints that are not
   free by elimination with complete pivoting, which also tells which rows are independent.
4. M (T v_free' + gamma) + h = tau + G f is one linear system for the fewest accelerations v_free'
   and the forces f. With sliding friction, G has the friction beside the normal force.
5. If rows are redundant, only G f is determined. Of all f with this sum the one with the least sum
   of squares (in N and N m) is stated: f = G^T y.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from mpmath import mp, mpf

from referee.description import Closure, Mechanism, force_names

mp.dps = 50
Array = np.ndarray


def exact(numbers: Sequence[float]) -> Array:
    """The decimals that the numbers print as: 0.3 is 3/10."""
    return np.array([mpf(repr(float(number))) for number in numbers])


def zeros(*shape: int) -> Array:
    return np.full(shape, mpf(0))


IDENTITY = np.array([exact(row) for row in np.eye(3)])


def turned(axis: Array, angle: mpf) -> Array:
    """The rotation about a unit axis, by Rodrigues."""
    c, (x, y, z) = mp.cos(angle), axis * mp.sin(angle)
    return np.outer(axis, axis) * (1 - c) + np.array([[c, -z, y], [z, c, -x], [-y, x, c]])


def solve(matrix: Array, right: Array) -> Array:
    """The solution of a square linear system."""
    if not len(right):
        return right
    return np.array(list(mp.lu_solve(mp.matrix(matrix.tolist()), mp.matrix(right.tolist()))))


def independent(matrix: Array) -> list[int]:
    """The numbers of as many rows as the rank, which are independent, by complete pivoting."""
    rest, chosen = matrix.copy(), list[int]()
    rows, columns = (list(range(size)) for size in matrix.shape)
    least = np.max(np.abs(matrix), initial=mpf(0)) * mpf(10) ** (-mp.dps // 2)
    while rows and columns:
        size, i, j = max((abs(rest[i, j]), i, j) for i in rows for j in columns)
        if size <= least:
            break
        chosen.append(i)
        rows.remove(i)
        columns.remove(j)
        for k in rows:
            if rest[k, j]:
                rest[k] = rest[k] - rest[i] * (rest[k, j] / rest[i, j])
    return sorted(chosen)


# Bodies in motion, by the recursion from body to body.


@dataclass
class Frame:
    """A body in motion: pose, velocities, and accelerations for v' = 0, in the world."""

    rotation: Array
    position: Array
    spin: Array
    velocity: Array
    spin_rate: Array
    acceleration: Array
    joints: list  # (number, kind, axis in the world, a point on it) from the world outward

    def point(self, place: Array) -> tuple[Array, Array, Array]:
        """Place, velocity, and acceleration for v' = 0 of a point that is fixed in the body."""
        lever = self.rotation @ place
        whirl = np.cross(self.spin, lever)
        turning = np.cross(self.spin_rate, lever) + np.cross(self.spin, whirl)
        return self.position + lever, self.velocity + whirl, self.acceleration + turning

    def columns(self, point: Array, size: int) -> tuple[Array, Array]:
        """W^T and C^T: what each joint's unit rate gives the body and a point of it."""
        turns, shifts = zeros(size, 3), zeros(size, 3)
        for number, kind, axis, origin in self.joints:
            if kind == "turn":
                turns[number] = axis
                axis = np.cross(axis, point - origin)
            shifts[number] = axis
        return turns, shifts


def frames(mechanism: Mechanism, q: Array, v: Array) -> dict[str, Frame]:
    """All bodies in motion."""
    found = {"world": Frame(IDENTITY, *(zeros(3) for _ in range(5)), [])}
    number = 0
    for body in mechanism.bodies:
        parent = found[body.parent]
        rotation, spin, spin_rate = parent.rotation, parent.spin, parent.spin_rate
        place, velocity, acceleration = parent.point(exact(body.at))
        joints = list(parent.joints)
        for kind, direction in body.joints:
            own = exact(direction)
            axis = rotation @ own
            joints.append((number, kind, axis, place))
            moving = axis * v[number]
            if kind == "turn":  # The body's own origin is on the axis.
                spin_rate = spin_rate + np.cross(spin, moving)
                spin = spin + moving
                rotation = rotation @ turned(own, q[number])
            else:
                lever = axis * q[number]
                whirl = np.cross(spin, lever)
                turning = np.cross(spin_rate, lever) + np.cross(spin, whirl + moving * 2)
                acceleration = acceleration + turning
                velocity, place = velocity + whirl + moving, place + lever
            number += 1
        found[body.name] = Frame(rotation, place, spin, velocity, spin_rate, acceleration, joints)
    return found


def balance(mechanism: Mechanism, bodies: dict[str, Frame]) -> tuple[Array, Array]:
    """M, shape (n, n), and h - tau, shape (n,)."""
    size = mechanism.size
    M, rest = zeros(size, size), zeros(size)
    for body in mechanism.bodies:
        if body.mass == 0.0:
            continue
        frame, mass = bodies[body.name], mpf(repr(body.mass))
        place, _, acceleration = frame.point(exact(body.center))
        inertia = (frame.rotation * exact(body.inertia)) @ frame.rotation.T
        W, C = frame.columns(place, size)
        force = (acceleration - exact(mechanism.gravity)) * mass
        moment = inertia @ frame.spin_rate + np.cross(frame.spin, inertia @ frame.spin)
        rest += C @ force + W @ moment
        M += C @ C.T * mass + W @ inertia @ W.T
    for joint, torque in mechanism.torques.items():
        rest[joint] -= mpf(repr(torque))
    for spring in mechanism.springs:
        ends = (spring.body_a, spring.point_a), (spring.body_b, spring.point_b)
        places = [bodies[name].point(exact(point))[0] for name, point in ends]
        apart = places[1] - places[0]
        length = mp.sqrt(apart @ apart)
        pull = mpf(repr(spring.stiffness)) * (length - mpf(repr(spring.length))) / length
        for sign, (name, _), place in zip((-1, 1), ends, places, strict=True):
            rest += bodies[name].columns(place, size)[1] @ apart * (sign * pull)
    return M, rest


# The equations of closures, and their forces.


@dataclass
class Row:
    """One equation: its gap, J of its rate J v - drive, the derivative but J v', and its force."""

    closure: Closure
    gap: object
    gradient: Array
    bias: mpf
    force: Array
    drive: object = 0


def rows_of(
    mechanism: Mechanism, closure: Closure, bodies: dict[str, Frame], q: Array
) -> list[Row]:
    """The equations of a closure."""
    size = mechanism.size
    if closure.kind == "gear":
        follower = mechanism.first_joint(closure.body_b)
        leader = mechanism.first_joint(closure.body_a)
        ratio, gradient = mpf(repr(closure.size)), zeros(size)
        gradient[follower], gradient[leader] = mpf(1), -ratio
        return [Row(closure, q[follower] - ratio * q[leader], gradient, mpf(0), gradient)]
    frame_a, frame_b = bodies[closure.body_a], bodies[closure.body_b]
    a, b = frame_a.point(exact(closure.point_a)), frame_b.point(exact(closure.point_b))
    W_a, C_a = frame_a.columns(a[0], size)
    W_b, C_b = frame_b.columns(b[0], size)
    apart, moving, bending = (of_b - of_a for of_a, of_b in zip(a, b, strict=True))
    still = zeros(3)

    def shift(u: Array, turning: Array, gap: object = None) -> Row:
        gradient = (C_b - C_a) @ u
        bias = u @ bending + turning @ moving
        return Row(closure, u @ apart if gap is None else gap, gradient, bias, gradient)

    def turn(u: Array, turning: Array, gap: object) -> Row:
        gradient = (W_b - W_a) @ u
        bias = u @ (frame_b.spin_rate - frame_a.spin_rate)
        bias += turning @ (frame_b.spin - frame_a.spin)
        return Row(closure, gap, gradient, bias, gradient)

    if closure.kind == "point":
        return [shift(IDENTITY["xyz".index(axis)], still) for axis in closure.axes]
    if closure.kind == "distance":
        length = mp.sqrt(apart @ apart)
        away = apart / length
        across = (moving - away * (away @ moving)) / length
        return [shift(away, across, length - mpf(repr(closure.size)))]
    if closure.kind in ("weld", "hinge"):
        if closure.kind == "weld":
            off = np.cross(frame_a.rotation.T, frame_b.rotation.T).sum(axis=0)
            turns = [turn(u, still, u @ off / 2) for u in IDENTITY]
        else:
            axis = exact(closure.direction)
            off = np.cross(frame_a.rotation @ axis, frame_b.rotation @ axis)
            held = held_axes(closure, frame_a)
            turns = [turn(u, np.cross(frame_a.spin, u), u @ off) for u in held]
        return turns + [shift(u, still) for u in IDENTITY]
    normal = exact(closure.direction)
    row = shift(normal, still)
    row.drive, moving_up = exact(closure.road)
    row.bias -= moving_up
    row.force = C_b @ (normal + friction(closure, moving))
    return [row]


def held_axes(closure: Closure, frame: Frame) -> list[Array]:
    """The axes of a body about which a hinge has moments."""
    own = frame.rotation @ exact(closure.direction)
    return [u for u in frame.rotation.T if (u @ own) ** 2 < mpf("0.5")]


def friction(closure: Closure, moving: Array) -> Array:
    """Coulomb's friction for a normal force of 1 N, in motion alone."""
    normal = exact(closure.direction)
    along = moving - normal * (normal @ moving)
    speed = mp.sqrt(along @ along)
    return along * (-mpf(repr(closure.friction)) / speed) if speed else along


def reported(closure: Closure, bodies: dict[str, Frame], values: Array) -> Array:
    """The force of a closure in the components of `force_names`, from those of its rows."""
    if closure.kind == "hinge":
        held = held_axes(closure, bodies[closure.body_a])
        return np.concatenate([values[:2] @ np.array(held), values[2:]])
    if closure.kind == "plane":
        moving = bodies[closure.body_b].point(exact(closure.point_b))[1]
        return (exact(closure.direction) + friction(closure, moving)) * values[0]
    return values


def all_rows(mechanism: Mechanism, bodies: dict[str, Frame], q: Array) -> list[Row]:
    """The equations of all closures."""
    return [row for closure in mechanism.closures for row in rows_of(mechanism, closure, bodies, q)]


# Positions, rates, accelerations and forces.


def closed(mechanism: Mechanism, q: Array) -> Array:
    """Positions at which all closures hold, by Newton's method; the free ones stay."""
    q, size = q.copy(), mechanism.size
    solved = [i for i in range(size) if i not in mechanism.free]
    for _ in range(60):
        rows = all_rows(mechanism, frames(mechanism, q, zeros(size)), q)
        rows = [row for row in rows if row.gap is not None]
        if not solved or max(abs(row.gap) for row in rows) < mpf(10) ** (8 - mp.dps):
            return q
        matrix = np.array([row.gradient[solved] for row in rows])
        chosen = independent(matrix)
        if len(chosen) < len(solved):
            raise ValueError(f"{mechanism.name}: the free joints do not determine the others")
        q[solved] -= solve(matrix[chosen], np.array([rows[k].gap for k in chosen]))
    raise ValueError(f"{mechanism.name}: no positions close it near the guess")


@dataclass
class State:
    """Consistent positions and rates, the accelerations, and the forces by name."""

    q: Array
    v: Array
    acceleration: Array
    forces: dict[str, object]


def state(mechanism: Mechanism) -> State:
    """All that is asked at the closed positions, with the stated rates of the free joints."""
    size, free = mechanism.size, list(mechanism.free)
    q = closed(mechanism, exact(mechanism.q))
    rows = all_rows(mechanism, frames(mechanism, q, zeros(size)), q)
    J = np.array([row.gradient for row in rows])
    bound = [i for i in range(size) if i not in free]
    chosen = independent(J[:, bound])
    if len(chosen) < len(bound):
        raise ValueError(f"{mechanism.name}: the free joints do not determine the others")

    def completed(vector: Array, rest: Array) -> Array:
        """The vector with its bound parts so that J vector + rest = 0."""
        whole = vector.copy()
        right = -rest[chosen] - J[np.ix_(chosen, free)] @ vector[free]
        whole[bound] = solve(J[np.ix_(chosen, bound)], right)
        return whole

    units = [exact(np.arange(size) == i) for i in free]
    T = np.array([completed(unit, zeros(len(rows))) for unit in units])
    rates = exact([mechanism.v.get(i, 0.0) for i in free])
    v = completed(zeros(size), -np.array([row.drive for row in rows])) + rates @ T
    bodies = frames(mechanism, q, v)
    rows = all_rows(mechanism, bodies, q)
    M, h = balance(mechanism, bodies)
    gamma = completed(zeros(size), np.array([row.bias for row in rows]))
    # M T a - G f = -h - M gamma, with the forces of the chosen rows alone.
    acting = np.array([rows[k].force for k in chosen])
    found = solve(np.vstack([T @ M.T, -acting]).T, -h - M @ gamma)
    values = zeros(len(rows))
    values[chosen] = found[len(free) :]
    if len(chosen) < len(rows):  # f = G^T y, with the same sum.
        G = np.array([row.gradient[bound] for row in rows]).T
        values = solve(G @ G.T, G @ values) @ G
    forces, start = dict[str, object](), 0
    for closure in mechanism.closures:
        count = sum(row.closure is closure for row in rows)
        own = reported(closure, bodies, values[start : start + count])
        forces.update(zip(force_names(closure), own, strict=True))
        start += count
    return State(q, v, gamma + found[: len(free)] @ T, forces)
