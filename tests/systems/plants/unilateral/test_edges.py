"""Contacts that end where their surface does: edges and holes of plates, against closed forms."""

import numpy as np
import pytest
from falling import GRAVITY, HALF, HEIGHT, INERTIA, MASS, box, mass_point, simulator_of
from numpy.testing import assert_allclose
from pydrake.math import RollPitchYaw
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
from pydrake.systems.framework import DiagramBuilder
from runs import in_equal_steps

from drake_dae import ConstantReference, Hole, Plate, ReferenceGenerator, SinusoidReference
from drake_dae.errors import InconsistentStateError
from drake_dae.systems.plants.contact_events import ContactChange

PLATE = Plate((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.3, 0.2), thickness=0.05)
AFTER = Plate((0.7, 0.0, 0.0), (0.0, 0.0, 1.0), (0.4, 0.2), thickness=0.05)
WITH_HOLE = Plate(
    (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.3, 0.2), thickness=0.05, hole=Hole(0.02, (0.1, 0.05), 0.01)
)
SLOPE, SIDES = 0.2, (0.3, 0.2)

EXACT = 1e-10
"""Steps are exact along a parabola, and events are found to within 1e-11 s."""


@pytest.fixture(scope="module")
def point():
    return mass_point({"floor": PLATE}, 0.5)


@pytest.fixture(scope="module")
def over_hole():
    return mass_point({"floor": WITH_HOLE}, 0.5)


def run(plant, state, duration, step=0.01):
    simulator, context = simulator_of(plant, state, step, accuracy=1e-9)
    simulator.AdvanceTo(duration)
    return plant.state(context), plant.events(context), context


def test_a_point_leaves_the_edge_when_the_closed_form_says_and_falls_freely(point):
    """It slides at a speed v over a distance s: it leaves at s / v, then falls by g t^2 / 2."""
    state, (event,), context = run(point, [0.0, 0.05, 0.0, 0.7, -0.1, 0.0], 1.0)
    assert event.kind is ContactChange.OPENING
    assert event.closed == ()
    assert_allclose(event.time, 0.3 / 0.7, rtol=0.0, atol=EXACT)
    fall = 1.0 - 0.3 / 0.7
    wanted = [0.7, -0.05, -0.5 * GRAVITY * fall**2, 0.7, -0.1, -GRAVITY * fall]
    assert_allclose(state, wanted, rtol=0.0, atol=EXACT)
    kinetic, height = 0.5 * MASS * state[3:] @ state[3:], MASS * GRAVITY * state[2]
    assert_allclose(kinetic + height, 0.5 * MASS * 0.5, rtol=1e-9)
    for port in ("mode", "constraint_force"):
        assert point.GetOutputPort(port).Eval(context) == [0.0]


def test_the_force_is_that_of_the_plane_until_the_edge(point):
    simulator, context = simulator_of(point, [0.0, 0.0, 0.0, 0.7, 0.0, 0.0], accuracy=1e-9)
    simulator.AdvanceTo(0.3 / 0.7 - 1e-9)
    force = point.GetOutputPort("constraint_force").Eval(context)
    assert_allclose(force, [MASS * GRAVITY], rtol=1e-14)


def test_down_a_slope_a_point_leaves_by_its_lower_edge():
    """From rest the distance is g sin(a) t^2 / 2, in the axes of a plate that is turned."""
    plant = mass_point({"floor": PLATE}, rpy=(0.0, SLOPE, 0.0))
    along = np.array([np.cos(SLOPE), 0.0, -np.sin(SLOPE)])
    state, (event,), _ = run(plant, np.zeros(6), 1.0)
    leaves = np.sqrt(2.0 * 0.3 / (GRAVITY * np.sin(SLOPE)))
    assert_allclose(event.time, leaves, rtol=0.0, atol=EXACT)
    speed, fall = GRAVITY * np.sin(SLOPE) * leaves, 1.0 - leaves
    wanted = 0.3 * along + fall * speed * along - [0.0, 0.0, 0.5 * GRAVITY * fall**2]
    assert_allclose(state[:3], wanted, rtol=0.0, atol=EXACT)


@pytest.mark.parametrize(
    ("start", "speed", "hits"),
    [
        (0.2, 0.4, True),
        (0.2, 0.5, False),
        (-0.5, 0.82, True),
        (-0.5, 0.8, False),
        (0.4, 0.0, False),
    ],
)
def test_a_point_that_falls_meets_the_face_and_not_its_plane(point, start, speed, hits):
    """From 0.3 m it needs sqrt(2 h / g) = 0.2473 s, and is then on the face, or beside it."""
    fall = np.sqrt(2.0 * 0.3 / GRAVITY)
    assert bool(abs(start + fall * speed) < 0.3) is hits
    _, events, _ = run(point, [start, 0.0, 0.3, speed, 0.0, 0.0], 0.3)
    if not hits:
        assert events == ()
        return
    (event,) = events
    assert event.kind is ContactChange.IMPACT
    assert_allclose(event.time, fall, rtol=0.0, atol=EXACT)
    assert_allclose(event.impulses, [1.5 * MASS * GRAVITY * fall], rtol=1e-9)


def test_a_point_beside_the_plate_stays_free_below_its_face(point):
    """Beside it is below the face; it comes under the plate, whose sides are no contact."""
    start = [-0.4, 0.0, -0.01, 0.5, 0.0, 0.0]
    state, events, context = run(point, start, 0.5)
    assert events == ()
    assert point.closed(context) == ()
    assert_allclose(state[2], -0.01 - 0.5 * GRAVITY * 0.5**2, rtol=0.0, atol=EXACT)


def test_a_point_that_comes_up_through_the_face_lands_on_it(point):
    """From under the plate, which is open there; on the way down it hits the face."""
    rise = 3.0
    state, (event, *_), _ = run(point, [0.0, 0.0, -0.1, 0.0, 0.0, rise], 0.7)
    down = (rise + np.sqrt(rise**2 - 2.0 * GRAVITY * 0.1)) / GRAVITY
    assert event.kind is ContactChange.IMPACT
    assert_allclose(event.time, down, rtol=0.0, atol=EXACT)
    assert state[2] > 0.0


@pytest.mark.parametrize("depth", [0.001, 0.02, 0.049])
def test_a_start_inside_the_plate_is_refused(point, depth):
    with pytest.raises(InconsistentStateError, match="inside the surface of 'floor'"):
        simulator_of(point, [0.1, 0.0, -depth, 0.0, 0.0, 0.0])


def test_from_plate_to_plate_a_point_slides_as_on_one():
    """At their seam one opens and the other closes at once, without a loss of energy."""
    plant = mass_point({"first": PLATE, "second": AFTER})
    state, events, context = run(plant, [0.0, 0.0, 0.0, 0.7, 0.0, 0.0], 1.0)
    assert [event.closed for event in events] == [("second",)] * len(events)
    assert {event.time for event in events} == {events[0].time}
    assert_allclose(events[0].time, 0.3 / 0.7, rtol=0.0, atol=EXACT)
    assert_allclose(state, [0.7, 0.0, 0.0, 0.7, 0.0, 0.0], rtol=0.0, atol=EXACT)
    assert plant.closed(context) == ("second",)


@pytest.mark.parametrize("step", [0.01, 0.2])
def test_over_a_hole_a_contact_opens_also_within_a_step(over_hole, step):
    """The point crosses the chamfered rim, of 0.03 m, beside its middle, and falls into the hole.

    Its chord is 48 mm, and a step of 0.2 s at 0.5 m/s passes it: there the opening is found to
    within the error of a cubic, which is exact for a distance that is quadratic in time.
    """
    offset = 0.018
    chord = np.sqrt(0.03**2 - offset**2)
    state, (event,), _ = run(over_hole, [0.0, 0.05 + offset, 0.0, 0.5, 0.0, 0.0], 0.25, step)
    assert_allclose(event.time, (0.1 - chord) / 0.5, rtol=0.0, atol=EXACT)
    assert_allclose(state[2], -0.5 * GRAVITY * (0.25 - event.time) ** 2, rtol=0.0, atol=EXACT)
    _, events, _ = run(over_hole, [0.0, 0.05 + 0.0301, 0.0, 0.5, 0.0, 0.0], 0.25, step)
    assert events == ()


@pytest.mark.slow
@pytest.mark.parametrize("ahead", [-0.0021, -0.0019, 0.0019, 0.0021])
def test_a_narrow_plate_is_met_within_a_step(ahead):
    """A step of 0.25 s passes both edges and the face; where the face is passed decides."""
    beam = Plate((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.002, 0.2), thickness=0.05)
    start = [ahead - 0.1, 0.0, 0.5 * GRAVITY * 0.1**2, 1.0, 0.0, 0.0]
    _, events, _ = run(mass_point({"beam": beam}, 1.0), start, 0.25, step=0.25)
    if abs(ahead) > 0.002:
        assert events == ()
        return
    (event,) = events
    assert_allclose(event.time, 0.1, rtol=0.0, atol=EXACT)


def test_a_box_whose_foot_is_over_the_edge_turns_about_the_other():
    """Its weight is on one foot: force = m g / (1 + m b^2 / I), as the foot does not accelerate."""
    plant = box({"left": 0.0, "right": 0.0}, driven=False, floor=PLATE)
    simulator, context = simulator_of(plant, [0.0, HEIGHT, 0.0, 0.5, 0.0, 0.0], accuracy=1e-9)
    simulator.AdvanceTo((0.3 - HALF) / 0.5 + 1e-9)
    (event,) = plant.events(context)
    assert event.contacts == ("right",)
    assert_allclose(event.time, (0.3 - HALF) / 0.5, rtol=0.0, atol=EXACT)
    force = plant.GetOutputPort("constraint_force").Eval(context)
    # Within 1e-9 s the angle is 1e-17 rad.
    wanted = MASS * GRAVITY / (1.0 + MASS * HALF**2 / INERTIA)
    assert_allclose(force, [wanted, 0.0], rtol=1e-9)
    simulator.AdvanceTo(0.5)
    state = plant.state(context)
    kinetic = 0.5 * MASS * state[3:5] @ state[3:5] + 0.5 * INERTIA * state[5] ** 2
    energy = kinetic + MASS * GRAVITY * state[1]
    # Steps of fifth order: 2e-11, and 30 times less with steps of half the length.
    assert_allclose(energy, 0.5 * MASS * 0.25 + MASS * GRAVITY * HEIGHT, rtol=1e-9)
    assert plant.events(context) == (event,)


def bounces(start, speed, turned, restitution, duration):
    """The times of impacts on a turned plate with a hole, and the last state, in closed form.

    In the axes of the plate all coordinates are parabolas; after a miss the point is free.
    """
    pull = turned.T @ [0.0, 0.0, -GRAVITY]
    x, v, now, times = turned.T @ start, turned.T @ speed, 0.0, []
    while True:
        roots = np.roots([0.5 * pull[2], v[2], x[2]])
        fall = min((root for root in roots.real if root > 1e-9), default=np.inf)
        left = duration - now
        feet = x + v * fall + 0.5 * pull * fall**2 if fall < left else x + np.inf
        hits = np.hypot(feet[0] - 0.1, feet[1] - 0.05) > 0.03 and (np.abs(feet[:2]) < SIDES).all()
        if not hits:
            ended = x + v * left + 0.5 * pull * left**2, v + pull * left
            return times, np.concatenate([turned @ part for part in ended])
        x, v, now = np.append(feet[:2], 0.0), v + pull * fall, now + fall
        v[2] *= -restitution
        times.append(now)


@pytest.mark.slow
@pytest.mark.parametrize("step", [0.3, pytest.param(0.02, marks=pytest.mark.thorough)])
def test_thrown_points_bounce_off_the_face_alone(step):
    """Six throws at a turned plate with a hole, also with steps that pass edges, rim and face."""
    angles, counts = (0.2, -0.15, 0.3), []
    plant = mass_point({"floor": WITH_HOLE}, rpy=angles)
    turned = RollPitchYaw(*angles).ToRotationMatrix().matrix()
    for seed in range(6):
        random = np.random.default_rng(seed)
        start = turned @ random.uniform([-0.35, -0.25, 0.01], [0.35, 0.25, 0.1])
        speed, restitution = random.uniform(-1.0, 1.0, 3), random.uniform(0.7, 1.0)
        times, end = bounces(start, speed, turned, restitution, 0.6)
        simulator = Simulator(plant)
        ResetIntegratorFromFlags(simulator, "runge_kutta2", step)
        simulator.get_mutable_integrator().set_fixed_step_mode(True)
        context = simulator.get_mutable_context()
        plant.set_state(context, np.concatenate([start, speed]))
        plant.set_parameter(context, "floor.restitution", restitution)
        context.SetAccuracy(1e-10)
        simulator.AdvanceTo(0.6)
        # Windows of 3e-13 s and their sums; a speed of round-off decides on no bounce here.
        found = [event.time for event in plant.events(context)]
        assert_allclose(found, times, rtol=0.0, atol=EXACT)
        assert_allclose(plant.state(context), end, rtol=0.0, atol=10.0 * EXACT)
        counts.append(len(times))
    assert min(counts) == 0
    assert max(counts) > 1


def test_from_under_a_point_at_rest_a_plate_is_drawn_away():
    """Its edge is at x = 0.3 - 0.1 sin(5 t), and the point, without friction, at 0.25."""
    plant = mass_point({"floor": PLATE}, exogenous=["floor.position"])
    builder = DiagramBuilder()
    builder.AddSystem(plant)
    moved = [SinusoidReference(0.0, -0.1, 5.0), ConstantReference([0.0, 0.0])]
    moving = ReferenceGenerator(moved, plant.exogenous_layout.degrees)
    table = builder.AddSystem(moving)
    builder.Connect(table.get_output_port(), plant.GetInputPort("exogenous"))
    simulator, root, context = in_equal_steps(builder, plant, "runge_kutta5", 0.01)
    plant.set_state(context, [0.25, 0.0, 0.0, 0.0, 0.0, 0.0])
    root.SetAccuracy(1e-9)
    simulator.AdvanceTo(0.3)
    (event,) = plant.events(context)
    assert_allclose(event.time, np.arcsin(0.5) / 5.0, rtol=0.0, atol=EXACT)
    fall = 0.3 - event.time
    assert_allclose(plant.state(context)[2], -0.5 * GRAVITY * fall**2, rtol=0.0, atol=EXACT)


def test_the_graph_of_a_contact_that_ends_has_its_edge(point):
    assert point.graph.ending == ("floor",)
    assert "{floor} -> {} when floor leaves its face" in str(point.graph).splitlines()
    assert "when phi(floor) falls to 0 on its face:" in str(point.graph)
