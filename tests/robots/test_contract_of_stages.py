"""The rules of `Stage` on every member, and their dynamics, degrees, equilibria and refusals."""

import casadi as ca
import numpy as np
import pytest
from actuated import EACH, actuated, at_rest, drive, rates, start_position, states
from arms import arm, touching
from grippers import gripper, parsed
from members import TorqueLag, subclasses

from drake_dae import (
    DcMotors,
    ElectrohydraulicServos,
    FlexibleJoints,
    LinkExpressions,
    RobotModel,
    RobotPlant,
)
from drake_dae.errors import ModelError
from drake_dae.robots import JointPositions, MultibodyExpressions, Stage, chain
from drake_dae.trace.functions import TracedFunction

MEMBERS = {
    "flexible": FlexibleJoints(8e3, inertia=[1.0, 0.6]),
    "damped": FlexibleJoints(8e3, inertia=1.0, damping=[[8.0, 1.0], [1.0, 6.0]]),
    "motors": DcMotors(0.1, 2e-3, 0.5, [100.0, 80.0]),
    "hydraulics": ElectrohydraulicServos(1e6, 1e-6, lambda q: ca.diag(0.05 + 0.01 * ca.sin(q))),
    "lag": TorqueLag([0.02, 0.03]),
}


def test_no_member_is_left_out():
    assert subclasses(Stage) <= {type(stage) for stage in MEMBERS.values()}


@pytest.fixture(params=MEMBERS)
def stage(request):
    return MEMBERS[request.param]


def links():
    return arm("two_link").model.links


def test_sizes_and_names(stage):
    own, load = stage.attach(links()), [ca.SX.sym("q", 2), ca.SX.sym("v", 2)]
    k = own.state.numel()
    assert len(own.state_signals) == k
    assert own.mass.shape == (k, k)
    assert own.drift(*load).shape == (k, 1)
    assert own.force(*load).shape == (2, 1)
    assert own.drive_matrix.shape == (k, 2)
    assert len(own.drive_signals) == 2
    assert len({s.name for s in own.state_signals}) == k
    for part in own.ports.values():
        assert 0 <= part.start < part.stop <= k
    kinds = {p.name.split(".")[0] for p in own.parameters}
    assert len(kinds) == 1
    assert len({p.name for p in own.parameters}) == len(own.parameters) > 0


def test_equations_are_of_the_state_the_load_and_parameters(stage):
    """And E is symmetric positive definite."""
    own, load = stage.attach(links()), [ca.SX.sym("q", 2), ca.SX.sym("v", 2)]
    symbols = ca.vertcat(*[p.symbol for p in own.parameters])
    inputs = {"s": own.state, "q": load[0], "v": load[1], "p": symbols}
    values = np.concatenate([p.value for p in own.parameters])
    random = np.random.default_rng(0)
    numbers = [random.uniform(-1.0, 1.0, e.numel()) for e in (own.state, *load)]
    # A symbol that is none of these would be refused here.
    mass, *rest = TracedFunction(
        "stage", inputs, {"E": own.mass, "drift": own.drift(*load), "force": own.force(*load)}
    )(*numbers, values)
    np.testing.assert_array_equal(mass, mass.T)
    assert np.linalg.eigvalsh(mass)[0] > 0.0
    assert all(np.all(np.isfinite(part)) for part in rest)


def test_only_a_shaft_can_be_driven_by_a_stage(stage):
    behind = [stage, MEMBERS["motors"]]
    if stage.attach(links()).shaft is None:
        with pytest.raises(ModelError, match=f"DcMotors.*{type(stage).__name__}"):
            chain(behind, links())
    else:
        assert len(chain(behind, links()).stages) == 2


@pytest.mark.parametrize("driven", [("arm",), ("left",), ("arm", "left")])
def test_shafts_have_the_units_of_the_joints_that_they_drive(driven):
    """The arm of a gripper turns, and its left finger slides."""
    links = MultibodyExpressions(parsed(gripper(driven)))
    own = FlexibleJoints(8e3, inertia=1.0).attach(links)
    wanted = ["rad" if name == "arm" else "m" for name in driven]
    assert [s.unit for s in own.state_signals] == [*wanted, *(f"{unit}/s" for unit in wanted)]


@pytest.mark.slow
def test_a_drive_holds_any_force_at_rest(stage):
    """And the control does not reach the constraint force in the same instant."""
    model = touching("two_link", [stage])
    plant = RobotPlant(model)
    control = plant.GetInputPort("control").get_index()
    for name in ("constraint_force", "joint_torque", *stage.attach(links()).ports):
        assert not plant.HasDirectFeedthrough(control, plant.GetOutputPort(name).get_index())
    q = model.configuration([0.3], [1.2, -1.6])
    context = plant.CreateDefaultContext()
    plant.GetInputPort("control").FixValue(context, np.zeros(2))
    for force in (-7.0, 0.0, 40.0):
        plant.set_state(context, model.rest_state(q, [force]))
        rate = plant.EvalTimeDerivatives(context).CopyToVector()
        # Springs of 8e3 N m/rad on 0.2 kg m^2: round-off of the shafts gives 1e-11 rad/s^2.
        np.testing.assert_allclose(rate[:4], 0.0, atol=1e-9)
        found = plant.GetOutputPort("constraint_force").Eval(context)
        np.testing.assert_allclose(found, force, atol=1e-9)


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
        matrix = changes.pop("actuation_matrix", [[0.0], [1.0]])
        links = LinkExpressions(q, v, ca.SX.eye(2), bias, actuation_matrix=matrix)
        links.reflected_inertia = np.array([changes.get("reflected_inertia", 0.5)])
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
        pendulum(reflected_inertia=1.5)
    with pytest.raises(ModelError, match=r"actuation.matrix"):
        pendulum(actuation_matrix=[[1.0], [1.0]])


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
        ([FlexibleJoints(**SHAFT), FlexibleJoints(**SHAFT)], "flexible_joints"),
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
        ([DcMotors(**MOTOR), FlexibleJoints(**SHAFT)], "FlexibleJoints"),
    ],
)
def test_refusals(actuation, message):
    with pytest.raises(ModelError, match=message):
        touching("two_link", actuation)


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
