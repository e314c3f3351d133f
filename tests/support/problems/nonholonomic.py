"""Blades and wheels: constraints of velocities that are none of positions."""

from collections.abc import Sequence

import casadi as ca
import numpy as np

from drake_dae.dae import DaeSystem
from problems.problem import Array, Known, Problem, known


def _sleigh(outputs, matrix, names: Sequence[str]) -> DaeSystem:
    mass, inertia = 3.0, 0.4
    return DaeSystem.from_functions(
        ["x", "y", "heading", "vx", "vy", "w"],
        f=lambda x: [x[3], x[4], x[5], 0, 0, 0],
        g=lambda x: [0, 0, 0, -ca.sin(x[2]) / mass, ca.cos(x[2]) / mass, 0],
        h=lambda x: [
            [0, 0],
            [0, 0],
            [0, 0],
            [ca.cos(x[2]) / mass, 0],
            [ca.sin(x[2]) / mass, 0],
            [0, 1 / inertia],
        ],
        k=lambda x: -ca.sin(x[2]) * x[3] + ca.cos(x[2]) * x[4],
        l=outputs,
        m=lambda x: matrix,
        output_signals=names,
        nominal_state=[0.0, 0.0, 0.3, 0.8 * np.cos(0.3), 0.8 * np.sin(0.3), 1.0],
        name="knife edge",
    )


def _sleigh_state(random: np.random.Generator) -> Array:
    x, y, heading, speed, rate = random.uniform(0.5, 1.5, 5)
    return np.array([x, y, heading, speed * np.cos(heading), speed * np.sin(heading), rate])


def _sleigh_derivatives(x: Array) -> Array:
    return np.array([-np.sin(x[2]) * x[3] + np.cos(x[2]) * x[4]])


def knife_edge() -> Problem:
    """A knife edge on ice (Bloch, 1.7): a nonholonomic constraint, r = 1, v is the lateral force.

    k = -s vx + c vy, k' = -w V + v/m with the forward speed V = c vx + s vy: alpha = m w V. Neither
    the thrust u1 nor the torque u2 acts on k': beta is zero, though not by its structure, since
    -s c + c s is left. z = (heading, V), mu = (2, 1); V' = u1/m + w k. Position is left as xi.
    """
    mass, inertia = 3.0, 0.4

    def closed_form(x: Array) -> Known:
        speed = np.cos(x[2]) * x[3] + np.sin(x[2]) * x[4]
        return known(
            1 / mass,
            mass * x[5] * speed,
            [[0, 0]],
            [0, x[5] * _sleigh_derivatives(x)[0]],
            [[0, 1 / inertia], [1 / mass, 0]],
        )

    return Problem(
        system=_sleigh(
            lambda x: [x[2], ca.cos(x[2]) * x[3] + ca.sin(x[2]) * x[4]], [0, 0], ["heading", "V"]
        ),
        constraint_degrees=(1,),
        output_degrees=(2, 1),
        index=2,
        zero_dynamics=2,
        output_order=(0, 1),
        known=closed_form,
        consistent=_sleigh_state,
        reference=[(0.5, 0.0, 0.5), (1.0, 0.0, 0.3)],
        derivatives=_sleigh_derivatives,
        source="Bloch, Nonholonomic Mechanics and Control, 2003, chapter 1: the knife edge",
    )


def knife_edge_force() -> Problem:
    """The knife edge with z = (lateral force, heading).

    z1 = v = m w V is met at once only in appearance: n* = beta is zero except for round-off. So
    mu = (1, 2): (m w V)' = m V u2/I + w u1 (+ m w^2 k off N*), regular while w is not 0.
    """
    mass, inertia = 3.0, 0.4

    def closed_form(x: Array) -> Known:
        speed = np.cos(x[2]) * x[3] + np.sin(x[2]) * x[4]
        return known(
            1 / mass,
            mass * x[5] * speed,
            [[0, 0]],
            [mass * x[5] ** 2 * _sleigh_derivatives(x)[0], 0],
            [[x[5], mass * speed / inertia], [0, 1 / inertia]],
        )

    return Problem(
        system=_sleigh(lambda x: [0, x[2]], [1, 0], ["force", "heading"]),
        constraint_degrees=(1,),
        output_degrees=(1, 2),
        index=2,
        zero_dynamics=2,
        output_order=(0, 1),
        known=closed_form,
        consistent=_sleigh_state,
        reference=[(3.0, 0.0, 0.5), (0.5, 1.0, 0.1)],
        derivatives=_sleigh_derivatives,
    )


def rolling_disk() -> Problem:
    """An upright disk that rolls without slipping: two nonholonomic constraints, r = (1, 1).

    k = (vx - R c W, vy - R s W), v is the force on the rim. d(k)/dt = R w W (s, -c) + A v - R u1/I
    (c, s) with A = 1/m + R^2/I (c, s) (c, s)', which has the eigenvectors (s, -c) and (c, s). So
    alpha = -m R w W (s, -c), beta = m R/(I + m R^2) (c, s), and (I + m R^2) W' = u1, J w' = u2.
    """
    m, inertia, spin, radius = 2.0, 0.09, 0.05, 0.3
    whole = inertia + m * radius**2
    system = DaeSystem.from_functions(
        ["x", "y", "heading", "roll", "vx", "vy", "w", "W"],
        f=lambda x: [x[4], x[5], x[6], x[7], 0, 0, 0, 0],
        g=lambda x: [
            *[[0, 0]] * 4,
            [1 / m, 0],
            [0, 1 / m],
            [0, 0],
            [-radius * ca.cos(x[2]) / inertia, -radius * ca.sin(x[2]) / inertia],
        ],
        h=lambda x: [*[[0, 0]] * 6, [0, 1 / spin], [1 / inertia, 0]],
        k=lambda x: [x[4] - radius * ca.cos(x[2]) * x[7], x[5] - radius * ca.sin(x[2]) * x[7]],
        l=lambda x: [x[2], x[3]],
        m=lambda x: [[0, 0], [0, 0]],
        output_signals=["heading", "roll"],
        name="rolling disk",
    )

    def closed_form(x: Array) -> Known:
        s, c = np.sin(x[2]), np.cos(x[2])
        along, across = np.array([c, s]), np.array([s, -c])
        return known(
            np.eye(2) / m + radius**2 / inertia * np.outer(along, along),
            -m * radius * x[6] * x[7] * across,
            np.column_stack([m * radius / whole * along, [0, 0]]),
            [0, 0],
            [[0, 1 / spin], [1 / whole, 0]],
        )

    def consistent(random: np.random.Generator) -> Array:
        x, y, heading, roll, w, spun = random.uniform(-1.0, 1.0, 6)
        speed = radius * spun
        return np.array(
            [x, y, heading, roll, speed * np.cos(heading), speed * np.sin(heading), w, spun]
        )

    def derivatives(x: Array) -> Array:
        speed = radius * x[7]
        return np.array([x[4] - np.cos(x[2]) * speed, x[5] - np.sin(x[2]) * speed])

    return Problem(
        system=system,
        constraint_degrees=(1, 1),
        output_degrees=(2, 2),
        index=2,
        zero_dynamics=2,
        output_order=(0, 1),
        known=closed_form,
        consistent=consistent,
        reference=[(0.5, 0.0, 0.5), (0.0, 1.0, 0.5)],
        derivatives=derivatives,
        source="Bloch, Nonholonomic Mechanics and Control, 2003, 1.4: the vertical rolling disk",
    )
