"""A constraint that time drives: a bead on a wire that turns evenly in a vertical plane.

A textbook problem with a closed form, as in Goldstein, Classical Mechanics, chapter 1.
"""

import casadi as ca
import numpy as np
from arms import error_controlled
from numpy.testing import assert_allclose
from pydrake.systems.framework import DiagramBuilder

from drake_dae import DaePlant, DaeSystem, ExpressionReference, ReferenceGenerator, simulate

MASS, TURN, GRAVITY = 0.7, 1.6, 9.81


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
    """It goes out to 1.4 m, falls back through the axle, and is at 4 m on the other side at 2.5 s.

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
