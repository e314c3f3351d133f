"""Stiff joints and quick motors: what the laws and the motions tend to, and how fast."""

import numpy as np
import pytest
import scipy.integrate
from actuated import (
    ARMS,
    OFFSET,
    actuated,
    at_rest,
    drive,
    output_bias,
    rates,
    slope,
    standing,
    start_position,
)
from arms import arm, law, numbers

from drake_dae import RobotPlant, TrackingLaw, poles


def path(name, t):
    """Outputs and forces over time: r^(k) in row k."""
    middle, k = np.array([*OFFSET[name], 20.0]), np.arange(6)[:, None]
    swing, phase = np.append(np.full(middle.size - 1, 0.05), 5.0), np.arange(middle.size)
    return middle * (k == 0) + swing * 2.0**k * np.sin(2.0 * t + phase + 0.5 * np.pi * k)


def along_path(name, d, t):
    """(q, v), v' and the joint torques on the path, by [J; P] v' = -[Jdot; Pdot] v + [0; r''].

    M here is what `d` leaves of it.
    """
    r = path(name, t)
    model = arm(name).model
    q = model.configuration(r[0, :-1], np.split(model.dae.nominal_state, 2)[0])
    n = numbers(name, q, np.zeros_like(q))
    stacked = np.vstack([n.constraint_jacobian, n.output_jacobian])
    v = np.linalg.solve(stacked, [0.0, *r[1, :-1]])
    n = numbers(name, q, v)
    bias = np.concatenate([n.constraint_acceleration, output_bias(name, q, v)])
    acceleration = np.linalg.solve(stacked, [0.0, *r[2, :-1]] - bias)
    torque = (n.mass - d.rotors) @ acceleration + n.bias - n.constraint_jacobian.T @ r[0, -1:]
    return np.concatenate([q, v]), acceleration, torque


def reference(name, t, degrees):
    r = path(name, t)
    return np.concatenate([r[: degree + 1, i] for i, degree in enumerate(degrees)])


@pytest.mark.slow
@pytest.mark.parametrize("name", ARMS)
def test_flexible_law_tends_to_the_rigid_law_at_rate_1_over_k(name):
    """u = u_rigid + M_2 K_2^-1 tau''(t) where the reference is met, whatever the gains.

    There (64) says q_2 = q_1 + K_2^-1 tau(t), where tau(t) does not depend on K_2, and (65) says
    u = M_2 q_2'' + tau = (tau + M_2 q_1'') + M_2 K_2^-1 tau''. The bracket is the control of the
    rigid robot whose rotors turn with the links. Round-off of u grows with K_2, the size of what
    is measured with 1 / K_2.
    """
    kind, t = "flexible", 0.3
    found, d = actuated(name, kind), drive(name, kind)
    chosen, dae = (
        TrackingLaw(found.model.dae, poles(-4.0), structure=found.structure),
        found.model.dae,
    )

    def torque(t):
        return along_path(name, d, t[0])[2]

    def change(t):
        return slope(torque, t, np.ones(1), 0.02)

    now = np.array([t])
    link, acceleration, tau = along_path(name, d, t)
    rigid = law(name).control(link, reference(name, t, law(name).degrees))
    rigid += (d.inertia - d.rotors) @ acceleration  # Rotors that the URDF does not declare.
    for factor in (1.0, 10.0, 100.0):
        stiffer = d._replace(stiffness=factor * d.stiffness)
        x = standing(stiffer, link, tau, change(now))[0]
        values = dae.parameter_values
        values[dae.parameter_slice("flexible_joints.stiffness")] *= factor
        control = chosen.control(x, reference(name, t, chosen.degrees), parameters=values)
        shift = d.inertia @ np.linalg.solve(stiffer.stiffness, slope(change, now, np.ones(1), 0.02))
        left = np.linalg.norm(control - rigid - shift) / np.linalg.norm(shift)
        assert left < 2e-8 * factor**2


@pytest.mark.parametrize("name", ARMS)
def test_motor_law_tends_to_the_rigid_law_at_rate_l(name):
    """u = (R (N K_m)^-1 tau + N K_m q') + L (N K_m)^-1 tau'(t) where the reference is met.

    The bracket turns the rigid robot's torque into a voltage by (75) without its inductance.
    """
    kind, t = "motor", 0.3
    found, d = actuated(name, kind), drive(name, kind)
    chosen, dae = (
        TrackingLaw(found.model.dae, poles(-4.0), structure=found.structure),
        found.model.dae,
    )
    link, _, tau = along_path(name, d, t)
    change = slope(lambda t: along_path(name, d, t[0])[2], np.array([t]), np.ones(1), 0.02)
    rigid = law(name).control(link, reference(name, t, law(name).degrees))
    voltage = d.resistance @ np.linalg.solve(d.torque, rigid) + d.torque @ np.split(link, 2)[1]
    x = standing(d, link, tau, change)[0]
    for factor in (1.0, 0.1, 0.01):
        values = dae.parameter_values
        values[dae.parameter_slice("dc_motors.inductance")] *= factor
        control = chosen.control(x, reference(name, t, chosen.degrees), parameters=values)
        shift = factor * d.inductance @ np.linalg.solve(d.torque, change)
        left = np.linalg.norm(control - voltage - shift) / np.linalg.norm(shift)
        assert left < 1e-8


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "parameter", "matrix", "operation"),
    [
        ("flexible", "flexible_joints.stiffness", "stiffness", np.multiply),
        pytest.param(
            "motor", "dc_motors.inductance", "inductance", np.divide, marks=pytest.mark.thorough
        ),
    ],
)
def test_trajectories_tend_to_those_of_the_rigid_robot(kind, parameter, matrix, operation):
    """The same control moves the robot as its limit is moved, except for O(1 / K_2) and O(L).

    By the two laws' identities above, a robot under u(t) moves to first order as its limit does
    under u less M_2 K_2^-1 tau'', or less L (N K_m)^-1 tau'. What is left is of second order: here
    0.4% and 3%, and a tenth of it with every step. The control starts with five derivatives zero,
    so that nothing rings.
    """
    name, q = "two_link", start_position("two_link")
    found, d = actuated(name, kind), drive(name, kind)
    plant = RobotPlant(found.model, structure=found.structure)
    context = plant.CreateDefaultContext()
    start, hold = at_rest(name, kind, q, 20.0)
    push = np.array([20.0, -10.0]) * {"flexible": 1.0, "motor": 0.1}[kind]
    limit = d._replace(flexible=False, electric=False)

    def control(t):
        return hold + push * (1.0 - np.cos(4.0 * t)) ** 3

    def limiting(t, x):
        if kind == "flexible":  # The rotors turn with the links.
            return rates(name, limit._replace(rotors=-d.inertia), x, control(t)).state
        current = np.linalg.solve(d.resistance, control(t) - d.torque @ x[2:])
        return rates(name, limit, x, d.torque @ current).state

    def actual(t, x):
        plant.set_state(context, x)
        plant.GetInputPort("control").FixValue(context, control(t))
        return plant.EvalTimeDerivatives(context).CopyToVector()

    def end(rate, x):
        solution = scipy.integrate.solve_ivp(rate, (0.0, 0.5), x, "DOP853", rtol=1e-11, atol=1e-12)
        return solution.y[:4, -1]

    rigid = end(limiting, start[:4])
    assert np.min(np.abs(rigid[2:])) > 0.1
    scaled = []
    for factor in (1.0, 10.0, 100.0):
        near = d._replace(**{matrix: operation(getattr(d, matrix), factor)})
        plant.set_parameter(context, parameter, np.diag(getattr(near, matrix)))
        torque = d.torque @ start[4:] if kind == "motor" else hold
        x = standing(near, start[:4], torque, np.zeros(2))[0]
        scaled.append(factor * (end(actual, x) - rigid))
    first, second, third = scaled
    np.testing.assert_allclose(first, third, rtol=0.06)
    np.testing.assert_allclose(second, third, rtol=0.006)
