"""Actuation stages: their dynamics, degrees, equilibria, parameters, and what they refuse."""

import casadi as ca
import numpy as np
import pytest
from actuated import (
    DEGREES,
    EACH,
    actuated,
    at_rest,
    drive,
    rates,
    start_position,
    states,
)
from arms import arm, touching

from drake_dae import LinkExpressions, RobotModel, RobotPlant, find_structure
from drake_dae.errors import AssumptionError, ModelError
from drake_dae.robots import DcMotors, ElectrohydraulicServos, FlexibleJoints, JointPositions


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), EACH)
def test_dynamics_are_those_of_a_dense_solve(name, kind):
    """x', lambda, tau and the stages' ports, from MultibodyPlant and NumPy; see `rates`.

    Condition numbers of about 4000 on numbers of about 1e3.
    """
    found, d, random = actuated(name, kind), drive(name, kind), np.random.default_rng(1)
    plant = RobotPlant(found.model, structure=found.structure)
    context = plant.CreateDefaultContext()
    p = len(d.torque)
    ports = {"link_state": slice(0, 2 * p)}
    if d.flexible:
        ports["motor_state"] = slice(2 * p, 4 * p)
    if d.electric:
        ports["motor_current"] = slice(-p, None)
    if d.fluid:
        ports["actuator_force"] = slice(-p, None)
    for x in states(name, kind, 5):
        u = 20.0 * random.standard_normal(p)
        plant.set_state(context, x)
        plant.GetInputPort("control").FixValue(context, u)
        exact = rates(name, d, x, u)
        derivative = plant.EvalTimeDerivatives(context).CopyToVector()
        np.testing.assert_allclose(derivative, exact.state, rtol=1e-10, atol=1e-10)
        force = plant.GetOutputPort("constraint_force").Eval(context)
        np.testing.assert_allclose(force, exact.force, rtol=1e-11, atol=1e-10)
        torque = plant.GetOutputPort("joint_torque").Eval(context)
        np.testing.assert_allclose(torque, exact.torque, rtol=1e-12, atol=1e-12)
        for port, part in ports.items():
            np.testing.assert_array_equal(plant.GetOutputPort(port).Eval(context), x[part])
    stage_ports = {"motor_state", "motor_current", "actuator_force"} - set(ports)
    assert not any(plant.HasOutputPort(port) for port in stage_ports)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), EACH)
def test_degrees_are_found(name, kind):
    """r = 2; joint damping takes one from mu = (4, 2), another stage adds one."""
    structure = actuated(name, kind).structure
    position, force = DEGREES[kind]
    count = len(arm(name).model.position_signals)
    assert structure.constraint_degrees == (2,)
    assert structure.output_degrees == (position,) * count + (force,)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), EACH)
def test_rest_state_is_the_static_equilibrium(name, kind):
    """tau = H - J^T lambda at v = 0, by MultibodyPlant; x' = 0 under the control that holds it.

    Round-off of q_2, times K_2 / M up to 3e6, accelerates the wrist by 1e-8 rad/s^2.
    """
    found, d, q = actuated(name, kind), drive(name, kind), start_position(name)
    for force in (-3.0, 0.0, 40.0):
        exact, control = at_rest(name, kind, q, force)
        x = found.model.rest_state(q, [force])
        np.testing.assert_allclose(x, exact, rtol=1e-9, atol=1e-9)
        here = rates(name, d, x, control)
        np.testing.assert_allclose(here.acceleration, 0.0, atol=1e-7)
        np.testing.assert_allclose(here.force, force, atol=1e-8)


def test_rest_state_needs_drives_that_hold_it():
    q, v = ca.SX.sym("q", 2), ca.SX.sym("v", 2)

    def pendulum(**changes):
        bias = ca.vertcat(9.81 * ca.sin(q[0]), 0.2 * q[1])
        given = {"actuation_matrix": [[0.0], [1.0]], "reflected_inertia": [0.5], **changes}
        links = LinkExpressions(q, v, ca.SX.eye(2), bias, **given)
        outputs = [JointPositions(["q1"])]
        return RobotModel(links, [], outputs, name="pendulum", actuation=[FlexibleJoints(100.0)])

    model = pendulum()
    np.testing.assert_allclose(model.rest_state([0.0, 1.0], []), [0, 1, 0, 0, 1.002, 0], atol=1e-12)
    with pytest.raises(ModelError, match=r"9\.8 N m"):
        model.rest_state([np.pi / 2, 0.0], [])
    values = model.dae.parameter_values
    values[model.dae.parameter_slice("flexible_joints.stiffness")] = 50.0
    assert model.rest_state([0.0, 1.0], [], values)[4] == pytest.approx(1.004)
    # What of M is rotors leaves the links: M = diag(1, 1 - 0.5).
    plant = RobotPlant(model)
    context = plant.CreateDefaultContext()
    plant.set_state(context, [0.0, 0.0, 0.0, 0.0, 0.01, 0.0])
    plant.GetInputPort("control").FixValue(context, [0.0])
    rate = plant.EvalTimeDerivatives(context).CopyToVector()
    np.testing.assert_allclose(rate, [0, 0, 0, 2.0, 0, -2.0], atol=1e-12)
    with pytest.raises(ModelError, match=r"M\(q\)"):
        pendulum(reflected_inertia=[1.5])
    with pytest.raises(ModelError, match=r"actuation.matrix"):
        pendulum(actuation_matrix=[[1.0], [1.0]])


@pytest.mark.parametrize(
    ("kind", "parameter", "matrix", "operation"),
    [
        ("flexible", "flexible_joints.stiffness", "stiffness", np.multiply),
        ("flexible", "flexible_joints.inertia", "inertia", np.multiply),
        ("damped", "flexible_joints.stiffness", "stiffness", np.multiply),
        ("damped", "flexible_joints.inertia", "inertia", np.multiply),
        ("damped", "flexible_joints.damping", "damping", np.multiply),
        ("motor", "dc_motors.inductance", "inductance", np.multiply),
        ("motor", "dc_motors.resistance", "resistance", np.multiply),
        ("motor", "dc_motors.torque_constant", "torque", np.multiply),
        ("motor", "dc_motors.gear_ratio", "torque", np.multiply),
        ("flexible hydraulic", "hydraulics.stiffness", "compliance", np.divide),
        ("flexible hydraulic", "hydraulics.leakage", "leakage", np.multiply),
    ],
)
def test_parameters_act_in_the_context(kind, parameter, matrix, operation):
    """A study changes them by name; the dense solve with the changed matrix says what follows."""
    found, d = actuated("two_link", kind), drive("two_link", kind)
    plant = RobotPlant(found.model, structure=found.structure)
    context = plant.CreateDefaultContext()
    x, u = states("two_link", kind, 1)[0], np.array([7.0, -3.0])
    plant.set_state(context, x)
    plant.GetInputPort("control").FixValue(context, u)
    before = plant.EvalTimeDerivatives(context).CopyToVector()
    value = plant.get_parameter(context, parameter)
    plant.set_parameter(context, parameter, 1.3 * value)
    after = plant.EvalTimeDerivatives(context).CopyToVector()
    changed = d._replace(**{matrix: operation(getattr(d, matrix), 1.3)})
    np.testing.assert_allclose(after, rates("two_link", changed, x, u).state, rtol=1e-11, atol=1e-9)
    assert not np.allclose(after, before, rtol=1e-6)


def test_controls_are_named_by_the_last_stage():
    rigid = arm("two_link").model
    for kind, ending, unit in (
        ("flexible", "", "N m"),
        ("flexible motor", ".voltage", "V"),
        ("flexible hydraulic", ".valve_current", ""),
    ):
        model = actuated("two_link", kind).model
        names = [f"{signal.name}{ending}" for signal in rigid.dae.control_signals]
        assert [(s.name, s.unit) for s in model.dae.control_signals] == [(n, unit) for n in names]
        limits = rigid.control_limits if kind == "flexible" else [np.inf, np.inf]
        np.testing.assert_array_equal(model.control_limits, limits)


MOTOR = {"torque_constant": 0.1, "inductance": 1e-3, "resistance": 0.5, "gear_ratio": 50.0}
SERVO = {"stiffness": 1e6, "leakage": 1e-6, "geometry": 0.05}
SHAFT = {"stiffness": 8e3, "inertia": 1.0}


@pytest.mark.parametrize(
    ("actuation", "message"),
    [
        ([FlexibleJoints(8e3)], "inertia.*joint1_motor, joint2_motor"),
        ([FlexibleJoints([8e3, -1.0], 1.0)], "stiffness.*-1"),
        ([FlexibleJoints([1.0, 2.0, 3.0], 1.0)], r"stiffness.*\(2,\) or \(2, 2\)"),
        ([FlexibleJoints(8e3, [1.0, 0.0])], "inertia.*0"),
        ([DcMotors(**MOTOR | {"torque_constant": [0.1, 0.0]})], "torque_constant"),
        ([DcMotors(**MOTOR | {"resistance": -1.0})], "resistance"),
        ([DcMotors(**MOTOR | {"resistance": np.eye(2)})], r"resistance.*\(2,\)"),
        ([ElectrohydraulicServos(**SERVO | {"stiffness": 0.0})], "stiffness"),
        ([ElectrohydraulicServos(**SERVO | {"leakage": -1e-6})], "leakage"),
        (
            [ElectrohydraulicServos(**SERVO | {"geometry": lambda q: q})],
            r"geometry.*\(2, 1\).*\(2, 2\)",
        ),
        (
            [DcMotors(**MOTOR), FlexibleJoints(**SHAFT)],
            "FlexibleJoints",
        ),
    ],
)
def test_refusals(actuation, message):
    with pytest.raises(ModelError, match=message):
        touching("two_link", actuation)


@pytest.mark.parametrize(
    ("stage", "numbers", "message"),
    [
        (FlexibleJoints, SHAFT | {"stiffness": [np.inf, 8e3]}, "stiffness"),
        (FlexibleJoints, SHAFT | {"stiffness": "stiff"}, "stiffness.*'stiff'"),
        (DcMotors, MOTOR | {"inductance": np.nan}, "inductance.*nan"),
    ],
)
def test_what_is_not_finite_is_refused_at_once(stage, numbers, message):
    with pytest.raises(ModelError, match=f"{stage.__name__}.*{message}"):
        stage(**numbers)


def test_damping_of_some_joints_is_refused():
    """The control would reach the outputs at different orders: B(x) is singular."""
    with pytest.raises((ModelError, AssumptionError)):
        find_structure(touching("two_link", [FlexibleJoints(**SHAFT, damping=[5.0, 0.0])]).dae)


@pytest.mark.parametrize(
    ("actuation", "message"),
    [
        (FlexibleJoints(**SHAFT), "actuation"),
        (["springs"], r"actuation\[0\].*'springs'"),
        ([FlexibleJoints(**SHAFT), FlexibleJoints(**SHAFT)], "FlexibleJoints"),
        ([FlexibleJoints(**{**SHAFT, "damping": [5.0, 0.0]})], "Damp"),
        (
            [ElectrohydraulicServos(1e6, 1e-6, lambda q: [[q[0], 0], [0, q[1]]])],
            "geometry",
        ),
    ],
)
def test_more_refusals(actuation, message):
    with pytest.raises(ModelError, match=message):
        touching("two_link", actuation)


@pytest.mark.parametrize("kind", DEGREES)
def test_the_default_state_is_at_rest(kind):
    """Also where nominal_positions is off the wall: no spring is strained, no force acts."""
    found = actuated("two_link", kind)
    plant = RobotPlant(found.model, structure=found.structure)
    context = plant.CreateDefaultContext()
    plant.GetInputPort("control").FixValue(context, np.zeros(2))
    force = plant.GetOutputPort("constraint_force").Eval(context)
    assert np.max(np.abs(force)) < 1e-6
    rate = plant.EvalTimeDerivatives(context).CopyToVector()[:4]
    # Condition numbers of about 1e3 on forces of about 1e2.
    assert np.max(np.abs(rate)) < 1e-7


def test_velocities_that_are_no_derivatives_are_refused():
    """q' = 2 v: a spring between positions would not do the work that it stores."""
    links = LinkExpressions(
        q=ca.SX.sym("q"),
        v=ca.SX.sym("v"),
        mass_matrix=ca.SX(3.0),
        bias=ca.SX(0.0),
        velocity_map=ca.SX(2.0),
    )
    with pytest.raises(ModelError, match="q_i' = v_i"):
        RobotModel(
            links, [], [JointPositions(["q0"])], actuation=[FlexibleJoints(8.0, inertia=1.0)]
        )
