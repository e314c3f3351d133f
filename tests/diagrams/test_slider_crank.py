"""The shipped slider-crank against Newton and Euler by hand."""

import numpy as np
from numpy.testing import assert_allclose
from runs import scenario

from drake_dae import build_scenario
from drake_dae.arrays import FloatArray

GRAVITY = 9.81
CRANK, FLYWHEEL = 0.12, 4.0 * 0.16**2 / 2  # m, kg m^2
ROD, ROD_MASS = 0.4, 0.8
ROD_INERTIA = ROD_MASS * (3 * 0.012**2 + ROD**2) / 12  # About its centre, across it.
SLIDER, DAMPING = 2.5, 60.0


def along(angle: float) -> FloatArray:
    return np.array([np.cos(angle), np.sin(angle)])


def across(angle: float) -> FloatArray:
    return np.array([-np.sin(angle), np.cos(angle)])


def moment(lever: FloatArray, force: FloatArray) -> float:
    return float(lever[0] * force[1] - lever[1] * force[0])


def placed(crank: float, rate: float) -> FloatArray:
    """(q, v) of the links: crank, rod relative to it (as far as it has turned back), slider."""
    rod = -np.arcsin(CRANK * np.sin(crank) / ROD)
    rod_rate = -CRANK * np.cos(crank) * rate / (ROD * np.cos(rod))
    slider = CRANK * np.cos(crank) + ROD * np.cos(rod)
    speed = -CRANK * np.sin(crank) * rate - ROD * np.sin(rod) * rod_rate
    return np.array([crank, rod - crank, slider, rate, rod_rate - rate, speed])


def by_hand(crank: float, rate: float, second: float) -> tuple[float, FloatArray]:
    """The torque on the crank, and the force of the rod on the slider, shape (2,).

    The rod's end stays at z = 0; the slider tells the force along the guide, the rod's moments
    about the crank pin that across it, and the crank's about the axle the torque.
    """
    _, relative, _, _, relative_rate, speed = placed(crank, rate)
    rod, rod_rate = crank + relative, rate + relative_rate
    knee = CRANK * (across(crank) * second - along(crank) * rate**2)
    rod_second = (ROD * np.sin(rod) * rod_rate**2 - knee[1]) / (ROD * np.cos(rod))
    swing = across(rod) * rod_second - along(rod) * rod_rate**2
    push = SLIDER * (knee + ROD * swing)[0] + DAMPING * speed
    inertial = ROD_MASS * (knee + ROD / 2 * swing + [0.0, GRAVITY])
    turning = ROD_INERTIA * rod_second + ROD / 2 * moment(along(rod), inertial)
    # moment(along, -f) = sin f_x - cos f_z.
    lift = (np.sin(rod) * push - turning / ROD) / np.cos(rod)
    force = np.array([push, lift])
    return FLYWHEEL * second + CRANK * moment(along(crank), inertial + force), force


def test_the_law_and_the_pin_are_those_of_newton_and_euler():
    """Double poles at -6 ask for r'' - 12 e' - 36 e. To round-off, also at the dead centres."""
    loop, _ = build_scenario(scenario("slider_crank"))
    plant, law = loop.plant, loop.controller.law
    assert law.structure.constraint_degrees == (2, 2)
    assert law.structure.output_degrees == (2,)
    assert law.structure.zero_dynamics_dimension == 0
    context, random = plant.CreateDefaultContext(), np.random.default_rng(0)
    for crank in [0.0, np.pi, *random.uniform(-9.0, 9.0, 6)]:
        rate = random.uniform(-10.0, 10.0)
        target = np.array([crank, rate, 0.0]) + random.uniform(-0.3, 0.3, 3)
        second = target[2] - 12.0 * (rate - target[1]) - 36.0 * (crank - target[0])
        torque, force = by_hand(crank, rate, second)
        state = placed(crank, rate)
        control = law.control(state, target)
        assert_allclose(control, torque, rtol=1e-12, atol=1e-12)
        plant.set_state(context, state)
        plant.GetInputPort("control").FixValue(context, control)
        found = plant.GetOutputPort("constraint_force").Eval(context)
        assert_allclose(found, force, rtol=1e-12, atol=1e-11)
