"""Configurations of a robot on its constraints, by inverse kinematics, and their quality."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.parsing import GetScopedFrameByName
from pydrake.multibody.tree import WeldJoint

from drake_dae.arrays import FloatArray
from drake_dae.dae.contacts import critical_factor
from drake_dae.errors import ModelError
from drake_dae.robots import ConstraintSet, LinkDepths, Links, LoopState, Touch
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.numerics import newton, shortest_steps

INDEPENDENT = 0.02
"""Rows with an `independence` below this are dependent or nearly so."""

_EXACT = 1e-9
"""The allowed residual of equations in m, rad or 1."""

_NEAR_LIMIT, _NEWTON_STEPS = 0.1, 25
"""A joint within this fraction of its range from a limit is close to it; the largest number of
Newton steps from a guess: a good one takes six."""


@dataclass(frozen=True, eq=False)
class Posture:
    """A configuration q, shape (nq,), with the values of its rows: functions of q, c of them."""

    q: FloatArray
    rows: FloatArray  # (c,)
    gradients: FloatArray  # (c, nv), rates of the rows per unit of v.
    constraints: FloatArray  # (m, nv), those of the constraints.
    forces: FloatArray  # (s, m), S of the force outputs.
    mass: FloatArray  # (nv, nv), M(q).
    actuation: FloatArray  # (nv, nu), the generalized force per unit of each control.
    normals: FloatArray  # (contacts, 3), of the surfaces.
    leans: FloatArray  # The cosine between the outward axis of each tool and its surface's normal.
    depth: float  # The largest one of a link behind a surface, m.

    def independence(self, rows: Sequence[int]) -> float:
        """How independently the controls act on some rows and the force outputs, from 0 to 1.

        It is the smallest singular value of B(x) of (16), in coordinates M^(1/2) v and M^(-1/2) B_u
        in place of v and B_u. Each row is divided by its length without constraints, so that units
        and lever lengths do not matter. It is 1 for fully independent rows, and 0 if B is singular.
        """
        of_rows, of_forces = self._control
        B = np.vstack([of_rows[list(rows)], of_forces])
        regular = len(B) <= B.shape[1]
        return float(np.min(np.linalg.svd(B, compute_uv=False), initial=1.0)) if regular else 0.0

    @cached_property
    def _control(self) -> tuple[FloatArray, FloatArray]:
        """The rows of B(x) of `independence`: of all rows, and of the force outputs."""

        def one_long(rows: FloatArray, scaled: FloatArray) -> FloatArray:
            length = np.linalg.norm(rows, axis=1, keepdims=True)
            return scaled / np.where(length > 1e-9, length, np.inf)

        right = np.vstack([self.constraints, self.gradients, self.actuation.T]).T
        weighted = np.linalg.solve(np.linalg.cholesky(self.mass), right).T
        J, P, drives = np.split(weighted, np.cumsum([len(self.constraints), len(self.gradients)]))
        Q = np.linalg.qr(drives.T)[0]
        inverse = np.linalg.pinv(J, 1e-9)  # J^T (J M^-1 J^T)^-1 in these units.
        F = self.forces @ inverse.T
        return one_long(P, P - P @ inverse @ J) @ Q, one_long(F, F) @ Q

    def critical_friction(self, contact: int, rows: Sequence[int]) -> float:
        """The friction from which a contact may jam; the rows are the place of its point.

        Sliding friction mu moves the point into the surface if mu |A_nt| > A_nn (Painleve), with
        its mobility A = J M^-1 J^T; near a singular wrist A_nn is small.
        """
        J, normal = self.gradients[list(rows)], self.normals[contact]
        A_n = J @ np.linalg.solve(self.mass, J.T @ normal)
        A_nn = normal @ A_n
        A_nt = float(np.linalg.norm(A_n - A_nn * normal))
        return critical_factor(np.array([[A_nn]]), np.array([[A_nt]]), [0])

    def independent(self, rows: Sequence[int], more: Iterable[int], count: int) -> list[int]:
        """The first rows of `more`, at most `count`, independent of `rows` and of each other."""
        chosen: list[int] = []
        for row in more:
            if len(chosen) < count and self.independence([*rows, *chosen, row]) > INDEPENDENT:
                chosen.append(row)
        return chosen


class Postures:
    """The configurations of a robot with constraints: `low` and `high` limits of q, shape (nq,).

    `size` is the largest distance between its bodies, in m, in its default configuration.
    """

    def __init__(
        self,
        links: Links,
        bound: ConstraintSet,
        rows: ca.SX,
        forces: ca.SX,
        touches: Sequence[tuple[Touch, ca.SX]],
        values: Mapping[str, FloatArray],
    ) -> None:
        parameters, kinematics = (*links.parameters, *bound.parameters), links.kinematics()
        residual, rate = bound.residual(links), kinematics.value(bound.rate(kinematics))
        equations = ca.vertcat(residual, rows)
        inputs = {"q": links.q, "parameters": ca.vertcat(*[p.symbol for p in parameters])}
        # Newton's method needs neither M nor the bodies.
        self._equations = TracedFunction("equations of postures", inputs, {"values": equations})
        slopes = ca.jacobian(equations, links.q)
        self._slopes = TracedFunction("slopes of postures", inputs, {"slopes": slopes})
        self._count = residual.numel()
        drives = ca.SX(ca.DM(links.actuation_matrix)), LoopState(bound, links).motors
        outputs = {
            "rows": rows,
            "gradients": ca.mtimes(slopes[self._count :, :], links.velocity_map),
            "constraints": ca.jacobian(rate, links.v),
            "forces": forces,
            "mass": links.mass_matrix,
            "actuation": ca.horzcat(*drives),
            "normals": ca.horzcat(ca.SX(3, 0), *[touch.normal for touch, _ in touches]).T,
            "leans": ca.vertcat(ca.SX(0, 1), *[ca.dot(t.normal, axis) for t, axis in touches]),
        }
        self._shapes = {name: value.shape for name, value in outputs.items()}
        self._shapes |= {"rows": (-1,), "leans": (-1,)}
        self._function = TracedFunction("postures", inputs, outputs)
        by_place = {str(place): touch for place, (touch, _) in enumerate(touches)}
        self._depths = LinkDepths(links, by_place, inputs["parameters"])
        sized = [np.zeros(0)]
        for p in parameters:
            value = np.atleast_1d(values.get(p.name, p.value))
            if value.size not in (1, p.value.size):
                raise ModelError(f"{p.name}: {p.value.size} numbers are needed, got {value.size}")
            sized.append(np.broadcast_to(value, (p.value.size,)))
        self._parameters = np.concatenate(sized)
        self.low, self.high = links.position_limits
        self._turns = np.array([signal.unit == "rad" for signal in links.position_signals])
        places = ca.Function("places", [*inputs.values()], [links.landmarks()])
        points = places(links.default_positions, self._parameters).full()
        self.size = float(np.max(np.ptp(points, axis=1))) or 1.0

    def at(self, q: FloatArray) -> Posture:
        """The posture of a configuration."""
        values = zip(self._shapes.items(), self._function(q, self._parameters), strict=True)
        shaped = {name: value.reshape(shape) for (name, shape), value in values}
        depths = self._depths.at(q, self._parameters).values()
        depth = max((float(np.max(of_links)) for of_links in depths), default=0.0)
        return Posture(q=q, depth=depth, **shaped)

    def solve(
        self, rows: Sequence[int], wanted: FloatArray, guess: FloatArray
    ) -> FloatArray | None:
        """A configuration on the constraints in which some rows have given values, near a guess."""
        chosen = np.concatenate([np.arange(self._count), self._count + np.array(rows, dtype=int)])
        goal, parameters = np.concatenate([np.zeros(self._count), wanted]), self._parameters

        def residual(q: FloatArray) -> FloatArray:
            return self._equations.evaluate(q, parameters)[0][chosen] - goal

        def slopes(q: FloatArray) -> FloatArray:
            return self._slopes.evaluate(q, parameters)[0].reshape(-1, q.size)[chosen]

        q = newton(guess, lambda q: shortest_steps(slopes(q), residual), _NEWTON_STEPS)[0]
        is_fine = (self._room(q) >= 0.0) & np.isfinite(self.high - self.low)
        near = unwound(q, np.zeros(q.size), (self.low, self.high), self._turns & ~is_fine)
        for found in (near, q):  # Where a row is the position of a joint, turns matter.
            left = np.max(np.abs(residual(found)), initial=0.0)
            if left < _EXACT and np.all(self._room(found) >= -_EXACT):
                return found
        return None

    def _room(self, q: FloatArray) -> FloatArray:
        """The distance of each position from its nearer limit, shape (nq,)."""
        return np.minimum(q - self.low, self.high - q)

    def margin(self, q: FloatArray) -> float:
        """1 if no joint is close to a limit, 0 if one is at it or beyond."""
        span = self.high - self.low
        bounded = np.isfinite(span) & (span > 0.0)
        share = self._room(q)[bounded] / (_NEAR_LIMIT * span[bounded])
        return float(np.clip(np.min(share, initial=1.0), 0.0, 1.0))

    def quality(self, posture: Posture, rows: Sequence[int]) -> float:
        """The quality of a posture for a task: `independence` of the rows times `margin`.

        A link behind a surface, or a tool that points away from its surface, reduces it to a tenth.
        """
        faults = (posture.depth > 0.0) + (np.max(posture.leans, initial=-1.0) > 0.0)
        return posture.independence(rows) * self.margin(posture.q) * 0.1 ** int(faults)

    def guesses(self, count: int) -> FloatArray:
        """Random configurations within the limits, shape (count, nq); the same in each call."""
        random = np.random.default_rng(0)
        reach = np.where(self._turns, np.pi, self.size)
        low, high = np.maximum(self.low, -reach), np.minimum(self.high, reach)
        empty = low > high  # Limits wider than a turn.
        low, high = np.where(empty, self.low, low), np.where(empty, self.high, high)
        inset = 0.5 * _NEAR_LIMIT * (high - low)
        return random.uniform(low + inset, high - inset, (count, low.size))


def unwound(
    q: FloatArray, near: FloatArray, limits: tuple[FloatArray, FloatArray], turns: NDArray[np.bool_]
) -> FloatArray:
    """A configuration whose turning joints are as near to others as whole turns permit."""
    nearest = q - 2 * np.pi * np.round((q - near) / (2 * np.pi))
    choices = nearest + 2 * np.pi * np.array([[0.0], [-1.0], [1.0]])
    is_inside = (limits[0] <= choices) & (choices <= limits[1])
    off = np.where(is_inside, np.abs(choices - near), np.inf)
    best = np.take_along_axis(choices, off.argmin(axis=0)[None], axis=0)[0]
    return np.where(turns & is_inside.any(axis=0), best, q)


def tool_axis(links: Links, touch: Touch) -> tuple[int, float]:
    """The axis (0, 1, 2) of the touching frame along which the tool sticks out, and its sign.

    It is the axis closest to the line from the last joint that moves to the touching point; z where
    the point is at the joint, which is what vendors mean by it.
    """
    plant = links.plant
    if plant is None:
        return 2, 1.0
    frame = GetScopedFrameByName(plant, touch.frame)
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    above = {joint.child_body().index(): joint for joint in joints}
    body = frame.body()
    while isinstance(joint := above.get(body.index()), WeldJoint):
        body = joint.parent_body()
    origin = joint.frame_on_child() if joint else body.body_frame()
    pose = origin.CalcPose(plant.CreateDefaultContext(), frame)
    offset = np.array(touch.point) - pose.translation()
    largest = int(np.argmax(np.abs(offset)))
    if abs(offset[largest]) < 1e-6:
        return 2, 1.0
    return largest, float(np.sign(offset[largest]))
