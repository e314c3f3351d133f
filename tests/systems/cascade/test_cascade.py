"""The cascade for springs: against its equations on MultibodyPlant alone, and in contact."""

import numpy as np
import pytest
from actuated import actuated, at_rest, drive, output_bias, rates, start_position
from arms import arm, fixed_step, numbers
from numpy.testing import assert_allclose
from pydrake.multibody.plant import MultibodyPlant
from runs import scenario, some
from scenario_texts import run

from drake_dae import (
    LoopSettings,
    ReferenceGenerator,
    RobotPlant,
    Sampling,
    SinusoidReference,
    SpringCascade,
    SpringLoop,
    TrackingLaw,
    link_side,
    poles,
    simulate,
    wire_loop,
)
from drake_dae.errors import ModelError, ScenarioError, WiringError
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.rolled import for_rollout, roll_scenario
from drake_dae.scenario.start import start_scenario

T, POLE = 1e-3, -9.0
HEIGHT, FORCE = SinusoidReference(0.35, 0.05, 3.0), SinusoidReference(20.0, 5.0, 2.0)


def cascade(kind, loop, **more):
    model = actuated("two_link", kind).model
    law = TrackingLaw(link_side(model).dae, poles(POLE))
    return SpringCascade(law, model, loop, T, **more)


def in_the_project(kind, loop, end):
    """The states of a run by the blocks, at samples."""
    found, controller = actuated("two_link", kind), cascade(kind, loop)
    plant = RobotPlant(found.model, structure=found.structure)
    generator = ReferenceGenerator([HEIGHT, FORCE], controller.law.degrees)
    wired = wire_loop(plant, controller, generator, LoopSettings(sampling=Sampling(T)))
    context = wired.diagram.CreateDefaultContext()
    wired.set_state(context, at_rest("two_link", kind, start_position("two_link"), 20.0)[0])
    simulate(wired.diagram, context, end, fixed_step(T / 2))
    return wired.record(context)


def by_hand(kind, loop, end):
    """The state at the end: MultibodyPlant, NumPy and the classical Runge-Kutta method."""
    d, w, zeta = drive("two_link", kind), loop.rate, loop.damping
    x = at_rest("two_link", kind, start_position("two_link"), 20.0)[0]
    limits = np.array([a.effort_limit() for a in actuators(arm("two_link").plant)])
    K, B, u, memory = d.stiffness, d.inertia, None, None
    share = {rate: -np.expm1(-rate * T) for rate in (2.0 * w, loop.motor_rate)}
    f, slope = np.zeros(2), np.zeros(2)
    for k in range(round(end / T)):
        q, v, shaft, shaft_v = x[:2], x[2:4], x[4:6], x[6:8]
        n, t = numbers("two_link", q, v), k * T
        z, dz = n.outputs, n.output_jacobian @ v
        r = wanted(t)
        ubar = r[2] - POLE**2 * (z - r[0]) + 2.0 * POLE * (dz - r[1])
        rows = np.vstack([n.constraint_jacobian, n.output_jacobian])
        right = np.concatenate([-n.constraint_acceleration, ubar - output_bias("two_link", q, v)])
        a = np.linalg.solve(rows, right)
        push = 20.0 + 5.0 * np.sin(2.0 * t)
        tau_d = (n.mass - d.rotors) @ a + n.bias - n.constraint_jacobian.T @ [push]
        tau, moves = K @ (shaft - q), K @ (shaft_v - v)
        if memory is None:
            slow, measured = v, 0.0 * v
        else:
            last_d, last_tau, last_v, slow = memory
            rise = np.clip((tau_d - last_d) / T, -loop.slope * limits, loop.slope * limits)
            slope = slope + share[2.0 * w] * (rise - slope)
            slow = slow + share[2.0 * w] * (v - slow)
            measured = 2.0 * w * (v - slow)
        # What the project holds of the first sample has no slope either.
        excess = np.clip(K @ (a - measured) / w**2, -0.01 * limits, 0.01 * limits)
        ahead = measured + w**2 * np.linalg.solve(K, excess)
        new = w**2 * (tau_d - tau) + 2.0 * zeta * w * (slope - moves)
        command = tau + B @ (ahead + np.linalg.solve(K, new)) + f
        if memory is not None:  # It is seen at this sample, and used at the next one.
            lost = u - (tau + last_tau) / 2.0 - B @ (shaft_v - last_v) / T
            f = f + share[loop.motor_rate] * (lost - f)
        memory, u = (tau_d, tau, shaft_v, slow), command
        for _ in range(4):
            x = step(d, x, u, T / 4.0)
    return x


def wanted(t):
    """r, r', r'' of HEIGHT."""
    s, c = np.sin(3.0 * t), np.cos(3.0 * t)
    return np.array([0.35 + 0.05 * s, 0.15 * c, -0.45 * s])


def actuators(plant: MultibodyPlant):
    return [plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices()]


def step(d, x, u, h):
    def rate(state):
        return rates("two_link", d, state, u).state

    k1 = rate(x)
    k2 = rate(x + h / 2.0 * k1)
    k3 = rate(x + h / 2.0 * k2)
    k4 = rate(x + h * k3)
    return x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


@pytest.mark.slow
def test_the_blocks_compute_the_equations():
    """Of 50 samples of a sampled loop; both integrate to 1e-10, and errors grow by a hundred."""
    loop = SpringLoop(60.0, 0.8, 40.0)
    record = in_the_project("flexible", loop, 0.05)
    found = by_hand("flexible", loop, 0.05)
    assert np.abs(record["tracking_error"]).max() > 1e-4
    assert_allclose(record["state"][-1], found, atol=1e-8)


def test_links_by_themselves_are_without_rotors():
    """M and H of Drake's plant with rotors that have no inertia, at random states."""
    links = link_side(actuated("seven_joint", "flexible").model)
    system = links.dae
    plant = arm("seven_joint").plant
    context = plant.CreateDefaultContext()
    for actuator in actuators(plant):
        actuator.SetRotorInertia(context, 0.0)
    function = system.trace(
        "links", {"M": system.mass_matrix[7:, 7:], "H": -system.f[7:]}, often=False
    )
    random = np.random.default_rng(0)
    for _ in range(5):
        x = random.standard_normal(14)
        plant.SetPositionsAndVelocities(context, x)
        mass, bias = function(x, system.parameter_values)
        wanted_bias = plant.CalcBiasTerm(context) - plant.CalcGravityGeneralizedForces(context)
        assert_allclose(np.reshape(mass, (7, 7)), plant.CalcMassMatrix(context), atol=1e-12)
        assert_allclose(bias, wanted_bias, atol=1e-10)


SPRINGS = ("law=", "gains=", "integral=", "observer=")
BESIDE = ("plant_payloads=[{frame: tool, mass: 0.5}]", "plant.friction=0.6")
MOTORS = (
    "actuation.0.friction=0.0",
    "plant_parameters={flexible_joints.friction: [5, 5, 2.75, 2.75, 1.7, 0.6, 0.6]}",
)
VOLTAGES = (
    "actuation=[!FlexibleJoints {stiffness: [10000.0, 10000.0, 5000.0, 5000.0, 300.0, 400.0,"
    " 20.0]}, !DcMotors {torque_constant: 0.1, inductance: 0.002, resistance: 0.5}]",
)
REVERSING = (
    "references={tool.y: !Sinusoids {offset: 0, amplitudes: [0.1], frequencies: [1]},"
    " tool.z: 0.6, 'tool.z_axis, joint3, joint7': 0.0, wall.force: 20}",
)
CASES = {
    "circle": ((), 2.5, 0.01, 0.02),
    "voltages for motors with friction": ((*VOLTAGES, *MOTORS), 2.5, 0.1, 0.2),
    "reversals with a payload": ((*REVERSING, *BESIDE), 5.2, 0.2, 0.3),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", some(CASES, of=3))
def test_contact_is_kept_and_tracked_behind_springs(name):
    """What was asked of it, rms from 2 s on in mm and N; the law of four derivatives loses all but
    the first. The reversals are at 1.6 and 4.7 s."""
    settings, end, position, force = CASES[name]
    chosen, _ = for_rollout(
        scenario("wall_flexible_contact", *SPRINGS, *settings, f"duration={end}")
    )
    completed, loop = build_completed(chosen)
    assert completed.scenario.law.is_cascade
    found = roll_scenario(completed.scenario, loop, start_scenario(completed.scenario, loop))
    assert found.failure is None
    record = found.record
    assert record["constraint_force"][record.time > 0.05].min() > 0.0
    error = record["tracking_error"][record.time > 2.0]
    assert 1e3 * np.sqrt(np.square(error[:, :2]).sum(axis=1).mean()) < position
    assert np.sqrt(np.square(error[:, -1]).mean()) < force


@pytest.mark.slow
def test_the_bound_holds_on_an_exact_plant():
    """Errors after 0.8 s of a circle on an ideal wall, sampled at 1 kHz one sample late.

    The bound is of first order in the rate of the motion to that of the loop, 1 to 60 here, and the
    smallest of the seven ratios was 1.1.
    """
    settings = (
        "plant=!IdealConstraints {}",
        "law=!SpringCascade {rate: 60}",
        "gains=!Poles {all: [-10]}",
        "integral=[]",
        "observer=",
        "force_feedback=!ModelForce {}",
        "duration=1.5",
        "integrator={use_error_control: false, max_step_size: 0.001}",
    )
    loop, record, _ = run(scenario("wall_flexible_contact", *settings))
    bound = loop.controller.error_bound(loop.reference.reference, record.time, record["state"][0])
    largest = np.abs(record["tracking_error"][record.time > 0.8]).max(axis=0)
    assert np.all(largest < bound)
    assert np.all(bound < 4.0 * largest)


@pytest.mark.slow
def test_what_a_cascade_cannot_be_is_refused_in_a_sentence():
    base = "law=!SpringCascade {}", "gains=!Poles {all: [-10]}", "integral=", "observer="
    for changes, why in (
        (("sampling=",), "law: a cascade is sampled"),
        (("actuation=[]",), "law: .* has no springs at its joints"),
        (("control_weights=[1, 1, 1, 1, 1, 1, 1]", "forces=[]"), "law: .*`control_weights`"),
        (
            (
                "actuation=[!FlexibleJoints {stiffness: 1e4}, !ElectrohydraulicServos"
                " {stiffness: 2.0e+6, leakage: 1.0e-7, geometry: 0.1}]",
            ),
            "law: .*DcMotors or nothing",
        ),
    ):
        with pytest.raises(ScenarioError, match=why):
            build_completed(scenario("wall_flexible_contact", *base, *changes))


def test_a_law_or_a_plant_that_does_not_fit_is_refused():
    whole = actuated("two_link", "flexible")
    with pytest.raises(ModelError, match=r"link_side\(model\), got one with 8"):
        SpringCascade(TrackingLaw(whole.model.dae, poles(POLE)), whole.model, SpringLoop(50.0), T)
    rigid = arm("two_link")
    with pytest.raises(WiringError, match="8 states"):
        cascade("flexible", SpringLoop(50.0)).check_plant(
            RobotPlant(rigid.model, structure=rigid.structure)
        )
    with pytest.raises(ModelError, match="no springs"):
        link_side(rigid.model)
    with pytest.raises(ModelError, match="rate must be positive"):
        SpringLoop(0.0)
