"""Contacts that open and close, against closed forms."""

import numpy as np
import pytest
from falling import (
    GRAVITY,
    HALF,
    HEIGHT,
    INERTIA,
    MASS,
    ball,
    box,
    rocking_block,
    simulator_of,
    standing_on_right,
)
from numpy.testing import assert_allclose
from pydrake.systems.analysis import Simulator
from scipy.integrate import quad

from drake_dae import CoincidentPoints, RobotModel, UnilateralRobotPlant
from drake_dae.errors import InconsistentStateError, ModelError, SimulationError
from drake_dae.systems.plants.contact_events import ContactChange
from drake_dae.systems.plants.unilateral.log import RunLog, clearance


@pytest.fixture(scope="module")
def bouncing_box():
    return box({"left": 0.5, "right": 0.5})


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


@pytest.mark.slow
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
    # J M^-1 J^T lambda = g + b tau / I where it is upright, except for the angle, below 1e-5.
    acceleration = GRAVITY + HALF * 1.001 * most / INERTIA
    mobility = 1.0 / MASS + HALF**2 / INERTIA
    assert_allclose(force[1], acceleration / mobility, rtol=1e-3)


@pytest.mark.slow
def test_a_block_rocks_as_housner_says_and_comes_to_rest_at_its_limit():
    """From rest at an angle t to its right foot. About a foot, R = sqrt(b^2 + h^2) away from the
    centre, tan a = b / h, with I_o = I + m R^2,

        I_o w^2 / 2 = m g R (cos(a - t_max) - cos(a - t)),

    and where it is flat the moment about the new foot is kept: w+ / w- = 1 - 2 m R^2 sin^2 a / I_o,
    which for a box is 1 - 3/2 sin^2 a (Housner 1963), so that its height above the edge, the cosine
    of a - t_max less that of a, shrinks by the square. Times come from quadrature in s, where
    t = t_max (1 - s^2) takes the singularity away.
    """
    reach, a = np.hypot(HALF, HEIGHT), np.arctan2(HALF, HEIGHT)
    about_foot = INERTIA + MASS * reach**2
    ratio = 1.0 - 1.5 * np.sin(a) ** 2
    assert_allclose(ratio, 1.0 - 2.0 * MASS * reach**2 * np.sin(a) ** 2 / about_foot, rtol=1e-14)

    def fall(most):
        def integrand(s):
            angle = most * (1.0 - s * s)
            # cos(a - most) - cos(a - angle), without cancellation.
            drop = 2.0 * np.sin(a - (most + angle) / 2.0) * np.sin((most - angle) / 2.0)
            speed = np.sqrt(2.0 * MASS * GRAVITY * reach * drop / about_foot)
            return 2.0 * most * s / speed

        return quad(integrand, 0.0, 1.0, epsabs=0.0, epsrel=1e-12)[0]

    def angle_of(height):
        # Of height = sin(a) t - cos(a) t^2 / 2 - ... where the arc cosine would cancel.
        if height > 1e-6:
            return a - np.arccos(np.cos(a) + height)
        return height / np.sin(a) * (1.0 + height / np.tan(a) / np.sin(a) / 2.0)

    height, time, times = np.cos(a - 0.1) - np.cos(a), 0.0, []
    for _ in range(45):
        duration, height = fall(angle_of(height)), height * ratio**2
        times.append(time + duration)
        period = duration + fall(angle_of(height))
        time += period
    limit = time + period * ratio / (1.0 - ratio)  # Angles of 1e-9 are small.
    plant = rocking_block()
    simulator, context = simulator_of(plant, standing_on_right(0.1), step=0.01)
    simulator.AdvanceTo(1.75)
    events = plant.events(context)
    hits = [event for event in events if event.kind is not ContactChange.OPENING]
    found = [event.time for event in hits]
    # Fixed steps of 10 ms leave some 1e-10 of the speed.
    assert_allclose(found, times[: len(found)], atol=1e-8)
    assert_allclose(hits[1].energy_lost / hits[0].energy_lost, ratio**2, rtol=1e-7)
    assert hits[-1].kind is ContactChange.REST
    assert plant.closed(context) == ("left", "right")
    assert abs(hits[-1].rest_time - limit) < 1e-8


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


def test_what_dips_below_the_floor_within_a_step_is_pierced():
    """The gap p(t) = (t - a)(t - b)(t + 1) at both ends of a step from 0 to 1, with its rates.

    It is pierced where 0 < a < b < 1; not where it but comes near, nor where it leaves from 0.
    """

    def margin(a, b):
        gap = np.poly1d([a, b, -1.0], r=True)
        rate = gap.deriv()
        log = RunLog(time=0.0, gaps=np.array([gap(0.0)]), rates=np.array([rate(0.0)]))
        return clearance(log, 1.0, np.array([gap(1.0)]), np.array([rate(1.0)])).item()

    lowest = np.poly1d([0.3, 0.6, -1.0], r=True)
    assert margin(0.3, 0.6) == pytest.approx(min(map(lowest, lowest.deriv().roots)), rel=1e-12)
    assert margin(0.3 + 0.1j, 0.3 - 0.1j) > 0.0
    log = RunLog(time=0.0, gaps=np.array([-1e-10]), rates=np.array([0.1]))
    assert clearance(log, 1e-9, np.array([-5e-11]), np.array([0.1])).item() > 0.0
    # What was above is pierced below even where it rises, and what left is where it falls back.
    assert clearance(log, 0.1, np.array([-1e-3]), np.array([0.1])).item() == -1e-3
    assert clearance(log, 0.1, np.array([-5e-11]), np.array([-0.1])).item() < 0.0


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
