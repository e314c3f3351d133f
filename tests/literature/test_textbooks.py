"""Answers that textbooks print, each by the library's own multipliers and events.

The sources were read where they are published on the web; each test names its own.
"""

import numpy as np
from arms import error_controlled
from numpy.testing import assert_allclose

from drake_dae import DaePlant, DaeSystem, simulate


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
