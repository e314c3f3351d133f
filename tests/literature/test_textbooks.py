"""Answers that textbooks print, each by the library's own multipliers and events.

The sources were read where they are published on the web; each test names its own.
"""

import casadi as ca
import numpy as np
from arms import error_controlled
from numpy.testing import assert_allclose

from drake_dae import DaePlant, DaeSystem, LinkExpressions, RobotModel, RobotPlant, simulate
from drake_dae.robots import Blade

G = 9.81
NOTHING = np.zeros((3, 0))


def flat(mass, about_center, center=0.0, gravity=G):
    """A body in the x-z plane: its origin, and the angle of its x axis above the horizontal.

    Its center of mass is on its x axis.
    """
    q, v = ca.SX.sym("q", 3), ca.SX.sym("v", 3)
    c, s = ca.cos(q[2]), ca.sin(q[2])
    turned = ca.vertcat(ca.horzcat(c, 0, -s), ca.horzcat(0, 1, 0), ca.horzcat(s, 0, c))
    lever = mass * center
    M = ca.blockcat(
        [[mass, 0, -lever * s], [0, mass, lever * c],
         [-lever * s, lever * c, about_center + mass * center**2]]
    )  # fmt: skip
    spun = -lever * v[2] ** 2
    H = ca.vertcat(spun * c, spun * s + mass * gravity, lever * gravity * c)
    links = {"body": (turned, ca.vertcat(q[0], 0, q[1]))}
    return LinkExpressions(q, v, M, H, links, actuation_matrix=NOTHING)


def test_a_ball_on_a_turntable_goes_round_with_two_sevenths_of_its_rate():
    """A solid ball that rolls without slip on a table that turns at W goes round at 2/7 W.

    H. Nakanishi, Sphere Rolling on a Turntable, 2024: it makes two turns while the table makes
    seven. Here after half a turn of the ball it is across the circle, after a turn back.
    """
    mass, radius, table = 0.6, 0.15, 3.0
    about = 0.4 * mass * radius**2
    # x, y, their rates, and the spins about x and y; that about z is constant and does not act.
    system = DaeSystem.from_functions(
        ["x", "y", "vx", "vy", "wx", "wy"],
        f=lambda s: [s[2], s[3], 0.0, 0.0, 0.0, 0.0],
        g=lambda s: [
            *([0.0, 0.0], [0.0, 0.0], [1 / mass, 0.0], [0.0, 1 / mass]),
            *([0.0, radius / about], [-radius / about, 0.0]),
        ],
        k=lambda s: [s[2] - radius * s[5] + table * s[1], s[3] + radius * s[4] - table * s[0]],
        name="turntable",
    )
    plant = DaePlant(system)
    assert plant.structure.constraint_degrees == (1, 1)
    place, speed = np.array([0.3, 0.1]), np.array([0.4, -0.2])
    spin = [(table * place[0] - speed[1]) / radius, (speed[0] + table * place[1]) / radius]
    start = np.array([*place, *speed, *spin])
    rate = 2 / 7 * table
    across = 2 / rate * np.array([-speed[1], speed[0]])
    for turns, wanted in ((0.5, place + across), (1.0, place)):
        context = plant.CreateDefaultContext()
        plant.set_state(context, start)
        simulate(plant, context, turns * 2 * np.pi / rate, error_controlled(1e-12))
        assert_allclose(plant.state(context)[:2], wanted, atol=1e-9)
    force = plant.GetOutputPort("constraint_force").Eval(context)
    assert_allclose(force, mass * rate * np.array([-speed[1], speed[0]]), atol=1e-9)


def test_chaplygins_sleigh_comes_out_of_its_turn_as_a_hyperbolic_tangent():
    """v' = a w^2, w' = -m a / (I + m a^2) v w: v = c tanh(a c t / k^2), k^2 = (I + m a^2) / m.

    Bloch, Nonholonomic Mechanics and Control, 1.7, as quoted at Mathematica Stack Exchange 162070.
    With c^2 = v^2 + k^2 w^2, which is the energy, v' = a (c^2 - v^2) / k^2.
    """
    mass, about, ahead, spin = 2.0, 0.3, 0.4, 2.5
    # The plane x-z lies on the ice, where there is no weight.
    blade = Blade("body", (0, 0, 1))
    links = flat(mass, about, ahead, gravity=0.0)
    model = RobotModel(links, [blade], [], [0, 0, 0], "sleigh", forces=[])
    plant = RobotPlant(model)
    assert plant.structure.constraint_degrees == (1,)
    context = plant.CreateDefaultContext()
    plant.set_state(context, [0, 0, 0, 0, 0, spin])
    simulate(plant, context, 1.5, error_controlled(1e-12))
    gyration = (about + mass * ahead**2) / mass
    energy = np.sqrt(gyration) * spin
    way = ahead * energy * 1.5 / gyration
    *_, angle, vx, vz, rate = plant.state(context)
    assert_allclose(vx * np.cos(angle) + vz * np.sin(angle), energy * np.tanh(way), atol=1e-10)
    assert_allclose(rate, spin / np.cosh(way), atol=1e-10)
    # The blade bears m (v w + a w') across.
    force = plant.GetOutputPort("constraint_force").Eval(context)
    speed, slowing = energy * np.tanh(way), -ahead / gyration * energy * np.tanh(way) * rate
    assert_allclose(force, mass * (speed * rate + ahead * slowing), atol=1e-9)
