"""Closed loops whose contacts open and close: what the law does then, and what a record has."""

import csv
from dataclasses import replace
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from arms import arm, error_controlled, law, numbers
from numpy.testing import assert_allclose, assert_array_equal
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
from recordings import animation
from runs import run_scenario, scenario
from scipy.optimize import brentq

from drake_dae import (
    ConstantReference,
    LinkExpressions,
    LoopSettings,
    Plane,
    PointCoordinates,
    PointOnSurface,
    Record,
    RobotModel,
    RobotPlant,
    Sampling,
    SinusoidReference,
    TrackingLaw,
    UnilateralRobotPlant,
    build_scenario,
    make_animation,
    make_closed_loop,
    poles,
    simulate,
)
from drake_dae.errors import ModelError, ScenarioError
from drake_dae.pictures.moments import events_of
from drake_dae.pictures.plots import plot_controls, plot_outputs
from drake_dae.scenario.feasibility.feasibility import find_feasibility
from drake_dae.simulation.open_contacts import contact_notes, open_spans
from drake_dae.simulation.records.events import flashes
from drake_dae.simulation.summary import Limits, summary
from drake_dae.systems.plants.contact_events import ContactChange

MASS, BOUNCE = 2.0, 0.2
PUSH, SWING, RATE = 6.0, 8.0, 2.0
"""The wanted force, PUSH + SWING sin(RATE t), pulls for a while."""


@pytest.fixture(scope="module")
def slider():
    """A mass in the plane, driven along x and z, at a wall x = 0 from the side x < 0."""
    q, v = ca.SX.sym("q", 2), ca.SX.sym("v", 2)
    links = LinkExpressions(
        q,
        v,
        MASS * ca.SX.eye(2),
        ca.SX(2, 1),
        {"tool": ca.vertcat(q[0], 0, q[1])},
        actuation_matrix=np.eye(2),
    )
    wall = PointOnSurface("tool", Plane((0, 0, 0), (-1, 0, 0)), name="wall")
    return RobotModel(links, [wall], [PointCoordinates("tool", axes="z")])


@pytest.fixture(scope="module")
def run(slider):
    """Its loop, run under error control, with every event as it was known after each step."""
    tracking = TrackingLaw(slider.dae, poles(-5.0))
    plant = UnilateralRobotPlant(slider, {"wall": BOUNCE}, structure=tracking.structure)
    references = [SinusoidReference(0.2, 0.1, 3.0), SinusoidReference(PUSH, SWING, RATE)]
    loop = make_closed_loop(plant, tracking, references)
    context = loop.diagram.CreateDefaultContext()
    own = plant.GetMyMutableContextFromRoot(context)
    plant.set_consistent_state(own, [0.1, 0.25, 0.0, 0.0])
    simulator = Simulator(loop.diagram, context)
    ResetIntegratorFromFlags(simulator, "runge_kutta5", 0.4)
    integrator = simulator.get_mutable_integrator()
    integrator.set_target_accuracy(1e-8)
    integrator.request_initial_step_size_target(0.4)
    context.SetAccuracy(1e-10)
    known = []
    simulator.set_monitor(lambda root: known.append((root.get_time(), plant.events(own))))
    simulator.AdvanceTo(3.8)
    simulator.AdvancePendingEvents()
    record = loop.record(context)
    return loop, context, record, loop.predicted_error(record), known, integrator


def by_hand():
    """When the mass leaves, and each time and speed at which it strikes, until it rests.

    phi'' = -lambda_d / m, lambda_d = a + b sin(w t): from rest at t_0 where lambda_d = 0.
    """
    leaves = (np.pi + np.arcsin(PUSH / SWING)) / RATE
    begin, speed, hits = leaves, 0.0, []

    def rate(t):
        swung = SWING * (np.cos(RATE * t) - np.cos(RATE * begin)) / RATE
        return speed - (PUSH * (t - begin) - swung) / MASS

    def gap(t):
        s = t - begin
        swung = np.sin(RATE * t) - np.sin(RATE * begin) - RATE * s * np.cos(RATE * begin)
        return speed * s - (PUSH * s**2 / 2.0 - SWING * swung / RATE**2) / MASS

    while len(hits) < 4:
        # It flies to its highest point, and falls as long again or longer.
        top = brentq(rate, begin + 1e-9 + (0.6 if not hits else 0.0), begin + 2.0, xtol=1e-15)
        hit = brentq(gap, top, top + 2.0, xtol=1e-15)
        struck = -rate(hit)
        hits.append((hit, struck))
        begin, speed = hit, BOUNCE * struck
    return leaves, hits


@pytest.mark.slow
def test_an_open_contact_is_to_the_law_a_wanted_force_that_is_not_there(run):
    """Event times within windows of 1e-12 s that add up, and errors of steps of 1e-8."""
    _, _, record, predicted, *_ = run
    leaves, hits = by_hand()
    first, *others = record.events
    assert first.kind is ContactChange.OPENING
    assert abs(first.time - leaves) < 1e-9
    assert_allclose([event.time for event in others[:4]], [t for t, _ in hits], atol=1e-8)
    impulses = [(1.0 + BOUNCE) * MASS * speed for _, speed in hits]
    assert_allclose([e.impulses[0] for e in others[:4]], impulses, rtol=1e-7)
    lost = [0.5 * MASS * (1.0 - BOUNCE**2) * speed**2 for _, speed in hits]
    assert_allclose([e.energy_lost for e in others[:4]], lost, rtol=1e-7)
    assert others[-1].kind is ContactChange.REST
    assert others[-1].closed == ("wall",)
    # The wall pushes across what is steered along it.
    off = record["tracking_error"] - predicted
    assert np.abs(off[:, 0]).max() < 1e-8
    # And the force is as wanted while it is closed.
    closed = record["mode"][:, 0] == 1.0
    assert_allclose(off[closed, 1], 0.0, atol=1e-8)


def test_an_arm_whose_contact_is_open_falls_back_by_the_wanted_force():
    """M (v'_closed - v'_open) = J^T lambda_d at any state, so that phi'' = -A lambda_d.

    J' v is what the model has for its contact, which demands phi'' = 0 off N* as well.
    """
    found, random = arm("two_link"), np.random.default_rng(3)
    plant, tracking = UnilateralRobotPlant(found.model, {"wall": 0.0}), law("two_link")
    context = plant.CreateDefaultContext()
    for wanted in (25.0, -4.0):
        q = found.model.dae.nominal_state[:2] + 0.2 * random.standard_normal(2)
        v = random.standard_normal(2)
        u = tracking.control(np.concatenate([q, v]), [0.3, 0.1, -0.2, wanted])
        plant.set_state(context, np.concatenate([q, v]))
        plant.GetInputPort("control").FixValue(context, u)
        rate = plant.EvalTimeDerivatives(context).CopyToVector()[2:]
        known = numbers("two_link", q, v)
        J = known.constraint_jacobian
        A = (J @ np.linalg.solve(known.mass, J.T)).item()
        gap_rate = (J @ rate + known.constraint_acceleration).item()
        assert gap_rate == pytest.approx(-A * wanted, rel=1e-9)


def test_steps_that_are_refused_leave_no_event(run):
    """Steps of 0.4 s leap over whole flights; known events only grow, and at their times."""
    *_, known, integrator = run
    assert integrator.get_num_step_shrinkages_from_error_control() > 0
    for (_, before), (now, after) in pairwise(known):
        assert after[: len(before)] == before
        assert all(event.time <= now for event in after)
    times = [event.time for event in known[-1][1]]
    assert times == sorted(set(times))


def test_a_record_has_modes_gaps_and_forces_that_are_complementary(run):
    loop, _, record, *_ = run
    mode, gap, force = record["mode"], record["gap"], record["constraint_force"]
    assert [signal.name for signal in record.signals["gap"].signals] == ["wall.gap"]
    assert set(np.unique(mode)) == {0.0, 1.0}
    assert np.all(force >= 0.0)
    assert np.all(force[mode == 0.0] == 0.0)
    # A step of fixed accuracy leaves its constraint by that, and ends within a window.
    assert gap.min() > -1e-9
    assert np.abs(gap[mode == 1.0]).max() < 1e-9
    assert np.all(record["constraint_residual"][mode[:, 0] == 0.0] == 0.0)
    assert_allclose(gap[:, 0], -record["state"][:, 0], atol=1e-15)
    assert_allclose(
        record["controlled_output"][mode[:, 0] == 1.0, 1], force[mode == 1.0], atol=1e-9
    )
    assert not [name for name in loop.logged if name not in ("state", "mode")]


def test_events_are_kept_on_disk_and_as_rows(run, tmp_path):
    _, _, record, *_ = run
    record.save(tmp_path / "record.npz")
    again = Record.load(tmp_path / "record.npz")
    assert again.events == record.events
    assert_array_equal(again["mode"], record["mode"])
    with np.load(tmp_path / "record.npz") as file:
        assert_allclose(file["events.time"], [event.time for event in record.events], rtol=0)
        assert list(file["events.contacts"]) == ["wall"]
        assert file["events.impulses"].shape == (len(record.events), 1)
    rows = record.event_rows()
    with open(tmp_path / "events.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    with open(tmp_path / "events.csv", newline="") as file:
        (first, second, *_) = csv.DictReader(file)
    assert (first["event"], first["contacts"], first["closed"]) == ("opens", "wall", "")
    assert float(second["impulse [N s]"]) == record.events[1].impulses[0]
    half = record.time.size // 2
    broken = {name: replace(r, values=r.values.copy()) for name, r in record.signals.items()}
    broken["state"].values[half:] = np.nan
    cut = Record(record.time, broken, record.events).while_finite()
    assert cut.events == tuple(e for e in record.events if e.time <= record.time[half - 1])


def test_a_loop_records_the_events_of_a_time(run):
    loop, context, record, *_ = run
    later = loop.record(context, after=record.events[1].time)
    assert later.events == record.events[2:]
    assert f"{len(later.events)} events" in repr(later)


def test_a_summary_reports_impacts_and_open_contacts(run):
    _, _, record, predicted, *_ = run
    hits = [event for event in record.events if any(event.impulses)]
    text = summary(record, predicted, Limits(pushing=frozenset({"wall.force"})))
    assert f"contacts             {len(hits)} impacts, the first at {hits[0].time:.4g} s, " in text
    lost = sum(event.energy_lost for event in hits)
    assert f"{lost:.3g} J lost" in text
    flight = hits[-1].time - record.events[0].time
    assert f"\nwall                 open for {flight:.4g} s, first from " in text
    assert "pull" not in text
    assert open_spans(record) == [(record.events[0].time, hits[-1].time)]
    still = part_of(record, slice(0, 5))
    assert contact_notes(still) == [("contacts", "no impacts"), ("wall", "always closed")]


def part_of(record, rows):
    signals = {n: replace(r, values=r.values[rows]) for n, r in record.signals.items()}
    return Record(record.time[rows], signals)


def test_pictures_mark_open_contacts_and_impacts(run):
    loop, context, record, predicted, *_ = run
    hits = [event.time for event in record.events if any(event.impulses)]
    events = events_of(record)
    figures = plot_outputs(record, predicted, events), plot_controls(record, events=events)
    for figure in figures:
        for axis in figure.axes:
            marks = [line for line in axis.lines if line.get_linewidth() == 0.8]
            assert [line.get_xdata()[0] for line in marks] == hits
        (legend,) = figure.legends
        assert {text.get_text() for text in legend.get_texts()} >= {"contact open", "impact"}
    times = np.linspace(0.0, 3.8, 381)
    (bright,) = flashes(record.events, ["wall"], times).T
    assert np.all(bright[times < hits[0]] == 0.0)
    # The first is the hardest, and is seen within a hundredth of a second.
    assert bright.max() > 0.95
    # Around the first impact alone: each frame takes its time.
    near = np.flatnonzero(np.abs(record.time - hits[0] - 0.05) < 0.2)
    short = replace(part_of(record, slice(near[0], near[-1])), events=record.events)
    tracks = animation(make_animation(loop, short, context))
    (scale,) = (t.values for (path, _), t in tracks.items() if path.endswith("impact/ball"))
    assert np.max(scale) > 0.9
    assert np.min(scale) <= 1e-3


def test_where_nothing_opens_a_loop_goes_as_with_an_ideal_plant(slider):
    tracking = TrackingLaw(slider.dae, poles(-5.0))
    references = [SinusoidReference(0.2, 0.1, 3.0), ConstantReference(5.0)]
    records = []
    for plant in (
        UnilateralRobotPlant(slider, {"wall": BOUNCE}, structure=tracking.structure),
        RobotPlant(slider, structure=tracking.structure),
    ):
        loop = make_closed_loop(plant, tracking, references)
        context = loop.diagram.CreateDefaultContext()
        own = plant.GetMyMutableContextFromRoot(context)
        plant.set_consistent_state(own, [0.0, 0.25, 0.0, 0.0])
        simulate(loop.diagram, context, 0.5, error_controlled(1e-8))
        records.append(loop.record(context))
    hybrid, ideal = records
    assert hybrid.events == ideal.events == ()
    assert_allclose(hybrid["state"][-1], ideal["state"][-1], atol=1e-9)
    assert_allclose(hybrid["constraint_force"][-1], ideal["constraint_force"][-1], atol=1e-9)


def test_a_sampled_law_begins_in_contact_and_leaves_at_its_first_sample_that_pulls(slider):
    """The mass rests across the wall, so that the force is what is wanted, held; to 1e-11 s."""
    tracking, period = TrackingLaw(slider.dae, poles(-5.0)), 0.03
    plant = UnilateralRobotPlant(slider, {"wall": BOUNCE}, structure=tracking.structure)
    references = [ConstantReference(0.2), SinusoidReference(PUSH, SWING, RATE)]
    loop = make_closed_loop(plant, tracking, references, LoopSettings(sampling=Sampling(period)))
    context = loop.diagram.CreateDefaultContext()
    plant.set_consistent_state(plant.GetMyMutableContextFromRoot(context), [0.0, 0.2, 0.0, 0.0])
    simulate(loop.diagram, context, 2.2, error_controlled(1e-9))
    record = loop.record(context)
    leaves = period * np.ceil(by_hand()[0] / period)
    assert record.events[0].kind is ContactChange.OPENING
    assert record.events[0].time == pytest.approx(leaves, abs=2e-11)
    before = record.time < leaves
    assert_array_equal(record["mode"][before], 1.0)
    # A row at a sample is of what was held before.
    held = period * np.maximum(np.ceil(record.time[before] / period - 1e-9) - 1.0, 0.0)
    assert_allclose(
        record["constraint_force"][before, 0], PUSH + SWING * np.sin(RATE * held), atol=1e-9
    )


@pytest.mark.slow
def test_a_control_that_pulls_for_a_part_of_a_step_opens_a_contact():
    """Held from 2.086 s on it pulls for 0.2 ms: steps of a sample see that as ten in each do."""
    settings = ["wall_bounce", "sampling={period: 0.001}", "integrator.start_time=2.0"]
    found = []
    for step in (1e-3, 1e-4):
        chosen = scenario(*settings, "duration=0.1", f"integrator.max_step_size={step}")
        found.append(run_scenario(chosen)[2].events)
    assert [event.kind for event in found[0]] == [event.kind for event in found[1]]
    times = [[event.time for event in events] for events in found]
    assert_allclose(times[0], times[1], atol=1e-8)
    assert times[0][0] == pytest.approx(2.086, abs=1e-9)


@pytest.mark.parametrize("limits", [None, [100.0, 100.0]])
def test_the_integral_of_a_force_stands_still_while_its_contact_is_open(slider, limits):
    tracking = TrackingLaw(
        slider.dae, poles(-5.0), measured_force=True, integral=["tool.z", "wall.force"]
    )
    plant = UnilateralRobotPlant(slider, {"wall": 0.0}, structure=tracking.structure)
    references = [ConstantReference(0.2), SinusoidReference(0.0, -6.0, 4.0, -0.4)]
    loop = make_closed_loop(plant, tracking, references, LoopSettings(control_limits=limits))
    context = loop.diagram.CreateDefaultContext()
    plant.set_consistent_state(plant.GetMyMutableContextFromRoot(context), [0.0, 0.25, 0.0, 0.0])
    controller = loop.controller
    own = controller.GetMyMutableContextFromRoot(context)
    controller.set_integral(own, [0.0, 0.1])
    simulate(loop.diagram, context, 0.4, error_controlled(1e-6))
    record = loop.record(context)
    away = record["mode"][:, 0] == 0.0
    assert 5 < away.sum() < away.size - 2
    # It changes while it is closed, and that of the height all the time.
    assert np.ptp(record["integral"][away, 1]) == 0.0
    assert record["integral"][~away, 1].min() < 0.1
    assert np.all(np.diff(record["integral"][:, 0]) != 0.0)


# In scenarios.


@pytest.mark.slow
def test_the_shipped_arm_leaves_its_wall_and_strikes_it():
    """The wanted force 12 + 14 sin 2t pulls from (pi + arcsin(6/7)) / 2 on."""
    chosen = scenario("wall_bounce", "duration=3.2")
    _, _, record = run_scenario(chosen)
    leaves, *others = record.events
    assert leaves.kind is ContactChange.OPENING
    assert abs(leaves.time - (np.pi + np.arcsin(6.0 / 7.0)) / 2.0) < 1e-9
    assert [event.kind for event in others] == [ContactChange.IMPACT]
    assert record["gap"].max() > 0.05
    assert record["mode"][-1] == 0.0
    # A law that knows its robot finds nothing but that it shall pull.
    (problem,) = find_feasibility(scenario("wall_bounce")).problems
    assert "pulls from 2.08" in problem


def test_a_scenario_changes_its_restitution_by_a_parameter():
    chosen = scenario("wall_bounce", "plant_parameters={wall.restitution: 0.25}")
    loop, context = build_scenario(chosen)
    own = loop.plant.GetMyContextFromRoot(context)
    assert_array_equal(loop.plant.get_parameter(own, "wall.restitution"), [0.25])
    with pytest.raises(ModelError, match="1 entry"):
        loop.plant.set_parameter(own, "wall.restitution", [0.5, 0.5])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ("plant=!Unilateral {restitution: {floor: 0.5}}", "plant.*no constraint 'floor'"),
        ("plant=!Unilateral {restitution: {wall: 1.5}}", r"restitution\.wall must be between 0"),
        ("plant=!Unilateral {settling_time: 0}", "settling_time must be positive"),
        ("plant_parameters={wall.restitution: -0.5}", "between 0, no bounce, and 1"),
    ],
)
def test_wrong_words_are_refused(settings, message):
    with pytest.raises(ScenarioError, match=message):
        build_scenario(scenario("wall_bounce", settings))


def test_a_robot_that_nothing_pushes_has_no_contact_to_open():
    with pytest.raises(ScenarioError, match="no unilateral constraint"):
        build_scenario(scenario("slider_crank", "plant=!Unilateral {}"))


@pytest.mark.slow
def test_a_run_that_goes_on_keeps_the_events_of_the_first_part():
    """Impacts of 3.3 s in one run and in two."""
    chosen = scenario("wall_bounce", "duration=3.3")
    whole, context = build_scenario(chosen)
    simulate(whole.diagram, context, 3.3, chosen.integrator)
    wanted = whole.record(context).events
    assert len(wanted) >= 2
    loop, parts = build_scenario(chosen)
    simulate(loop.diagram, parts, 2.6, chosen.integrator)
    first = loop.record(parts).events
    chosen.integrator.start_time = parts.get_time()
    simulate(loop.diagram, parts, 0.7, chosen.integrator)
    both = loop.record(parts).events
    assert 0 < len(first) < len(both)
    assert both[: len(first)] == first
    assert [event.kind for event in both] == [event.kind for event in wanted]
    # Impact times are found to the accuracy of the steps, which are others.
    found, times = ([event.time for event in events] for events in (both, wanted))
    assert_allclose(found, times, atol=1e-5)
