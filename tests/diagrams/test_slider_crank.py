"""The shipped slider-crank, rigid and behind a flexible shaft, against Newton and Euler by hand."""

from math import factorial

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from runs import run_scenario, scenario

from drake_dae import (
    CoincidentPoints,
    JointPositions,
    RobotModel,
    RobotPlant,
    TrackingLaw,
    build_scenario,
    poles,
)
from drake_dae.arrays import FloatArray
from drake_dae.scenario.shipped import FOLDER

GRAVITY = 9.81
CRANK, FLYWHEEL = 0.12, 4.0 * 0.16**2 / 2  # m, kg m^2
ROD, ROD_MASS = 0.4, 0.8
ROD_INERTIA = ROD_MASS * (3 * 0.012**2 + ROD**2) / 12  # About its centre, across it.
SLIDER, DAMPING = 2.5, 60.0
STIFFNESS, SHAFT = 2000.0, 0.02


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


def by_hand(
    crank: float, rate: float, second: float, pushed: float = 0.0
) -> tuple[float, FloatArray]:
    """The torque on the crank, and the force of the rod on the slider, shape (2,).

    Someone else may push the slider as well.

    The rod's end stays at z = 0; the slider tells the force along the guide, the rod's moments
    about the crank pin that across it, and the crank's about the axle the torque.
    """
    _, relative, _, _, relative_rate, speed = placed(crank, rate)
    rod, rod_rate = crank + relative, rate + relative_rate
    knee = CRANK * (across(crank) * second - along(crank) * rate**2)
    rod_second = (ROD * np.sin(rod) * rod_rate**2 - knee[1]) / (ROD * np.cos(rod))
    swing = across(rod) * rod_second - along(rod) * rod_rate**2
    push = SLIDER * (knee + ROD * swing)[0] + DAMPING * speed - pushed
    inertial = ROD_MASS * (knee + ROD / 2 * swing + [0.0, GRAVITY])
    turning = ROD_INERTIA * rod_second + ROD / 2 * moment(along(rod), inertial)
    # moment(along, -f) = sin f_x - cos f_z.
    lift = (np.sin(rod) * push - turning / ROD) / np.cos(rod)
    force = np.array([push, lift])
    return FLYWHEEL * second + CRANK * moment(along(crank), inertial + force), force


def driven(crank: float, rate: float, torque: float) -> float:
    """The crank's acceleration under a torque: by_hand is affine in it."""
    without, whole = (by_hand(crank, rate, second)[0] for second in (0.0, 1.0))
    return (torque - without) / (whole - without)


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


def test_behind_the_shaft_the_spring_drives():
    """The same crank under K (shaft - crank); degree 4, and forces that no control reaches."""
    loop, _ = build_scenario(scenario("slider_crank_flexible"))
    plant, structure = loop.plant, loop.controller.law.structure
    assert structure.output_degrees == (4,)
    assert structure.zero_dynamics_dimension == 0
    context, random = plant.CreateDefaultContext(), np.random.default_rng(1)
    for _ in range(4):
        crank, rate, twist, shaft_rate, control = random.uniform(-1.0, 1.0, 5)
        twist, rate = 0.01 * twist, 8.0 * rate
        state = np.concatenate([placed(crank, rate), [crank + twist, shaft_rate]])
        plant.set_state(context, state)
        plant.GetInputPort("control").FixValue(context, [control])
        second = driven(crank, rate, STIFFNESS * twist)
        rates = plant.EvalTimeDerivatives(context).CopyToVector()
        found = plant.GetOutputPort("constraint_force").Eval(context)
        assert_allclose(rates[3], second, rtol=1e-11)
        assert_allclose(rates[7], (control - STIFFNESS * twist) / SHAFT, rtol=1e-11, atol=1e-9)
        assert_allclose(found, by_hand(crank, rate, second)[1], rtol=1e-10, atol=1e-10)


def test_a_second_motor_steers_one_force_of_the_pin():
    """z = (crank, the pin's force along the guide), mu = (2, 0); the force across it follows."""
    plant = MultibodyPlant(0.0)
    parser = Parser(plant)
    parser.package_map().AddPackageXml(str(FOLDER / "models" / "package.xml"))
    parser.AddModelsFromUrl("package://drake_dae_models/slider_crank.urdf")
    plant.AddJointActuator("pump", plant.GetJointByName("slider"))
    plant.Finalize()
    pin = CoincidentPoints("rod", (ROD, 0, 0), "slider", (0, 0, 0), "xz")
    crank = JointPositions(["crank"])
    nominal = placed(0.7, 0.0)[:3]
    model = RobotModel.from_multibody(plant, [pin], [crank], nominal, forces=["pin.fx"])
    law = TrackingLaw(model.dae, poles(-6.0))
    assert law.structure.output_degrees == (2, 0)
    assert law.structure.zero_dynamics_dimension == 0
    block = RobotPlant(model, structure=law.structure)
    context, random = block.CreateDefaultContext(), np.random.default_rng(2)
    for _ in range(4):
        angle, rate, second, wanted = random.uniform(-6.0, 6.0, 4)
        state = placed(angle, rate)
        control = law.control(state, [angle, rate, second, wanted])
        alone = by_hand(angle, rate, second)[1]
        torque, force = by_hand(angle, rate, second, alone[0] - wanted)
        assert_allclose(force[0], wanted, atol=1e-12)
        assert_allclose(control, [torque, alone[0] - wanted], rtol=1e-11, atol=1e-11)
        block.set_state(context, state)
        block.GetInputPort("control").FixValue(context, control)
        found = block.GetOutputPort("constraint_force").Eval(context)
        assert_allclose(found, force, rtol=1e-11, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "order"), [("slider_crank", 2), ("slider_crank_flexible", 4)])
def test_the_error_is_that_of_poles_in_one_place(name, order):
    """e = e_0 exp(-6 t) sum_(k < order) (6 t)^k / k!, from rest; order poles at -6.

    The integrators leave 1e-8 rad along the first of six turns.
    """
    loop, _, record = run_scenario(scenario(name, "duration=2"))
    error, fast = record["tracking_error"][:, 0], 6.0 * record.time
    wanted = 0.2 * np.exp(-fast) * sum(fast**k / factorial(k) for k in range(order))
    assert_allclose(error, wanted, atol=1e-7)
    assert_allclose(loop.predicted_error(record)[:, 0], wanted, atol=1e-12)
    assert np.max(np.abs(record["constraint_residual"])) < 1e-8


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "shown"), [("slider_crank", 2e-7), ("slider_crank_flexible", 1e-7)]
)
def test_it_makes_six_turns_as_predicted(name, shown):
    """The crank passes its dead centres twelve times; its last error is a rest of the integrator's.

    The motor stays below its 25 N m.
    """
    loop, _, record = run_scenario(scenario(name))
    off = record["tracking_error"] - loop.predicted_error(record)
    assert np.max(np.abs(off)) < shown
    assert record["state"][-1, 0] - record["state"][0, 0] > 5.9 * 2 * np.pi
    assert np.max(np.abs(record["control"])) < 25.0
