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

from referee.closures import Row, reported, rows_of
from referee.description import Mechanism, force_names
from referee.kinematics import ZERO, Frame, frames
from referee.vectors import add, cross, dot, exact, rank_and_pivots, scaled, solve, sub, transposed


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
    return [sum((y[i] * G[i][k] for i in range(len(bound))), ZERO) for k in range(len(rows))]
