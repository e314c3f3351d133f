"""Answers that textbooks print, each by the library's own multipliers and events.

The sources were read where they are published on the web; each test names its own.
"""

import casadi as ca
import numpy as np
from arms import error_controlled
from numpy.testing import assert_allclose
from pydrake.systems.framework import DiagramBuilder

from drake_dae import DaePlant, DaeSystem, ExpressionReference, ReferenceGenerator, simulate

G = 9.81


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


MASS, TURN, GRAVITY = 0.7, 1.6, G


def bead():
    """m r'' = m g + v n, 0 = n . r, with the normal n = (-sin a, cos a) of the wire at a(t)."""
    return DaeSystem.from_functions(
        ["x", "y", "vx", "vy"],
        f=lambda s, p: [s[2], s[3], 0.0, -GRAVITY],
        g=lambda s, p: [0.0, 0.0, -ca.sin(p.angle) / MASS, ca.cos(p.angle) / MASS],
        k=lambda s, p: -ca.sin(p.angle) * s[0] + ca.cos(p.angle) * s[1],
        parameters={"angle": 0.0},
        exogenous=["angle"],
        name="bead",
    )


def exact(time, place, speed):
    """s and s' along the wire from s'' = w^2 s - g sin(w t), and the wire's force."""
    own = GRAVITY / (2 * TURN**2)
    odd = speed / TURN - own
    s = place * np.cosh(TURN * time) + odd * np.sinh(TURN * time) + own * np.sin(TURN * time)
    rate = place * np.sinh(TURN * time) + odd * np.cosh(TURN * time) + own * np.cos(TURN * time)
    force = MASS * (2 * TURN * TURN * rate + GRAVITY * np.cos(TURN * time))
    return s, TURN * rate, force


def test_a_bead_on_a_wire_that_turns():
    """A constraint that time drives (Goldstein, Classical Mechanics, chapter 1).

    It goes out to 1.4 m, falls back through the axle, and is at 4 m on the other side at 2.5 s.

    1e-12 in each step leaves 1e-12; the wire's force is m (2 w s' + g cos w t).
    """
    plant = DaePlant(bead())
    assert plant.structure.constraint_degrees == (2,)
    builder = DiagramBuilder()
    builder.AddSystem(plant)
    angle = ExpressionReference(lambda t: TURN * t)
    source = builder.AddSystem(ReferenceGenerator([angle], plant.exogenous_layout.degrees))
    builder.Connect(source.get_output_port(), plant.GetInputPort("exogenous"))
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    own = plant.GetMyMutableContextFromRoot(context)
    place, speed = 0.2, 2.6
    plant.set_state(own, [place, 0.0, speed, TURN * place])
    for time in (0.5, 1.5, 2.5):
        config = error_controlled(1e-12)
        config.start_time = context.get_time()
        simulate(diagram, context, time - context.get_time(), config)
        s, rate, force = exact(time, place, speed)
        along = np.array([np.cos(TURN * time), np.sin(TURN * time)])
        across = np.array([-along[1], along[0]])
        state = plant.state(own)
        assert_allclose(state[:2], s * along, rtol=1e-11, atol=1e-11)
        assert_allclose(state[2:], rate * along + TURN * s * across, rtol=1e-11, atol=1e-11)
        found = plant.GetOutputPort("constraint_force").Eval(own)
        assert_allclose(found, force, rtol=1e-10)
    assert s < -3.0
