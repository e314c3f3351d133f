"""The reference: constraint forces to 40 digits, in the fewest coordinates, by virtual work.

Independent of drake_dae and of any engine; mpmath alone. In words:

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
6. In an impact M (v+ - v-) = G f with the impulses f, and J v+ = -e J v-.
7. After a motion: v_free' and q' are integrated in the fewest coordinates, see `motion.py`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from mpmath import mp, mpf

from referee.description import Closure, Mechanism, force_names
from referee.vectors import (
    IDENTITY,
    add,
    apply,
    cross,
    dot,
    exact,
    matmul,
    rank_and_pivots,
    scaled,
    solve,
    sub,
    transposed,
    turned,
)

mp.dps = 55
ZERO = mpf(0)


@dataclass
class Frame:
    """A body in motion: pose, velocities, and accelerations for v' = 0, in the world."""

    rotation: list
    position: list
    spin: list
    velocity: list
    spin_rate: list
    acceleration: list
    joints: list  # (number, kind, axis in the world, a point on it) from the world outward

    def point(self, place: Sequence) -> "Point":
        """A point that is fixed in the body."""
        lever = apply(self.rotation, place)
        whirl = cross(self.spin, lever)
        return Point(
            add(self.position, lever),
            add(self.velocity, whirl),
            add(self.acceleration, cross(self.spin_rate, lever), cross(self.spin, whirl)),
        )

    def columns(self, point: Sequence, size: int) -> tuple[list, list]:
        """W and C: what each joint's unit rate gives the body and a point of it."""
        turns, shifts = [[ZERO] * 3] * size, [[ZERO] * 3] * size
        for number, kind, axis, origin in self.joints:
            if kind == "turn":
                turns[number] = axis
                shifts[number] = cross(axis, sub(point, origin))
            else:
                shifts[number] = axis
        return turns, shifts


@dataclass
class Point:
    """A point's place, velocity, and acceleration for v' = 0."""

    place: list
    velocity: list
    acceleration: list


@dataclass
class Row:
    """One equation: its gap, its rate J v, the rest of the rate's derivative, and its force."""

    gap: object
    gradient: list
    bias: object
    force: list


def frames(mechanism: Mechanism, q: Sequence, v: Sequence) -> dict[str, Frame]:
    """All bodies in motion."""
    zero = [ZERO] * 3
    found = {"world": Frame(IDENTITY, zero, zero, zero, zero, zero, [])}
    number = 0
    for body in mechanism.bodies:
        parent = found[body.parent]
        start = parent.point(exact(body.at))
        rotation, place = parent.rotation, start.place
        spin, velocity = parent.spin, start.velocity
        spin_rate, acceleration = parent.spin_rate, start.acceleration
        joints = list(parent.joints)
        for kind, direction in body.joints:
            own = exact(direction)
            axis = apply(rotation, own)
            joints.append((number, kind, axis, place))
            if kind == "turn":
                # The body's own origin is on the axis.
                spin_rate = add(spin_rate, scaled(v[number], cross(spin, axis)))
                spin = add(spin, scaled(v[number], axis))
                rotation = matmul(rotation, turned(own, q[number]))
            else:
                lever = scaled(q[number], axis)
                whirl, along = cross(spin, lever), scaled(v[number], axis)
                acceleration = add(
                    acceleration,
                    cross(spin_rate, lever),
                    cross(spin, whirl),
                    scaled(mpf(2), cross(spin, along)),
                )
                velocity = add(velocity, whirl, along)
                place = add(place, lever)
            number += 1
        found[body.name] = Frame(
            rotation, place, spin, velocity, spin_rate, acceleration, joints
        )
    return found


def balance(mechanism: Mechanism, bodies: dict[str, Frame]) -> tuple[list, list]:
    """M, shape (n, n), and h - tau, shape (n,)."""
    size = mechanism.size
    M = [[ZERO] * size for _ in range(size)]
    rest = [ZERO] * size
    gravity = exact(mechanism.gravity)
    for body in mechanism.bodies:
        if body.mass == 0.0:
            continue
        frame, mass = bodies[body.name], mpf(repr(body.mass))
        center = frame.point(exact(body.center))
        principal = exact(body.inertia)
        axes = transposed(frame.rotation)

        def inertia(vector, axes=axes, principal=principal):
            parts = [scaled(principal[k] * dot(axes[k], vector), axes[k]) for k in range(3)]
            return add(*parts)

        W, C = frame.columns(center.place, size)
        force = scaled(mass, sub(center.acceleration, gravity))
        moment = add(inertia(frame.spin_rate), cross(frame.spin, inertia(frame.spin)))
        moved = [number for number, *_ in frame.joints]
        for i in moved:
            rest[i] += dot(C[i], force) + dot(W[i], moment)
            heavy, turning = scaled(mass, C[i]), inertia(W[i])
            for j in moved:
                M[i][j] += dot(C[j], heavy) + dot(W[j], turning)
    for joint, torque in mechanism.torques.items():
        rest[joint] -= mpf(repr(torque))
    for spring in mechanism.springs:
        ends = [
            (bodies[name], bodies[name].point(exact(point)).place)
            for name, point in ((spring.body_a, spring.point_a), (spring.body_b, spring.point_b))
        ]
        apart = sub(ends[1][1], ends[0][1])
        length = mp.sqrt(dot(apart, apart))
        pull = mpf(repr(spring.stiffness)) * (length - mpf(repr(spring.length))) / length
        for sign, (frame, place) in zip((-1, 1), ends, strict=True):
            _, C = frame.columns(place, size)
            for i in range(size):
                rest[i] += sign * pull * dot(C[i], apart)
    return M, rest


def rows_of(
    mechanism: Mechanism, closure: Closure, bodies: dict[str, Frame], q: Sequence
) -> list[Row]:
    """The equations of a closure."""
    size = mechanism.size
    if closure.kind == "gear":
        follower = mechanism.first_joint(closure.body_b)
        leader = mechanism.first_joint(closure.body_a)
        ratio, gradient = mpf(repr(closure.size)), [ZERO] * size
        gradient[follower], gradient[leader] = mpf(1), -ratio
        return [Row(q[follower] - ratio * q[leader], gradient, ZERO, gradient)]
    frame_a, frame_b = bodies[closure.body_a], bodies[closure.body_b]
    a, b = frame_a.point(exact(closure.point_a)), frame_b.point(exact(closure.point_b))
    W_a, C_a = frame_a.columns(a.place, size)
    W_b, C_b = frame_b.columns(b.place, size)
    apart, moving = sub(b.place, a.place), sub(b.velocity, a.velocity)
    bending = sub(b.acceleration, a.acceleration)

    def shift(u: list, turning: list, gap: object = None) -> Row:
        gradient = [dot(u, sub(C_b[i], C_a[i])) for i in range(size)]
        bias = dot(u, bending) + dot(turning, moving)
        return Row(dot(u, apart) if gap is None else gap, gradient, bias, gradient)

    def turn(u: list, turning: list, gap: object) -> Row:
        gradient = [dot(u, sub(W_b[i], W_a[i])) for i in range(size)]
        bias = dot(u, sub(frame_b.spin_rate, frame_a.spin_rate))
        bias += dot(turning, sub(frame_b.spin, frame_a.spin))
        return Row(gap, gradient, bias, gradient)

    still = [ZERO] * 3
    if closure.kind == "point":
        return [shift(IDENTITY["xyz".index(axis)], still) for axis in closure.axes]
    if closure.kind == "distance":
        length = mp.sqrt(dot(apart, apart))
        away = scaled(1 / length, apart)
        across = scaled(1 / length, sub(moving, scaled(dot(away, moving), away)))
        return [shift(away, across, length - mpf(repr(closure.size)))]
    if closure.kind in ("weld", "hinge"):
        axes_a, axes_b = transposed(frame_a.rotation), transposed(frame_b.rotation)
        if closure.kind == "weld":
            off = add(*(cross(axes_a[k], axes_b[k]) for k in range(3)))
            turns = [turn(u, still, dot(u, off) / 2) for u in IDENTITY]
        else:
            turns, axis = [], exact(closure.direction)
            own, other = apply(frame_a.rotation, axis), apply(frame_b.rotation, axis)
            off = cross(own, other)
            for u in axes_a:
                if dot(u, own) ** 2 < mpf("0.5"):
                    turns.append(turn(u, cross(frame_a.spin, u), dot(u, off)))
        return turns + [shift(u, still) for u in IDENTITY]
    normal = exact(closure.direction)
    if closure.kind == "plane":
        row = shift(normal, still)
        friction = mpf(repr(closure.friction))
        along = sub(moving, scaled(dot(normal, moving), normal))
        if friction and any(along):  # It matters in motion alone.
            pull = scaled(-friction / mp.sqrt(dot(along, along)), along)
            row.force = [dot(add(normal, pull), C_b[i]) for i in range(size)]
        return [row]
    # A ball: the material point that touches, at -radius normal from the center, is at rest.
    radius = mpf(repr(closure.size))
    lever = scaled(-radius, normal)
    found = []
    for k, u in enumerate(IDENTITY):
        gradient = [dot(u, add(C_b[i], cross(W_b[i], lever))) for i in range(size)]
        bias = dot(u, add(b.acceleration, cross(frame_b.spin_rate, lever)))
        gap = dot(normal, apart) - radius if abs(normal[k]) == 1 else None
        found.append(Row(gap, gradient, bias, gradient))
    return found


def reported(
    closure: Closure, bodies: dict[str, Frame], values: Sequence
) -> list:
    """The force of a closure in the components of `force_names`, from those of its rows."""
    if closure.kind == "hinge":
        axes = transposed(bodies[closure.body_a].rotation)
        own = apply(bodies[closure.body_a].rotation, exact(closure.direction))
        held = [u for u in axes if dot(u, own) ** 2 < mpf("0.5")]
        moment = add(*(scaled(values[k], u) for k, u in enumerate(held)))
        return [*moment, *values[2:]]
    if closure.kind == "plane":
        normal, friction = exact(closure.direction), mpf(repr(closure.friction))
        force = scaled(values[0], normal)
        if friction:
            moving = bodies[closure.body_b].point(exact(closure.point_b)).velocity
            along = sub(moving, scaled(dot(normal, moving), normal))
            pull = -friction * values[0] / mp.sqrt(dot(along, along))
            force = add(force, scaled(pull, along))
        return force
    return list(values)


def closed(mechanism: Mechanism, q: Sequence) -> list:
    """Positions at which all closures hold, by Newton's method; those that are placed stay."""
    q, size = list(q), mechanism.size
    placed = mechanism.free if mechanism.placed is None else mechanism.placed
    solved = [i for i in range(size) if i not in placed]
    still = [ZERO] * size
    for _ in range(60):
        bodies = frames(mechanism, q, still)
        rows = [
            row for closure in mechanism.closures for row in rows_of(mechanism, closure, bodies, q)
        ]
        rows = [row for row in rows if row.gap is not None]
        if not solved or max(abs(row.gap) for row in rows) < mpf(10) ** (8 - mp.dps):
            return q
        matrix = [[row.gradient[i] for i in solved] for row in rows]
        rank, chosen = rank_and_pivots(matrix)
        if rank < len(solved):
            raise ValueError(f"{mechanism.name}: the free joints do not determine the others")
        step = solve([matrix[k] for k in chosen], [rows[k].gap for k in chosen])
        for i, change in zip(solved, step, strict=True):
            q[i] -= change
    raise ValueError(f"{mechanism.name}: no positions close it near the guess")


@dataclass
class State:
    """Consistent positions and rates, the accelerations, and the forces by name."""

    q: list
    v: list
    acceleration: list
    forces: dict[str, object]


def state(mechanism: Mechanism, q: Sequence | None = None, rates: Sequence | None = None) -> State:
    """All that is asked at closed positions with rates of the free joints; those stated if None."""
    size, free = mechanism.size, list(mechanism.free)
    q = closed(mechanism, exact(mechanism.q)) if q is None else list(q)
    if rates is None:
        rates = [mpf(repr(mechanism.v.get(i, 0.0))) for i in free]
    impact = mechanism.restitution is not None
    still = [ZERO] * size
    at_rest = frames(mechanism, q, still)
    rows = [
        row for closure in mechanism.closures for row in rows_of(mechanism, closure, at_rest, q)
    ]
    bound = [i for i in range(size) if i not in free]
    matrix = [[row.gradient[i] for i in bound] for row in rows]
    rank, chosen = rank_and_pivots(matrix)
    if rank < len(bound):
        raise ValueError(f"{mechanism.name}: the free joints do not determine the others")
    square = [matrix[k] for k in chosen]

    def bound_by(vector: Sequence, rest: Sequence) -> list:
        """The vector with its bound parts so that J vector + rest = 0."""
        right = [
            -rest[k] - sum((rows[k].gradient[i] * vector[i] for i in free), ZERO) for k in chosen
        ]
        whole = list(vector)
        for i, value in zip(bound, solve(square, right), strict=True):
            whole[i] = value
        return whole

    nothing = [ZERO] * len(rows)
    T = [bound_by([mpf(int(i == j)) for i in range(size)], nothing) for j in free]
    if impact:
        before = exact(mechanism.approach)
        rate = [sum((g * x for g, x in zip(row.gradient, before, strict=True)), ZERO)
                for row in rows]  # fmt: skip
        rest = [mpf(repr(mechanism.restitution)) * value for value in rate]
        v, bodies = before, frames(mechanism, q, before)
    else:
        v = [ZERO] * size
        for column, value in zip(T, rates, strict=True):
            v = [x + value * c for x, c in zip(v, column, strict=True)]
        bodies = frames(mechanism, q, v)
        rows = [
            row for closure in mechanism.closures for row in rows_of(mechanism, closure, bodies, q)
        ]
        rest = [row.bias for row in rows]
    gamma = bound_by(still, rest)
    M, h = balance(mechanism, bodies)
    if impact:
        h = [-sum((m * x for m, x in zip(line, v, strict=True)), ZERO) for line in M]
    # M T a - G f = -h - M gamma, with the forces of the chosen rows alone.
    MT = [[sum((line[i] * column[i] for i in range(size)), ZERO) for line in M] for column in T]
    lines, right = [], []
    for i in range(size):
        lines.append([column[i] for column in MT] + [-rows[k].force[i] for k in chosen])
        right.append(-h[i] - sum((M[i][j] * gamma[j] for j in range(size)), ZERO))
    found = solve(lines, right)
    fewest, force = found[: len(free)], found[len(free) :]
    acceleration = list(gamma)
    for column, value in zip(T, fewest, strict=True):
        acceleration = [x + value * c for x, c in zip(acceleration, column, strict=True)]
    values = [ZERO] * len(rows)
    for k, value in zip(chosen, force, strict=True):
        values[k] = value
    if rank < len(rows):
        values = least(rows, bound, chosen, force)
    forces, start = {}, 0
    for closure in mechanism.closures:
        count = len(rows_of(mechanism, closure, bodies, q))
        own = reported(closure, bodies, values[start : start + count])
        forces.update(zip(force_names(closure), own, strict=True))
        start += count
    return State(q, v, acceleration, forces)


def least(rows: list[Row], bound: list[int], chosen: list[int], force: Sequence) -> list:
    """The forces of all rows with the same sum and the least sum of squares: f = G^T y."""
    total = [
        sum((rows[k].gradient[i] * f for k, f in zip(chosen, force, strict=True)), ZERO)
        for i in bound
    ]
    G = [[row.gradient[i] for row in rows] for i in bound]
    product = [[sum((x * y for x, y in zip(a, b, strict=True)), ZERO) for b in G] for a in G]
    y = solve(product, total)
    return [
        sum((y[i] * G[i][k] for i in range(len(bound))), ZERO) for k in range(len(rows))
    ]
