"""The laws behind actuation stages: the paper's own formulas, and errors known in advance."""

from math import comb, factorial

import numpy as np
import pytest
from actuated import (
    DEGREES,
    actuated,
    at_rest,
    drive,
    lever,
    output_bias,
    slope,
    start_position,
    states,
)
from arms import fixed_step, numbers

from drake_dae import RobotPlant, SinusoidReference, TrackingLaw, make_closed_loop, poles, simulate
from drake_dae.dae import gain_matrices


def binomial(pole, degree, size):
    """Lambda_1, ..., Lambda_mu of (s - pole)^mu."""
    return [comb(degree, k) * (-pole) ** (degree - k) * np.eye(size) for k in range(degree)]


def coupled(degree, size, random):
    """Lambda_1, ..., Lambda_mu with poles from -3 to -5 that belong to mixtures of the errors."""
    mix = np.eye(size) + 0.2 * random.standard_normal((size, size))
    rows = np.array([np.poly(p)[:0:-1] for p in -random.uniform(3.0, 5.0, (size, degree))])
    return [mix @ np.diag(column) @ np.linalg.inv(mix) for column in rows.T]


def new_input(reference, gains, outputs):
    """v(t) of (70), (71), (80), (81) from z, z', ...: r^(mu) - sum Lambda_k+1 (z^(k) - r^(k))."""
    r = reference.reshape(-1, len(gains) + 1).T
    return r[-1] - sum(g @ (z - r[k]) for k, (g, z) in enumerate(zip(gains, outputs, strict=True)))


def closed_form(pole, start, times):
    """e(t) of (s - pole)^mu e = 0 from e(0), e'(0), ...: exp(pole t) times a polynomial.

    The polynomial is w = e exp(-pole t), whose derivatives at 0 follow from Leibniz's rule.
    """
    w = [
        sum(comb(k, j) * (-pole) ** (k - j) * start[j] for j in range(k + 1))
        for k in range(len(start))
    ]
    return np.exp(pole * times) * sum(c * times**k / factorial(k) for k, c in enumerate(w))


class Links:
    """M^-1, H, J, Jdot v, P, Pdot v and (J M^-1 J^T)^-1 at one state."""

    def __init__(self, name, kind, q, v):
        n = numbers(name, q, v)
        self.minv = np.linalg.inv(n.mass - drive(name, kind).rotors)
        self.h, self.j, self.p = n.bias, n.constraint_jacobian, n.output_jacobian
        self.jdot_v, self.pdot_v = n.constraint_acceleration, output_bias(name, q, v)
        self.jmj = np.linalg.inv(self.j @ self.minv @ self.j.T)


def explicit_flexible(name, x, reference, gains, force_gains):
    """(69)-(71) with f_1, ..., f_4, B_1, B_2, A_1, A_2 of the appendix.

    The term of f_3 is Jdot qd, where the appendix prints Jdot_1. f = (f_1; f_3), g = (f_2; f_4),
    B = (B_1; B_2), A = (A_1; A_2) stand below each other: the appendix treats both alike. In the
    velocities all of it is a polynomial of at most third degree, in q_2 linear, which differences
    get exactly.
    """
    d = drive(name, "flexible")
    k_2, (q_1, v_1, q_2, v_2) = d.stiffness, x.reshape(4, -1)
    count = numbers(name, q_1, v_1).outputs.size

    def f(q, v):
        n = Links(name, "flexible", q, v)
        f_3 = n.jmj @ (n.j @ n.minv @ n.h - n.jdot_v + n.j @ n.minv @ k_2 @ q)
        f_1 = n.pdot_v - n.p @ n.minv @ (n.h + k_2 @ q) + n.p @ n.minv @ n.j.T @ f_3
        return np.concatenate([f_1, f_3])

    def b(q):
        n = Links(name, "flexible", q, np.zeros_like(q))
        b_2 = -n.jmj @ n.j @ n.minv @ k_2
        return np.vstack([n.p @ n.minv @ (k_2 + n.j.T @ b_2), b_2])

    def acceleration(q, v, q_2):
        n = Links(name, "flexible", q, v)
        force = (f(q, v) + b(q) @ q_2)[count:]
        return n.minv @ (-n.h + k_2 @ (q_2 - q)) + n.minv @ n.j.T @ force

    def g(q, v, q_2):
        moving = slope(lambda q: f(q, v) + b(q) @ q_2, q, v, 5e-3)
        return moving + slope(lambda v: f(q, v), v, acceleration(q, v, q_2), 1.0)

    a = (
        slope(lambda q: g(q, v_1, q_2) + b(q) @ v_2, q_1, v_1, 5e-3)
        + slope(lambda q: g(q_1, v_1, q), q_2, v_2, 1e-2)
        - b(q_1) @ np.linalg.solve(d.inertia, k_2 @ (q_2 - q_1))
        + slope(lambda v: g(q_1, v, q_2), v_1, acceleration(q_1, v_1, q_2), 1.0)
    )
    n = numbers(name, q_1, v_1)
    second, third = f(q_1, v_1) + b(q_1) @ q_2, g(q_1, v_1, q_2) + b(q_1) @ v_2
    known = [n.outputs, n.output_jacobian @ v_1, second[:count], third[:count]]
    wanted = new_input(reference[: 5 * count], gains, known)
    pressed = new_input(reference[5 * count :], force_gains, [second[count:], third[count:]])
    return d.inertia @ np.linalg.solve(b(q_1), -a + np.concatenate([wanted, pressed]))


def explicit_actuator(name, kind, x, reference, gains, force_gains):
    """(79)-(81) with f_5, f_6, B_3, B_4, A_3, A_4 of the appendix.

    B_3 is P M^-1 (J^T B_4 + N K_m); the appendix prints P N K_m without M^-1. For servos G(q)
    stands for N K_m, K_h^-1 for L and G_p for R.
    """
    d = drive(name, kind)
    q, v, s = x.reshape(3, -1)
    count = numbers(name, q, v).outputs.size
    inertia, loss = (d.inductance, d.resistance) if d.electric else (d.compliance, d.leakage)

    def torque(q):
        return d.torque if d.electric else lever(q)

    def f(q, v):
        n = Links(name, kind, q, v)
        f_6 = n.jmj @ (n.j @ n.minv @ n.h - n.jdot_v)
        return np.concatenate([n.pdot_v - n.p @ n.minv @ (n.h - n.j.T @ f_6), f_6])

    def b(q):
        n = Links(name, kind, q, np.zeros_like(q))
        b_4 = -n.jmj @ n.j @ n.minv @ torque(q)
        return np.vstack([n.p @ n.minv @ (n.j.T @ b_4 + torque(q)), b_4])

    n = Links(name, kind, q, v)
    second = f(q, v) + b(q) @ s
    acceleration = n.minv @ (-n.h + torque(q) @ s) + n.minv @ n.j.T @ second[count:]
    a = (
        slope(lambda q: f(q, v) + b(q) @ s, q, v, 5e-3)
        - b(q) @ np.linalg.solve(inertia, loss @ s + torque(q).T @ v)
        + slope(lambda v: f(q, v), v, acceleration, 1.0)
    )
    outputs = numbers(name, q, v).outputs
    wanted = new_input(reference[: 4 * count], gains, [outputs, n.p @ v, second[:count]])
    pressed = new_input(reference[4 * count :], force_gains, [second[count:]])
    return inertia @ np.linalg.solve(b(q), -a + np.concatenate([wanted, pressed]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "full"), [("flexible", True), ("motor", False), ("motor", True), ("hydraulic", True)]
)
@pytest.mark.equation(39, 64, 65, 66, 67, 68, 69, 70, 74, 75, 76, 77, 78, 79, 80)
def test_law_is_the_explicit_law(kind, full):
    """(69)-(71), (79)-(81) and their hydraulic form, at random states and references.

    One level of differences at 5 mrad leaves 2e-14 of a voltage, since most of it needs none. Two
    levels leave 5e-12.
    """
    name, tolerance = "two_link", 1e-10 if kind == "flexible" else 1e-12
    found, random = actuated(name, kind), np.random.default_rng(5)
    degree, force_degree = DEGREES[kind]
    count = len(found.model.position_signals)
    gains, force_gains = binomial(-4.0, degree, count), binomial(-4.0, force_degree, 1)
    design = poles(-4.0)
    if full:
        gains, force_gains = coupled(degree, count, random), coupled(force_degree, 1, random)
        design = gain_matrices(gains, force_gains)
    law = TrackingLaw(found.model.dae, design, structure=found.structure)
    for x in states(name, kind, 3, seed=6):
        reference = random.standard_normal(count * (degree + 1) + force_degree + 1)
        if kind == "flexible":
            explicit = explicit_flexible(name, x, reference, gains, force_gains)
        else:
            explicit = explicit_actuator(name, kind, x, reference, gains, force_gains)
        control = law.control(x, reference)
        assert np.linalg.norm(control - explicit) < tolerance * np.linalg.norm(explicit)


@pytest.mark.slow
@pytest.mark.parametrize("kind", DEGREES)
@pytest.mark.equation(72, 73, 82, 83)
def test_errors_are_their_closed_forms(kind):
    """(72)-(73), (82)-(83) and their kin at 1 ms, relative to the errors at the start.

    From rest, off the reference in position and force. Smaller steps change nothing: what is left
    is round-off.
    """
    name, found = "two_link", actuated("two_link", kind)
    names = [signal.name for signal in found.model.dae.output_signals]
    poles_of = dict.fromkeys(names, -14.0) | {names[-1]: -20.0}
    law = TrackingLaw(found.model.dae, poles(poles_of), structure=found.structure)
    references = [SinusoidReference(0.3, 0.1, 2.0), SinusoidReference(20.0, 5.0, 3.0, 0.3)]
    loop = make_closed_loop(RobotPlant(found.model, structure=found.structure), law, references)
    context = loop.diagram.CreateDefaultContext()
    start = at_rest(name, kind, start_position(name), 14.0)[0]
    loop.plant.set_state(loop.plant.GetMyMutableContextFromRoot(context), start)
    simulate(loop.diagram, context, 0.8, fixed_step(1e-3))
    record = loop.record(context)
    # At rest all derivatives of an output vanish, so those of its error are the reference's.
    rest = -record["reference"][0]
    deviation, first = [], 0
    for i, degree in enumerate(law.degrees):
        error = record["tracking_error"][:, i]
        exact = closed_form(
            poles_of[names[i]], [error[0], *rest[first + 1 : first + degree]], record.time
        )
        deviation.append(np.max(np.abs(error - exact)))
        first += degree + 1
    error = np.abs(record["tracking_error"])
    assert np.all(deviation < 1e-9 * error[0])
    assert np.all(error[0] > [0.04, 5.0])
    assert np.all(error[-1] < [0.004, 0.01])
    assert np.max(np.abs(record["constraint_residual"])) < 1e-12
