"""Robots that hit walls and leave them, against integrations of equations written by hand."""

import numpy as np
import pytest
from arms import arm, numbers, touching
from falling import GRAVITY, HALF, HEIGHT, MASS, ball_model, box, simulator_of
from numpy.testing import assert_allclose
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, RevoluteJoint, SpatialInertia, UnitInertia
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import TrajectorySource, ZeroOrderHold
from pydrake.trajectories import PiecewisePolynomial
from runs import in_equal_steps
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from drake_dae import (
    ConstantReference,
    FlexibleJoints,
    Plane,
    PointOnSurface,
    ReferenceGenerator,
    RobotModel,
    RobotPlant,
    SinusoidReference,
    UnilateralRobotPlant,
)
from drake_dae.systems.plants.contact_events import ContactChange
from drake_dae.systems.plants.unilateral.log import RunLog, clearance

WALL = -0.5


@pytest.fixture(scope="module")
def pendulum():
    """Two massless rods of 1 m with 1 kg at each end; a wall keeps the tip at x <= WALL."""
    plant = MultibodyPlant(0.0)
    parent, offset = plant.world_frame(), RigidTransform()
    for name in ("upper", "lower"):
        inertia = SpatialInertia(1.0, [0, 0, -1], UnitInertia.PointMass([0, 0, -1]))
        body = plant.AddRigidBody(name, inertia)
        at = plant.AddFrame(FixedOffsetFrame(f"{name}_at", parent, offset))
        plant.AddJoint(RevoluteJoint(name, at, body.body_frame(), [0, -1, 0]))
        parent, offset = body.body_frame(), RigidTransform([0, 0, -1])
    plant.AddFrame(FixedOffsetFrame("tip", parent, offset))
    plant.Finalize()
    wall = PointOnSurface("tip", Plane((WALL, 0, 0), (-1, 0, 0)), name="wall")
    nominal = [-0.3, 0.1]
    model = RobotModel.from_multibody(plant, [wall], [], nominal, forces=[])
    return UnilateralRobotPlant(model, {"wall": 0.0})


def by_hand(x):
    """M, H, J and J' v in the angles of both rods to the vertical."""
    a, b, va, vb = x
    c, s = np.cos(a - b), np.sin(a - b)
    mass = np.array([[2.0, c], [c, 1.0]])
    bias = np.array([s * vb**2 + 2.0 * GRAVITY * np.sin(a), -s * va**2 + GRAVITY * np.sin(b)])
    jacobian = -np.cos([a, b])
    return mass, bias, jacobian, np.sin(a) * va**2 + np.sin(b) * vb**2


def force_by_hand(x):
    mass, bias, jacobian, curved = by_hand(x)
    pushed = np.linalg.solve(mass, jacobian)
    return (pushed @ bias - curved) / (jacobian @ pushed)


def integrated_by_hand(x, restitution, end):
    """Times and impulses of events, 0 where the contact opens, and the last state."""
    time, closed, events = 0.0, False, []
    while True:
        began = time

        def rate(_, x, closed=closed):
            mass, bias, jacobian, _ = by_hand(x)
            force = force_by_hand(x) if closed else 0.0
            return np.concatenate([x[2:], np.linalg.solve(mass, jacobian * force - bias)])

        def guard(t, x, closed=closed, began=began):
            if closed:
                return force_by_hand(x)
            return WALL - np.sin(x[0]) - np.sin(x[1]) if t > began + 1e-6 else 1.0

        guard.terminal, guard.direction = True, -1.0
        found = solve_ivp(
            rate, (time, end), x, method="DOP853", rtol=1e-12, atol=1e-13, events=guard
        )
        time, x = found.t[-1], found.y[:, -1].copy()
        if found.status != 1:
            return events, x
        impulse = 0.0
        if not closed:
            mass, _, jacobian, _ = by_hand(x)
            pushed = np.linalg.solve(mass, jacobian)
            impulse = -(1.0 + restitution) * (jacobian @ x[2:]) / (jacobian @ pushed)
            x[2:] += pushed * impulse
        events.append((time, impulse))
        closed = not closed and restitution == 0.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("restitution", "kinds"),
    [
        (0.7, [ContactChange.IMPACT] * 3),
        (0.0, [ContactChange.REST, ContactChange.OPENING] * 2),
    ],
)
def test_a_double_pendulum_hits_a_wall_as_an_integration_by_hand_says(pendulum, restitution, kinds):
    """Steps of 2 ms and windows of 2e-13 s leave some 1e-11; the other has 1e-12 a step."""
    start = np.array([-1.62, -1.37, -0.14, -1.75])
    simulator, context = simulator_of(pendulum, start, step=0.002)
    pendulum.set_parameter(context, "wall.restitution", restitution)
    simulator.AdvanceTo(1.2)
    sums = np.array([[1.0, 0, 0, 0], [1.0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1, 1]])
    wanted, last = integrated_by_hand(sums @ start, restitution, 1.2)
    events = pendulum.events(context)
    assert [event.kind for event in events] == kinds
    assert_allclose([event.time for event in events], [time for time, _ in wanted], atol=1e-10)
    impulses = [event.impulses[0] if event.impulses else 0.0 for event in events]
    assert_allclose(impulses, [impulse for _, impulse in wanted], rtol=1e-9)
    assert_allclose(sums @ pendulum.state(context), last, atol=1e-9)


def test_the_graph_of_modes_is_read_and_drawn(pendulum):
    graph = pendulum.graph
    assert graph.modes == ((), ("wall",))
    assert str(graph).splitlines() == [
        "robot: 2 modes",
        "{} -> {} when phi(wall) falls to 0: phi'(wall) := -e phi'(wall)",
        "{} -> {wall} when phi(wall) falls to 0 and bouncing would end within the settling time: "
        "phi'(wall) := 0",
        "{wall} -> {} when lambda(wall) falls to 0",
    ]
    drawn = graph.graphviz()
    assert drawn.startswith('digraph "robot" {')
    assert drawn.count("->") == 3


def test_what_stays_closed_moves_as_a_robot_plant():
    """The same equations; they are traced in another order, and projected likewise."""
    found, pushed = arm("two_link"), [12.0, 25.0]
    plants = (
        UnilateralRobotPlant(found.model, {"wall": 0.5}),
        RobotPlant(found.model, structure=found.structure),
    )
    shown = []
    for plant in plants:
        simulator = Simulator(plant)
        ResetIntegratorFromFlags(simulator, "runge_kutta3", 0.005)
        simulator.get_mutable_integrator().set_fixed_step_mode(True)
        context = simulator.get_mutable_context()
        plant.set_state(context, found.structure.manifold.project(found.model.dae.nominal_state))
        plant.GetInputPort("control").FixValue(context, pushed)
        context.SetAccuracy(1e-8)
        simulator.AdvanceTo(0.1)
        simulator.AdvancePendingEvents()
        names = ("state", "constraint_force", "constraint_residual", "controlled_output")
        names += ("link_state", "constraint_wrenches")
        shown.append([plant.GetOutputPort(name).Eval(context) for name in names])
        assert shown[-1][1] > 1.0
    for one, other in zip(*shown, strict=True):
        assert_allclose(one, other, rtol=1e-10, atol=1e-12)


def test_stages_keep_their_state_through_an_impact():
    """v+ = v- + M^-1 J' Lambda by MultibodyPlant; shafts behind springs go on as they were."""
    model = touching("two_link", [FlexibleJoints(stiffness=8000.0, inertia=0.5)])
    plant = UnilateralRobotPlant(model, {"wall": 0.5})
    q, v = model.configuration(None, [1.2, -1.6]), np.array([0.3, -0.2])
    found = numbers("two_link", q, v)
    (approach,) = found.constraint_jacobian @ v
    v *= -np.sign(approach)
    before = np.concatenate([q, v, q, [0.4, -0.1]])
    _, context = simulator_of(plant, before)
    (event,) = plant.events(context)
    pushed = np.linalg.solve(found.mass, found.constraint_jacobian[0])
    impulse = 1.5 * abs(approach) / (found.constraint_jacobian[0] @ pushed)
    after = plant.state(context)
    assert_allclose(event.impulses, [impulse], rtol=1e-12)
    assert_allclose(after[2:4], v + pushed * impulse, rtol=1e-12)
    assert_allclose(after[[0, 1, 4, 5, 6, 7]], before[[0, 1, 4, 5, 6, 7]], atol=1e-15)
    lost = 0.5 * (v @ found.mass @ v - after[2:4] @ found.mass @ after[2:4])
    assert_allclose(event.energy_lost, lost, rtol=1e-10)
    assert_allclose(plant.GetOutputPort("motor_state").Eval(context), before[4:])
    assert plant.GetOutputPort("joint_torque").size() == 2


@pytest.mark.parametrize("hold", [None, 0.01])
def test_a_control_that_jumps_opens_a_contact_at_once(hold):
    """A torque of 2 m g b from 0.03 s on, within a step, or held by a sampling that begins one."""
    builder = DiagramBuilder()
    plant = builder.AddSystem(box({"left": 0.0, "right": 0.0}))
    torque = 2.0 * MASS * GRAVITY * HALF
    jump = PiecewisePolynomial.ZeroOrderHold(
        [0.0, 0.03, 1.0], [[0.0, 0.0, 0.0], [0.0, torque, 0.0]]
    )
    source = builder.AddSystem(TrajectorySource(jump))
    if hold:
        held = builder.AddSystem(ZeroOrderHold(hold, 2))
        builder.Connect(source.get_output_port(), held.get_input_port())
        source = held
    builder.Connect(source.get_output_port(), plant.GetInputPort("control"))
    simulator, root, context = in_equal_steps(builder, plant, "runge_kutta3", 0.008)
    plant.set_state(context, [0.0, HEIGHT, 0.0, 0.0, 0.0, 0.0])
    root.SetAccuracy(1e-8)
    simulator.AdvanceTo(0.05)
    (event,) = plant.events(context)
    assert event.kind is ContactChange.OPENING
    assert event.contacts == ("left",)
    assert abs(event.time - 0.03) < 1e-11


@pytest.mark.parametrize("pull", [0.0, -1e-15, 1e-15, 1e-7])
def test_a_contact_without_force_keeps_its_mode_whatever_the_sign_of_round_off(pull):
    """Torques take the weight of a resting arm off its wall; those that pull as well open it.

    A pull of 1e-15 of the weight changes the last bits of the torques; one of 1e-7 is a million
    times the round-off of a force.
    """
    model = touching("two_link")
    plant = UnilateralRobotPlant(model, {"wall": 0.0})
    q = model.configuration(None, [1.2, -1.6])
    found = numbers("two_link", q, np.zeros(2))
    (jacobian,) = found.constraint_jacobian  # At rest the bias is the weight.
    simulator, context = simulator_of(
        plant, np.concatenate([q, np.zeros(2)]), control=found.bias - 5.0 * jacobian
    )
    simulator.AdvanceTo(0.01)
    assert_allclose(plant.GetOutputPort("constraint_force").Eval(context), [5.0], rtol=1e-9)
    weight = np.linalg.norm(found.bias)
    plant.GetInputPort("control").FixValue(context, found.bias + pull * weight * jacobian)
    simulator.AdvanceTo(0.05)
    assert [event.kind for event in plant.events(context)] == [ContactChange.OPENING] * (
        pull > 1e-10
    )
    assert plant.closed(context) == (() if pull > 1e-10 else ("wall",))


def test_a_gap_that_opens_at_rest_has_no_dip_by_the_sign_of_round_off():
    """A gap of t^4 from rest: the cubic through its ends falls, but a gap at rest does not."""
    step, growth = 1e-3, 1e7
    after, rate = np.array([growth * step**4]), np.array([4.0 * growth * step**3])
    for still in (-1e-16, 0.0, 1e-16):
        log = RunLog(time=0.0, gaps=np.zeros(1), rates=np.array([still]))
        assert clearance(log, step, after, rate) > 0.0
    falling = RunLog(time=0.0, gaps=np.zeros(1), rates=np.array([-1e-3]))
    assert clearance(falling, step, after, rate) < 0.0


def test_a_table_that_falls_away_faster_than_g_leaves_the_ball():
    """z = A sin(w t): lambda = m (g - A w^2 sin(w t)) comes to zero where sin(w t) = g / (A w^2).

    From there the ball flies, and the table meets it again where both are equally high.
    """
    amplitude, frequency = 0.05, 20.0
    model = ball_model(exogenous=["floor.position"])
    builder = DiagramBuilder()
    plant = builder.AddSystem(UnilateralRobotPlant(model, {"floor": 0.5}))
    moving = ReferenceGenerator(
        [ConstantReference([0.0, 0.0]), SinusoidReference(0.0, amplitude, frequency)],
        plant.exogenous_layout.degrees,
    )
    table = builder.AddSystem(moving)
    builder.Connect(table.get_output_port(), plant.GetInputPort("exogenous"))
    simulator, root, context = in_equal_steps(builder, plant, "runge_kutta5", 0.002)
    plant.set_state(context, [0.0, amplitude * frequency])
    root.SetAccuracy(1e-8)
    simulator.AdvanceTo(0.4)
    leaves, hits, *_ = plant.events(context)
    leaving = np.arcsin(GRAVITY / (amplitude * frequency**2)) / frequency
    assert leaves.kind is ContactChange.OPENING
    assert abs(leaves.time - leaving) < 1e-11
    start, speed = GRAVITY / frequency**2, amplitude * frequency * np.cos(frequency * leaving)

    def apart(t):
        fly = t - leaving
        return start + speed * fly - GRAVITY * fly**2 / 2.0 - amplitude * np.sin(frequency * t)

    hitting = brentq(apart, leaving + 0.02, leaving + 0.4, xtol=1e-14)
    assert hits.kind is ContactChange.IMPACT
    assert abs(hits.time - hitting) < 1e-10
    table_speed = amplitude * frequency * np.cos(frequency * hitting)
    approach = speed - GRAVITY * (hitting - leaving) - table_speed
    assert_allclose(hits.impulses, [-1.5 * approach], rtol=1e-9)
