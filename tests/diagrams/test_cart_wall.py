"""The shipped cart that presses on a wall, against Newton's and Euler's equations by hand."""

import numpy as np
from numpy.testing import assert_allclose
from runs import scenario

from drake_dae import build_scenario

NAME = "cart_wall"

CHASSIS, AHEAD = 12.0, 0.08  # kg, m from the axle to the centre of mass
CHASSIS_YAW = CHASSIS * (0.5**2 + 0.36**2) / 12
WHEEL, RADIUS, TRACK = 1.0, 0.1, 0.22  # kg, m, m from the middle to a wheel
SPIN, ACROSS = WHEEL * RADIUS**2 / 2, WHEEL * (3 * RADIUS**2 + 0.04**2) / 12
ROD, LENGTH, REACH = 0.6, 0.3, 0.3  # kg, m, m from the axle to the rod
ROD_YAW = ROD * (3 * 0.012**2 + LENGTH**2) / 12
WALL = 0.4


def rolling(heading, speed, turn, rod, x):
    """(q, v) with the tip on the wall, and what the rod's speed must then be."""
    sine, cosine = np.sin(heading), np.cos(heading)
    y = WALL - REACH * sine - rod * cosine
    rod_speed = -((speed - turn * rod) * sine + turn * REACH * cosine) / cosine
    spins = (speed - TRACK * turn) / RADIUS, (speed + TRACK * turn) / RADIUS
    rates = speed * cosine, speed * sine, turn, *spins, rod_speed
    return np.array([x, y, heading, 0.3, -0.8, rod, *rates])


def by_hand(state, tip_second, rod_second, press):
    """Controls (left, right, rod), constraint forces, and accelerations of speed and turn.

    All in axes of the cart, which moves with `speed` and turns with `turn`. The tip has the
    acceleration (tip_second, 0) in the world and the wall's force (0, -press).
    """
    heading, turn, rod_speed, rod = state[2], state[8], state[11], state[5]
    speed = state[6:8] @ [np.cos(heading), np.sin(heading)]
    sine, cosine = np.sin(heading), np.cos(heading)
    turned = (-tip_second * sine - speed * turn + turn**2 * rod - rod_second) / REACH
    faster = tip_second * cosine + turn**2 * REACH + turned * rod + 2 * turn * rod_speed

    def acceleration(x, y):
        return np.array(
            [faster - turn**2 * x - turned * y, speed * turn + turned * x - turn**2 * y]
        )

    middle = rod - LENGTH / 2
    of_rod = acceleration(REACH, middle) + np.array([-2 * turn * rod_speed, rod_second])
    masses = [
        (CHASSIS, (AHEAD, 0.0), acceleration(AHEAD, 0.0), CHASSIS_YAW),
        (WHEEL, (0.0, TRACK), acceleration(0.0, TRACK), ACROSS),
        (WHEEL, (0.0, -TRACK), acceleration(0.0, -TRACK), ACROSS),
        (ROD, (REACH, middle), of_rod, ROD_YAW),
    ]
    total = sum(mass * own for mass, _, own, _ in masses)
    about = sum(
        mass * (place[0] * own[1] - place[1] * own[0]) + yaw * turned
        for mass, place, own, yaw in masses
    )
    wall = -press * np.array([sine, cosine])
    both = total[0] - wall[0]
    apart = (about - REACH * wall[1] + rod * wall[0]) / TRACK
    traction = np.array([both - apart, both + apart]) / 2  # Left, right.
    side = total[1] - wall[1]
    spins = np.array([faster - TRACK * turned, faster + TRACK * turned]) / RADIUS
    torques = SPIN * spins + RADIUS * traction
    push = ROD * of_rod[1] - wall[1]
    forces = np.array([press, traction[0], side, traction[1]])
    return np.array([*torques, push]), forces, (faster, turned)


def test_the_law_and_what_wall_and_ground_do_are_those_of_newton_and_euler():
    """Double poles at -4 ask for r'' - 8 e' - 16 e of tip and rod, and the force at once.

    To round-off, of forces up to 300 N.
    """
    loop, _ = build_scenario(scenario(NAME))
    plant, law = loop.plant, loop.controller.law
    assert law.structure.constraint_degrees == (2, 1, 1, 1)
    assert law.structure.output_degrees == (2, 2, 0)
    assert law.structure.zero_dynamics_dimension == 3
    context, random = plant.CreateDefaultContext(), np.random.default_rng(0)
    for _ in range(6):
        heading, speed, turn, x, press = random.uniform(-0.6, 0.6, 5)
        state = rolling(heading, speed, turn, 0.4 + 0.1 * random.uniform(-1, 1), x)
        assert_allclose(law.structure.manifold.residual(state), 0.0, atol=1e-15)
        rod, rod_speed = state[5], state[11]
        tip = x + REACH * np.cos(heading) - rod * np.sin(heading)
        tip_speed = (speed - turn * rod) * np.cos(heading)
        tip_speed -= (turn * REACH + rod_speed) * np.sin(heading)
        target = np.array([[tip, tip_speed, 0.0], [rod, rod_speed, 0.0]])
        target += random.uniform(-0.1, 0.1, (2, 3))
        press = 30.0 + 10.0 * press
        seconds = target[:, 2] - 8.0 * ([tip_speed, rod_speed] - target[:, 1])
        seconds -= 16.0 * ([tip, rod] - target[:, 0])
        controls, forces, (faster, turned) = by_hand(state, *seconds, press)
        control = law.control(state, [*target.reshape(-1), press])
        assert_allclose(control, controls, rtol=1e-11, atol=1e-11)
        plant.set_state(context, state)
        plant.GetInputPort("control").FixValue(context, control)
        found = plant.GetOutputPort("constraint_force").Eval(context)
        assert_allclose(found, forces, rtol=1e-11, atol=1e-11)
        rates = plant.EvalTimeDerivatives(context).CopyToVector()[6:]
        spins = (faster - TRACK * turned) / RADIUS, (faster + TRACK * turned) / RADIUS
        assert_allclose(rates[2:], [turned, *spins, seconds[1]], atol=1e-11)
