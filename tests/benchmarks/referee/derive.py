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


def all_rows(mechanism: Mechanism, bodies: dict[str, Frame], q: Sequence) -> list[Row]:
    """The equations of all closures."""
    return [row for closure in mechanism.closures for row in rows_of(mechanism, closure, bodies, q)]


def closed(mechanism: Mechanism, q: Sequence) -> list:
    """Positions at which all closures hold, by Newton's method; those that are placed stay."""
    q, size = list(q), mechanism.size
    placed = mechanism.free if mechanism.placed is None else mechanism.placed
    solved = [i for i in range(size) if i not in placed]
    still = [ZERO] * size
    for _ in range(60):
        bodies = frames(mechanism, q, still)
        rows = [row for row in all_rows(mechanism, bodies, q) if row.gap is not None]
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


class Reduction:
    """How the free joints determine the others where J x + rest = 0.

    Attributes:
        free, bound: The joints that are free, and the others.
        rows: All equations.
        chosen: The numbers of as many independent ones as there are bound joints.
        T: For each free joint all rates for its unit rate.
    """

    def __init__(self, mechanism: Mechanism, rows: list[Row]) -> None:
        self.free, self.rows, size = list(mechanism.free), rows, mechanism.size
        self.bound = [i for i in range(size) if i not in self.free]
        matrix = [[row.gradient[i] for i in self.bound] for row in rows]
        rank, self.chosen = rank_and_pivots(matrix)
        if rank < len(self.bound):
            raise ValueError(f"{mechanism.name}: the free joints do not determine the others")
        self._square = [matrix[k] for k in self.chosen]
        nothing = [ZERO] * len(rows)
        units = [[mpf(int(i == j)) for i in range(size)] for j in self.free]
        self.T = [self.completed(unit, nothing) for unit in units]

    def completed(self, vector: Sequence, rest: Sequence) -> list:
        """The vector with its bound parts so that J vector + rest = 0."""
        right = []
        for k in self.chosen:
            gradient = self.rows[k].gradient
            right.append(-rest[k] - sum((gradient[i] * vector[i] for i in self.free), ZERO))
        whole = list(vector)
        for i, value in zip(self.bound, solve(self._square, right), strict=True):
            whole[i] = value
        return whole

    def combined(self, start: Sequence, fewest: Sequence) -> list:
        """start + T fewest."""
        whole = list(start)
        for column, value in zip(self.T, fewest, strict=True):
            whole = [x + value * c for x, c in zip(whole, column, strict=True)]
        return whole


def state(mechanism: Mechanism, q: Sequence | None = None, rates: Sequence | None = None) -> State:
    """All that is asked at closed positions with rates of the free joints; those stated if None."""
    q = closed(mechanism, exact(mechanism.q)) if q is None else list(q)
    still = [ZERO] * mechanism.size
    rows = all_rows(mechanism, frames(mechanism, q, still), q)
    reduction = Reduction(mechanism, rows)
    if rates is None:
        rates = [mpf(repr(mechanism.v.get(i, 0.0))) for i in mechanism.free]
    v = reduction.combined(reduction.completed(still, [-row.drive for row in rows]), rates)
    bodies = frames(mechanism, q, v)
    rows = all_rows(mechanism, bodies, q)
    rest = [row.bias for row in rows]
    M, h = balance(mechanism, bodies)
    gamma = reduction.completed(still, rest)
    # M T a - G f = -h - M gamma, with the forces of the chosen rows alone.
    MT = [[total(line, column) for line in M] for column in reduction.T]
    lines, right = [], []
    for i in range(mechanism.size):
        lines.append([column[i] for column in MT] + [-rows[k].force[i] for k in reduction.chosen])
        right.append(-h[i] - total(M[i], gamma))
    found = solve(lines, right)
    count = len(mechanism.free)
    values = shared(reduction, rows, found[count:])
    return State(
        q, v, reduction.combined(gamma, found[:count]), named(mechanism, bodies, rows, values)
    )


def named(
    mechanism: Mechanism, bodies: dict[str, Frame], rows: list[Row], values: Sequence
) -> dict[str, object]:
    """The forces of all closures by their names."""
    forces, start = {}, 0
    for closure in mechanism.closures:
        count = sum(row.closure is closure for row in rows)
        own = reported(closure, bodies, values[start : start + count])
        forces.update(zip(force_names(closure), own, strict=True))
        start += count
    return forces


def shared(reduction: Reduction, rows: list[Row], force: Sequence) -> list:
    """The forces of all rows: f = G^T y, with the sum that those of the chosen rows have.

    It has the least sum of squares of all f with the same G f.
    """
    values = [ZERO] * len(rows)
    for k, value in zip(reduction.chosen, force, strict=True):
        values[k] = value
    if len(reduction.chosen) == len(rows):
        return values
    G = [[row.gradient[i] for row in rows] for i in reduction.bound]
    product = [[total(a, b) for b in G] for a in G]
    y = solve(product, [total(line, values) for line in G])
    return [total(y, column) for column in zip(*G, strict=True)]


def total(a: Sequence, b: Sequence) -> object:
    """The scalar product; most entries are zero."""
    return sum((x * y for x, y in zip(a, b, strict=True) if x and y), ZERO)
