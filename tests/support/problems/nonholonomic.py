"""Blades: constraints of velocities that are none of positions."""

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
