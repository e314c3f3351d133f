"""Contacts that open and close, against closed forms."""

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator

from drake_dae import (
    CoincidentPoints,
    LinkExpressions,
    Plane,
    PointOnSurface,
    RobotModel,
    UnilateralRobotPlant,
)
from drake_dae.errors import InconsistentStateError, ModelError, SimulationError
from drake_dae.systems.unilateral.events import ContactChange

GRAVITY = 9.81
FLOOR = Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))


def ball(restitution, mass=1.0):
    """A ball that falls onto a floor, z its height; nothing drives it."""
    z, v = ca.SX.sym("z"), ca.SX.sym("v")
    links = LinkExpressions(
        z,
        v,
        ca.SX(mass),
        ca.SX(mass * GRAVITY),
        {"ball": ca.vertcat(0, 0, z)},
        actuation_matrix=np.zeros((1, 0)),
    )
    model = RobotModel(links, [PointOnSurface("ball", FLOOR, name="floor")], [], forces=[])
    return UnilateralRobotPlant(model, {"floor": restitution})


HALF, HEIGHT, MASS = 0.2, 0.5, 2.0
INERTIA = MASS * (HALF**2 + HEIGHT**2) / 3.0


def box(restitution, **options):
    """A box on two feet in the x-z plane, pushed along x and turned: x, z, angle about y."""
    q, v = ca.SX.sym("q", 3), ca.SX.sym("v", 3)
    c, s = ca.cos(q[2]), ca.sin(q[2])
    turned = ca.vertcat(ca.horzcat(c, 0, s), ca.horzcat(0, 1, 0), ca.horzcat(-s, 0, c))
    links = LinkExpressions(
        q,
        v,
        ca.diag(ca.SX([MASS, MASS, INERTIA])),
        ca.SX([0.0, MASS * GRAVITY, 0.0]),
        {"box": (turned, ca.vertcat(q[0], 0, q[1]))},
        actuation_matrix=np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 1.0]]),
        default_positions=np.array([0.0, HEIGHT, 0.0]),
    )
    feet = [
        PointOnSurface("box", FLOOR, (side * HALF, 0.0, -HEIGHT), name=name)
        for name, side in (("left", -1.0), ("right", 1.0))
    ]
    model = RobotModel(links, feet, [], forces=[])
    contacts = {"left": restitution, "right": restitution}
    return UnilateralRobotPlant(model, contacts, **options)


@pytest.fixture(scope="module")
def bouncing_box():
    return box(0.5)


def simulator_of(plant, state, step=0.01, accuracy=1e-8, scheme="runge_kutta5"):
    """Fixed steps, and events to a hundredth of `accuracy` in steps."""
    simulator = Simulator(plant)
    ResetIntegratorFromFlags(simulator, scheme, step)
    simulator.get_mutable_integrator().set_fixed_step_mode(True)
    context = simulator.get_mutable_context()
    controls = plant.GetInputPort("control").size()
    if controls:
        plant.GetInputPort("control").FixValue(context, np.zeros(controls))
    plant.set_state(context, state)
    context.SetAccuracy(accuracy)
    simulator.Initialize()
    return simulator, context


def kinetic(plant, velocity):
    mass = np.diag([MASS, MASS, INERTIA])
    return 0.5 * velocity @ mass @ velocity


@pytest.mark.slow
def test_a_ball_bounces_when_the_closed_form_says_and_comes_to_rest_at_its_limit():
    """t_1 = sqrt(2 h / g), t_(k+1) = t_k + 2 e^k t_1; the limit is t_1 (1 + e) / (1 - e).

    Every scheme is exact along a parabola. Windows of 1e-12 s add up over 86 bounces; the rest
    counts from a speed of 5e-4 m/s, whose error of 1e-11 m/s counts 2 / (g (1 - e)) times.
    """
    plant = ball(0.9)
    simulator, context = simulator_of(plant, [1.0, 0.0], scheme="runge_kutta2")
    simulator.AdvanceTo(10.0)
    events = plant.events(context)
    first = np.sqrt(2.0 / GRAVITY)
    flights = np.concatenate([[first], 2.0 * first * 0.9 ** np.arange(1, len(events))])
    assert_allclose([event.time for event in events], np.cumsum(flights), atol=1e-10)
    literal = [0.4515236409857309, 1.2642661947600464, 1.9957344931569305, 2.654055961714126]
    assert_allclose([event.time for event in events[:4]], literal, atol=1e-11)
    assert events[-1].kind is ContactChange.REST
    assert abs(events[-1].rest_time - 8.578949178728887) < 1e-9
    assert abs(events[0].impulses[0] - 8.415949144333) < 1e-11
    # All energy, m g h, is lost in the end, but round-off of windows.
    assert_allclose(sum(event.energy_lost for event in events), GRAVITY, atol=1e-9)
    assert plant.closed(context) == ("floor",)
    assert_allclose(plant.state(context), 0.0, atol=1e-15)
    force = plant.GetOutputPort("constraint_force").Eval(context)
    assert_allclose(force, [GRAVITY], rtol=1e-14)
    assert_allclose(plant.GetOutputPort("mode").Eval(context), [1.0])


def test_a_ball_without_loss_returns_to_its_height():
    plant = ball(1.0)
    simulator, context = simulator_of(plant, [0.1, 0.0], step=0.02)
    fall = np.sqrt(2.0 * 0.1 / GRAVITY)
    simulator.AdvanceTo(2.0 * fall)
    assert_allclose(plant.state(context), [0.1, 0.0], atol=1e-10)
    (event,) = plant.events(context)
    assert event.kind is ContactChange.IMPACT
    assert_allclose(event.energy_lost, 0.0, atol=1e-14)
    assert_allclose(plant.GetOutputPort("constraint_force").Eval(context), [0.0], atol=0.0)


def test_a_ball_without_bounce_stays():
    plant = ball(0.0, mass=3.0)
    simulator, context = simulator_of(plant, [0.1, 0.0], step=0.05)
    simulator.AdvanceTo(0.3)
    (event,) = plant.events(context)
    fall = np.sqrt(2.0 * 0.1 / GRAVITY)
    assert event.kind is ContactChange.REST
    assert event.rest_time == event.time
    assert_allclose(event.time, fall, atol=1e-11)
    assert_allclose(event.impulses, [3.0 * GRAVITY * fall], rtol=1e-10)
    assert str(event).startswith("0.142784")
    assert str(event).endswith("closed: floor")


def test_a_flat_box_lands_on_both_feet_at_once(bouncing_box):
    """As a ball does, in free fall by 0.2 m; each foot takes half of (1 + e) m v."""
    plant = bouncing_box
    simulator, context = simulator_of(plant, [0.0, HEIGHT + 0.2, 0.0, 0.0, 0.0, 0.0])
    simulator.AdvanceTo(0.7)
    first, *_, last = plant.events(context)
    fall = np.sqrt(2.0 * 0.2 / GRAVITY)
    assert first.contacts == last.contacts == ("left", "right")
    assert_allclose(first.impulses, 0.75 * MASS * GRAVITY * fall * np.ones(2), rtol=1e-9)
    assert_allclose(last.rest_time, 3.0 * fall, atol=1e-10)
    force = plant.GetOutputPort("constraint_force").Eval(context)
    assert_allclose(force, 0.5 * MASS * GRAVITY * np.ones(2), rtol=1e-12)


def test_a_box_tips_where_the_moment_outweighs_it(bouncing_box):
    """A torque tau moves the load: m g b = |tau| lifts a foot; then it turns about the other."""
    plant = bouncing_box
    simulator, context = simulator_of(plant, [0.0, HEIGHT, 0.0, 0.0, 0.0, 0.0])
    assert plant.closed(context) == ("left", "right")
    assert plant.events(context) == ()
    port, most = plant.GetInputPort("control"), MASS * GRAVITY * HALF
    for torque, closed in ((0.999 * most, ("left", "right")), (1.001 * most, ("right",))):
        port.FixValue(context, [0.0, torque])
        simulator.AdvanceTo(context.get_time() + 0.02)
        assert plant.closed(context) == closed
    assert [event.kind for event in plant.events(context)][-1] is ContactChange.OPENING
    force = plant.GetOutputPort("constraint_force").Eval(context)
    assert force[0] == 0.0
    # J M^-1 J^T lambda = g + b tau / I where it is upright, but for the angle, below 1e-5.
    acceleration = GRAVITY + HALF * 1.001 * most / INERTIA
    mobility = 1.0 / MASS + HALF**2 / INERTIA
    assert_allclose(force[1], acceleration / mobility, rtol=1e-3)


def test_complementarity_holds_and_no_impact_gains_energy(bouncing_box):
    """At every step phi >= 0, lambda >= 0, phi lambda = 0; a fixed step leaves N* by 1e-10."""
    plant = bouncing_box
    start = [0.0, 0.7, 0.1, 0.3, 0.0, 0.4]
    simulator, context = simulator_of(plant, start, step=0.005)
    seen = []

    def monitor(at):
        force = plant.GetOutputPort("constraint_force").Eval(at)
        seen.append((plant.gaps(at), force, plant.GetOutputPort("mode").Eval(at)))

    simulator.set_monitor(monitor)
    simulator.AdvanceTo(0.9)
    gaps, forces, modes = (np.array(part) for part in zip(*seen, strict=True))
    assert gaps.min() > -1e-9
    assert forces.min() >= 0.0
    assert np.all(forces[modes == 0.0] == 0.0)
    assert np.abs(gaps[modes == 1.0]).max() < 1e-9
    events = plant.events(context)
    assert {event.kind for event in events} >= {ContactChange.IMPACT, ContactChange.REST}
    assert min(event.energy_lost for event in events) >= 0.0


def test_a_start_inside_or_without_accuracy_is_refused(bouncing_box):
    plant = bouncing_box
    with pytest.raises(InconsistentStateError, match=r"0\.1 m inside the surface of 'left'"):
        simulator_of(plant, [0.0, HEIGHT - 0.1, 0.0, 0.0, 0.0, 0.0])
    simulator = Simulator(plant)
    plant.GetInputPort("control").FixValue(simulator.get_mutable_context(), [0.0, 0.0])
    with pytest.raises(SimulationError, match="SetAccuracy"):
        simulator.Initialize()
    with pytest.raises(ModelError, match="does not convert"):
        plant.ToAutoDiffXd()


def test_contacts_that_make_no_sense_are_refused(bouncing_box):
    model = bouncing_box.model
    with pytest.raises(ModelError, match=r"\['left', 'right'\]"):
        UnilateralRobotPlant(model, {})
    with pytest.raises(ModelError, match="lefft"):
        UnilateralRobotPlant(model, {"lefft": 0.5})
    with pytest.raises(ModelError, match=r"between 0, no bounce, and 1.*got 1\.5"):
        UnilateralRobotPlant(model, {"left": 1.5})
    with pytest.raises(ModelError, match="settling_time"):
        UnilateralRobotPlant(model, {"left": 0.5}, settling_time=0.0)
    pinned = CoincidentPoints("world", (0, 0, 0), "box", (0, 0, 0), axes="xz", name="pin")
    both = RobotModel(model.links, [*model.constraints, pinned], [], forces=[])
    with pytest.raises(ModelError, match="'pin' cannot open"):
        UnilateralRobotPlant(both, {"pin": 0.5})
