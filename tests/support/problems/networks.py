"""Circuits and power lines."""

import casadi as ca
import numpy as np

from drake_dae.dae import DaeSystem, Signal
from problems.problem import Array, Known, Problem, known


def circuit() -> Problem:
    """Two coils in series behind a source u, then a capacitor: an inductor cutset, index 2.

    The node between the coils carries no current away, k = i1 - i2, and its voltage is v:
    L1 i1' = u - R1 i1 - v, L2 i2' = v - R2 i2 - e, C e' = i2. With z = e, e'' = i2'/C and
    i2' = (u - R1 i1 - R2 i2 - e)/(L1 + L2) on N*: r = 1, mu = 2.
    """
    l1, l2, r1, r2, c = 0.2, 0.3, 1.5, 2.0, 0.05
    system = DaeSystem.from_functions(
        [Signal("i1", "A"), Signal("i2", "A"), Signal("e", "V")],
        f=lambda x, p: [-p.r1 * x[0] / p.l1, (-p.r2 * x[1] - x[2]) / p.l2, x[1] / p.c],
        g=lambda x, p: [-1.0 / p.l1, 1.0 / p.l2, 0.0],
        h=lambda x, p: [1.0 / p.l1, 0.0, 0.0],
        k=lambda x, p: x[0] - x[1],
        l=lambda x, p: x[2],
        m=lambda x, p: 0.0,
        parameters={"l1": l1, "l2": l2, "r1": r1, "r2": r2, "c": c},
        name="circuit",
    )

    def closed_form(x: Array) -> Known:
        conductance = 1.0 / l1 + 1.0 / l2
        difference = -r1 * x[0] / l1 - (-r2 * x[1] - x[2]) / l2
        alpha = difference / conductance
        return known(
            -conductance,
            alpha,
            l2 / (l1 + l2),
            (alpha - r2 * x[1] - x[2]) / (l2 * c),
            1.0 / ((l1 + l2) * c),
        )

    def consistent(random: np.random.Generator) -> Array:
        current, voltage = random.standard_normal(2)
        return np.array([current, current, voltage])

    return Problem(
        system=system,
        constraint_degrees=(1,),
        output_degrees=(2,),
        index=2,
        zero_dynamics=0,
        output_order=(0,),
        known=closed_form,
        consistent=consistent,
        reference=[(0.0, 0.0, 1.0)],
        derivatives=lambda x: np.array([x[0] - x[1]]),
        source="Tischendorf, Surveys on Mathematics for Industry 8, 1999: L-I cutsets",
    )


def swing_network() -> Problem:
    """Two generators and a load without inertia: power flow as an algebraic constraint.

    d_i' = w_i, M_i w_i' = P_i - D_i w_i - b_i sin(d_i - t) (+ u for the first), and the load bus
    takes k = sum b_i sin(d_i - t) - P = 0. Its angle t is an algebraic variable of an index 1
    system; as a state with t' = v it has r = 1, and A = -sum b_i cos(d_i - t) is the power flow
    Jacobian. With z = d_1 the second generator is left: it swings and is damped.
    """
    inertia, damping, power, load = (0.1, 0.15), (0.2, 0.4), (0.7, 0.6), 1.3
    links = (2.0, 1.5)
    system = DaeSystem.from_functions(
        [Signal("d1", "rad"), "w1", Signal("d2", "rad"), "w2", Signal("t", "rad")],
        f=lambda x: [
            x[1],
            (power[0] - damping[0] * x[1] - links[0] * ca.sin(x[0] - x[4])) / inertia[0],
            x[3],
            (power[1] - damping[1] * x[3] - links[1] * ca.sin(x[2] - x[4])) / inertia[1],
            0,
        ],
        g=lambda x: [0, 0, 0, 0, 1],
        h=lambda x: [0, 1 / inertia[0], 0, 0, 0],
        k=lambda x: links[0] * ca.sin(x[0] - x[4]) + links[1] * ca.sin(x[2] - x[4]) - load,
        l=lambda x: x[0],
        m=lambda x: 0,
        nominal_state=[0.1, 0.0, 0.1, 0.0, -0.3],
        name="swing network",
    )

    def closed_form(x: Array) -> Known:
        stiff = np.array(links) * np.cos([x[0] - x[4], x[2] - x[4]])
        drift = power[0] - damping[0] * x[1] - links[0] * np.sin(x[0] - x[4])
        return known(
            -stiff.sum(), stiff @ [x[1], x[3]] / stiff.sum(), 0, drift / inertia[0], 1 / inertia[0]
        )

    def consistent(random: np.random.Generator) -> Array:
        """From the flows, which are given: b_1 sin(d1 - t) = P - b_2 sin(d2 - t)."""
        first, angle = random.uniform(0.5, 0.8), random.uniform(-0.4, 0.0)
        d1 = angle + np.arcsin(first / links[0])
        d2 = angle + np.arcsin((load - first) / links[1])
        return np.array([d1, random.uniform(-0.3, 0.3), d2, random.uniform(-0.3, 0.3), angle])

    return Problem(
        system=system,
        constraint_degrees=(1,),
        output_degrees=(2,),
        index=2,
        zero_dynamics=2,
        output_order=(0,),
        known=closed_form,
        consistent=consistent,
        reference=[(0.1, 0.0, 0.2)],
        derivatives=lambda x: np.array(
            [links[0] * np.sin(x[0] - x[4]) + links[1] * np.sin(x[2] - x[4]) - load]
        ),
        source="Hill and Mareels, IEEE Transactions on Circuits and Systems 37(11), 1990: index 1 "
        "where the power flow Jacobian is regular, so 2 with t' = v; network: Bergen and Hill, "
        "IEEE Transactions on Power Apparatus and Systems 100(1), 1981",
        minimum_phase=True,
    )
