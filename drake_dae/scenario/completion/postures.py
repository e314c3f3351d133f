"""Postures of a robot, and their quality for a task."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.layout import Indices
from drake_dae.dae.system.signals import Parameter
from drake_dae.errors import ModelError
from drake_dae.robots.constraints.constraint import Touch
from drake_dae.robots.constraints.constraint_set import ConstraintSet
from drake_dae.robots.links.links import Links
from drake_dae.robots.links_behind import LinkDepths
from drake_dae.robots.loop_state import LoopState
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.newton import NewtonModel, newton, shortest_steps

EXACT = 1e-9
"""The allowed residual of equations in m, rad or 1."""

NEAR_LIMIT = 0.1
"""A joint within this fraction of its range from a limit counts as close to it."""

_NEWTON_STEPS = 25
"""The largest number of Newton steps from a guess; a good guess takes six."""


@dataclass(frozen=True, eq=False)
class Posture:
    """A configuration with its properties.

    A row is one scalar function of q that may be an output.

    Attributes:
        q: The configuration, shape (nq,).
        rows: The values of all rows, shape (c,).
        left: The residual of the constraints, shape (k,).
        slopes: The gradients of the rows with respect to q, shape (c, nq).
        constraint_slopes: The gradients of the constraints with respect to q, shape (k, nq).
        gradients: The rates of the rows per unit of v, shape (c, nv).
        constraints: The rates of the constraints per unit of v, shape (m, nv).
        forces: S of the force outputs, shape (s, m).
        mass: M(q), shape (nv, nv).
        actuation: The generalized force per unit of each control, shape (nv, nu).
        depth: The largest depth of a link behind a surface, in m.
        normals: The unit normal of each surface at its contact, stacked.
        leans: The cosine between the outward axis of each tool and its surface's normal.
    """

    q: FloatArray
    rows: FloatArray
    left: FloatArray
    slopes: FloatArray
    constraint_slopes: FloatArray
    gradients: FloatArray
    constraints: FloatArray
    forces: FloatArray
    mass: FloatArray
    actuation: FloatArray
    depth: float
    normals: FloatArray
    leans: FloatArray

    def independence(self, rows: Sequence[int]) -> float:
        """How independently the controls act on some rows and the force outputs, from 0 to 1.

        It is the smallest singular value of B(x) of (16), in coordinates M^(1/2) v and M^(-1/2) B_u
        in place of v and B_u. Each row is divided by its length without constraints, so that units
        and lever lengths do not matter. It is 1 for fully independent rows, and 0 if B is singular.
        """
        of_rows, of_forces = self._control
        B = np.vstack([of_rows[list(rows)], of_forces])
        if len(B) > B.shape[1]:
            return 0.0
        return float(np.min(np.linalg.svd(B, compute_uv=False), initial=1.0))

    @cached_property
    def _control(self) -> tuple[FloatArray, FloatArray]:
        """The rows of B(x) of `independence`: of all rows, and of the force outputs."""
        lower, nv = np.linalg.cholesky(self.mass), len(self.mass)
        right = np.vstack([self.constraints, self.gradients, self.actuation.T]).T
        weighted = np.linalg.solve(lower, right).T
        J, P, drives = np.split(weighted, np.cumsum([len(self.constraints), len(self.gradients)]))
        Q = np.linalg.qr(drives.T)[0]
        inverse = np.linalg.pinv(J, 1e-9)  # J^T (J M^-1 J^T)^-1 in these units.
        F = (self.forces @ inverse.T) if len(self.forces) else np.zeros((0, nv))
        return _one_long(P, P - P @ inverse @ J) @ Q, _one_long(F, F) @ Q


def _value_of(parameter: Parameter, values: Mapping[str, FloatArray]) -> FloatArray:
    """The value of a parameter; a single number is the value of all its entries.

    Raises:
        ModelError: The size is wrong.
    """
    value, size = values.get(parameter.name, parameter.value), parameter.value.size
    if value.size not in (1, size):
        raise ModelError(f"{parameter.name}: {size} numbers are needed, got {value.size}")
    return np.broadcast_to(value, (size,))


def _one_long(rows: FloatArray, scaled: FloatArray) -> FloatArray:
    """Divides `scaled` by the lengths of `rows`, row by row; 0 where a length is 0."""
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    return scaled / np.where(length > 1e-9, length, np.inf)


class Postures:
    """The configurations of a robot with constraints.

    Args:
        links: The robot.
        bound: The constraints.
        rows: h(q), the possible outputs, shape (c, 1).
        forces: S of the force outputs, shape (s, m).
        touches: The contacts with a free side, with the outward axis of the tool in the world,
            shape (3, 1).
        values: Parameter name -> value, for the parameters that differ from their defaults.

    Attributes:
        low, high: The limits of q, shape (nq,) each.
        size: The largest distance between its bodies, in m, in its default configuration.
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
        parameters: tuple[Parameter, ...] = (*links.parameters, *bound.parameters)
        kinematics = links.kinematics()
        residual, rate = bound.residual(links), kinematics.value(bound.rate(kinematics))
        rows = ca.vertcat(ca.SX(0, 1), rows)
        slopes = ca.jacobian(rows, links.q)
        bodies = links.landmarks()
        motors = LoopState.of(bound, links).motors
        inputs = {"q": links.q, "parameters": ca.vertcat(*[p.symbol for p in parameters])}
        constraint_slopes = ca.jacobian(residual, links.q)
        # Newton's method needs neither M nor the bodies.
        self._equations = TracedFunction(
            "equations of postures", inputs, {"values": ca.vertcat(residual, rows)}
        )
        self._equation_slopes = TracedFunction(
            "slopes of postures", inputs, {"slopes": ca.vertcat(constraint_slopes, slopes)}
        )
        self._count = residual.numel()
        self._function = TracedFunction(
            "postures",
            inputs,
            {
                "rows": rows,
                "left": residual,
                "slopes": slopes,
                "constraint_slopes": constraint_slopes,
                "gradients": ca.mtimes(slopes, links.velocity_map),
                "constraints": ca.jacobian(rate, links.v),
                "forces": forces,
                "mass": links.mass_matrix,
                "actuation": ca.horzcat(ca.SX(ca.DM(links.actuation_matrix)), motors),
                "normals": ca.vertcat(ca.SX(0, 1), *[touch.normal for touch, _ in touches]),
                "leans": ca.vertcat(ca.SX(0, 1), *[ca.dot(t.normal, axis) for t, axis in touches]),
                "bodies": bodies,
            },
        )
        by_place = {str(place): touch for place, (touch, _) in enumerate(touches)}
        self._depths = LinkDepths(links, by_place, inputs["parameters"])
        self._parameters = np.concatenate([_value_of(p, values) for p in parameters])
        self.low, self.high = links.position_limits
        self._turns = np.array([signal.unit == "rad" for signal in links.position_signals])
        points = self._values(links.default_positions)["bodies"]
        self.size = float(np.max(np.ptp(points, axis=1))) or 1.0

    def _values(self, q: FloatArray) -> dict[str, FloatArray]:
        results = self._function(q, self._parameters)
        nq = q.size
        values = dict(zip(self._function.output_names, results, strict=True))
        # A matrix of one row or column comes as a vector.
        for name in ("slopes", "constraint_slopes", "gradients", "constraints", "mass"):
            values[name] = values[name].reshape(-1, nq)
        values["actuation"] = values["actuation"].reshape(nq, -1)
        values["forces"] = values["forces"].reshape(-1, max(1, len(values["constraints"])))
        return values

    def at(self, q: FloatArray) -> Posture:
        """The posture of a configuration."""
        values = self._values(q)
        del values["bodies"]
        depths = self._depths.at(q, self._parameters).values()
        depth = max((float(np.max(of_links)) for of_links in depths), default=0.0)
        return Posture(q=q, depth=depth, **values)

    def solve(self, rows: Sequence[int], wanted: FloatArray, guess: FloatArray) -> FloatArray:
        """Solves for a configuration on the constraints in which some rows have given values.

        Args:
            rows: The rows.
            wanted: Their values.
            guess: The initial guess of Newton's method, shape (nq,).

        Returns:
            q, shape (nq,). It may not be a solution: check it with `left`.
        """
        chosen, goal = self._goal(rows, wanted)

        def residual(q: FloatArray) -> FloatArray:
            return self._equations.evaluate(q, self._parameters)[0][chosen] - goal

        def linearize(q: FloatArray) -> NewtonModel | None:
            slopes = self._equation_slopes.evaluate(q, self._parameters)[0]
            return shortest_steps(slopes.reshape(-1, q.size)[chosen], residual)

        q = newton(guess, linearize, _NEWTON_STEPS)[0]
        turned = self._turned_back(q)
        # If a row is the position of a joint, whole turns are no other solution.
        return turned if np.max(np.abs(residual(turned)), initial=0.0) < EXACT else q

    def left(self, rows: Sequence[int], wanted: FloatArray, q: FloatArray) -> FloatArray:
        """The residual of the equations of `solve`, shape (k + len(rows),)."""
        chosen, goal = self._goal(rows, wanted)
        return self._equations.evaluate(q, self._parameters)[0][chosen] - goal

    def _goal(self, rows: Sequence[int], wanted: FloatArray) -> tuple[Indices, FloatArray]:
        """The entries of the equations in which constraints hold and rows have given values."""
        chosen = np.concatenate([np.arange(self._count), self._count + np.array(rows, dtype=int)])
        return chosen, np.concatenate([np.zeros(self._count), wanted])

    def _turned_back(self, q: FloatArray) -> FloatArray:
        """Removes whole turns from a configuration, as far as the limits permit."""
        turned = q - 2 * np.pi * np.round(q / (2 * np.pi)) * self._turns
        for shift in (-2 * np.pi, 2 * np.pi):
            moved = turned + shift * self._turns
            is_better = (self._room(turned) < 0.0) & (self._room(moved) >= 0.0)
            turned = np.where(is_better, moved, turned)
        is_fine = (self._room(q) >= 0.0) & np.isfinite(self.high - self.low)
        return np.where(is_fine, q, turned)

    def _room(self, q: FloatArray) -> FloatArray:
        """The distance of each position from its nearer limit, shape (nq,)."""
        return np.minimum(q - self.low, self.high - q)

    def is_inside(self, q: FloatArray) -> bool:
        """Whether all joints are within their limits."""
        return bool(np.all(self._room(q) >= -1e-9))

    def margin(self, q: FloatArray) -> float:
        """1 if no joint is close to a limit, 0 if one is at it or beyond."""
        span = self.high - self.low
        bounded = np.isfinite(span) & (span > 0.0)
        share = self._room(q)[bounded] / (NEAR_LIMIT * span[bounded])
        return float(np.clip(np.min(share, initial=1.0), 0.0, 1.0))

    def quality(self, posture: Posture, rows: Sequence[int]) -> float:
        """The quality of a posture for a task: `independence` of the rows times `margin`.

        A link behind a surface, or a tool that points away from its surface, reduces it to a tenth.
        """
        quality = posture.independence(rows) * self.margin(posture.q)
        if posture.depth > 0.0:
            quality *= 0.1
        if np.max(posture.leans, initial=-1.0) > 0.0:
            quality *= 0.1
        return quality

    def guesses(self, count: int) -> FloatArray:
        """Random configurations within the limits, shape (count, nq); the same in each call."""
        random = np.random.default_rng(0)
        reach = np.where(self._turns, np.pi, self.size)
        low, high = np.maximum(self.low, -reach), np.minimum(self.high, reach)
        empty = low > high  # Limits wider than a turn.
        low, high = np.where(empty, self.low, low), np.where(empty, self.high, high)
        inset = 0.5 * NEAR_LIMIT * (high - low)
        return random.uniform(low + inset, high - inset, (count, low.size))
