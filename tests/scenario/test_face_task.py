"""A task whose contact is a face: its forces and moments, its center of pressure, and its edge."""

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose
from runs import scenario, some

from drake_dae import (
    TrackingLaw,
    build_scenario,
    find_structure,
    load_scenario,
    open_contact,
    poles,
    simulate,
)
from drake_dae.errors import GainError, ModelError, ScenarioError
from drake_dae.scenario.feasibility.feasibility import find_feasibility
from drake_dae.scenario.model import scenario_model
from drake_dae.scenario.rolled import roll_scenario

HALF = 0.03
"""Half of the distance of both points, in m."""

EDGE = """
robot: {file: package://drake_dae_models/two_link_arm.urdf}
constraints:
- name: upper
  frame: tool
  point: [0.03, 0, 0]
  surface: &wall {point: [1.2, 0, 0], normal: [-1, 0, 0]}
- {name: lower, frame: tool, point: [-0.03, 0, 0], surface: *wall}
forces:
- !FaceForces {frame: tool, points: [upper, lower], axes: y}
gains: {all: [-25]}
constraint_damping: {all: [-30]}
task:
  contact: [upper, lower]
  gains: {all: [-8]}
  phases:
  - !Press {force: 20, over: 0.1}
  - !Move {references: {face.force: 24.0, face.my: 0.2}, duration: 0.3, over: 0.2}
  - !Release {over: 0.2}
  - !Retreat {distance: 0.01, over: 0.3}
start: {positions: {joint1: 1.3694, joint2: -1.3694}}
duration: 1.0
"""
TOUCHES = [
    "plant=!CompliantContact {time_step: 0.001, radius: 1.0e-5}",
    "sampling={period: 0.001, delay: 0.001}",
    "start.positions={joint1: 1.375, joint2: -1.375}",
    "task.phases=[!Approach {speed: 0.03, over: 0.1}, !Press {force: 20, over: 0.1}]",
]


TILTED = [
    "constraints.0.rpy=[0, 0, 0]",
    "constraints.1.rpy=[0, 0, 0]",
    "plant_parameters={upper.rpy: [0, 0.0087, 0], lower.rpy: [0, 0.0087, 0]}",
    "force_feedback=!MeasuredForce {sample_period: 0.001}",
    "integral=[face.force, face.my]",
    "gains=!Poles {all: [-2]}",
]


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "edge.yaml"
    path.write_text(EDGE)
    return path


def rolled(file, *settings):
    """The record of a rollout, and the starts of its phases."""
    loop, context = build_scenario(chosen := load_scenario(file, settings))
    found = roll_scenario(chosen, loop, context)
    return found.record, loop.changes(found.context)


def in_phase(record, place):
    return np.flatnonzero(np.argmax(record["phase"], axis=1) == place)


@pytest.mark.slow
def test_points_carry_what_force_and_moment_imply_and_leave_together(file):
    """F = a + b and M_y = 0.03 (a - b), to round-off; then both distances are 10 mm."""
    record, changes = rolled(file)
    assert changes[-1].phase == "done"
    last = in_phase(record, 1)[-1]
    F, M = record["desired_output"][last, :2]
    assert_allclose([F, M], [24.0, 0.2], atol=0.01)  # The sample before the end of 0.3 s.
    assert_allclose(record["constraint_force"][last], [F / 2 + M / 0.06, F / 2 - M / 0.06])
    upper, lower = record["constraint_force"][in_phase(record, 1)].T
    cop = HALF * (upper - lower) / (upper + lower)
    wanted = record["desired_output"][in_phase(record, 1)]
    assert_allclose(cop, wanted[:, 1] / wanted[:, 0], atol=1e-9)
    names = [signal.name for signal in record.signals["desired_output"].signals]
    assert names == ["face.force", "face.my", "upper.distance", "lower.distance"]
    # Force and moment of a Release go to zero together: the center of pressure does not move.
    release = record["controlled_output"][in_phase(record, 2)[1:]]
    assert release[-1, 0] < 1.0
    assert_allclose(release[:, 1] / release[:, 0], 0.2 / 24.0, atol=1e-3)
    assert_allclose(record["distance"][-1], [0.01, 0.01, 0.0, 0.0], atol=1e-9)
    # Where it is open the forces are zero, and so is their desired value.
    assert not record["tracking_error"][-1, :2].any()


@pytest.mark.slow
@pytest.mark.parametrize("share", some([0.95, 0.6]))
def test_a_force_along_the_face_tips_it_as_analyze_says(share, file):
    """A push along the face takes the same share of the force of a point as it has of `tips`.

    Once it has grown to its full size. Both points hold the arm, which has no other outputs, so
    nothing balances the push, and the share is exact.
    """
    phases = "task.phases=[!Press {force: 20, over: 0.1}, !Dwell {duration: 0.3}]"
    needs = find_feasibility(load_scenario(file, [phases])).task
    press, dwell = needs.phases
    assert press.face is None
    assert dwell.face.eccentricity < 1e-6
    assert f"{dwell.face.tips:.2g} N along it" in needs.tipping
    lost = []
    for sign in (-1.0, 1.0):
        force = [0.0, 0.0, sign * share * dwell.face.tips]
        push = f"{{frame: tool, force: {force}, start_time: 0.25, end_time: 0.9}}"
        record, _ = rolled(file, phases, "sampling={period: 0.001}", f"plant_disturbances=[{push}]")
        after = np.searchsorted(record.time, 0.35)
        lost.append(1.0 - record["constraint_force"][after].min() / 10.0)
    assert_allclose(max(lost), share, atol=1e-6)


@pytest.mark.slow
def test_it_rolls_as_it_is_simulated(file):
    """Steps of 1e-8 leave 1e-6 N and m of both."""
    accurate = ["integrator.accuracy=1e-8", "integrator.use_error_control=true"]
    chosen = load_scenario(file, [*accurate, "duration=0.75"])
    loop, context = build_scenario(chosen)
    found, changes = rolled(file, *accurate, "duration=0.75")
    simulate(loop.diagram, context, chosen.duration, chosen.integrator)
    times = [change.time for change in loop.changes(context)]
    assert_allclose([change.time for change in changes], times, atol=1e-6)
    for name in ("state", "constraint_force"):
        end = loop.record(context)[name][-1]
        assert_allclose(found[name][-1], end, atol=1e-6)


@pytest.mark.slow
def test_it_touches_with_an_edge_and_presses_flat(file):
    """The wall is tilted by 0.5 degrees. No integral moves before both points press."""
    record, changes = rolled(file, *TOUCHES, *TILTED, "duration=3")
    phases = [change.phase for change in changes]
    assert phases == ["Approach", "Press", "done"]
    touch, last = in_phase(record, 1)[5], in_phase(record, 1)[-1]
    assert record["constraint_force"][touch].min() < 0.1 < record["constraint_force"][touch].max()
    upper, lower = record["constraint_force"][last]
    assert abs(upper - lower) <= 0.5 * (upper + lower)
    assert_allclose(upper + lower, 20.0, atol=1.0)
    both = np.flatnonzero((record["constraint_force"] > 0.25).all(axis=1))
    moved = np.flatnonzero(record["integral"].any(axis=1))
    assert both[0] < moved[0]
    still = (np.diff(record["integral"], axis=0) == 0.0).all(axis=1)
    tipped = (record["measured_force"] < 0.24).any(axis=1)
    assert still[tipped[:-1]].all()
    # At the end the force follows from the integrals.
    end = record["controlled_output"][in_phase(record, 2)][-1]
    assert_allclose(end[:2], [20.0, 0.0], atol=0.1)


@pytest.mark.slow
def test_a_center_of_pressure_near_the_edge_trips_its_guard(file):
    """M = 0.03 F e for the eccentricity e: its guard of 0.8 trips before the face tips."""
    move = (
        "task.phases.1=!Move {references: {face.force: 24, face.my: 0.7}, duration: 0.5, over: 0.4"
    )
    guard = "guards: [{of: eccentricity, most: 0.8}], on_failure: leave}"
    record, changes = rolled(file, f"{move}, {guard}")
    assert changes[2].phase == "leave"
    reason = "Move is ended by an eccentricity of 0.8, where its guard has 0.8"
    assert changes[2].reason == reason
    row = np.searchsorted(record.time, changes[2].time)
    F, M = record["controlled_output"][row, :2]
    assert_allclose(M / (HALF * F), 0.8, atol=0.05)


@pytest.mark.parametrize(
    ("settings", "key", "message"),
    [
        (["task.contact=[upper, upper]"], "task.contact", "a point is named twice: upper, upper"),
        (["task.contact=[upper, low]"], "task.contact", "'low' is not a unilateral constraint"),
        (["task.contact=''"], "task.contact", "give one, or a list of the points of a face"),
        (["task.contact=upper"], "task", "'upper.force' must be one of the outputs by itself"),
        (
            ["forces=[upper.force, lower.force]"],
            "task",
            "needs 2 outputs that depend on these forces alone, one of them their sum",
        ),
        (
            ["forces.0.points=[upper]"],
            "forces.0",
            r"'face' needs two points or more, got \['upper'\]",
        ),
    ],
)
def test_what_is_no_face_is_refused(file, settings, key, message):
    with pytest.raises(ScenarioError, match=message) as raised:
        build_scenario(load_scenario(file, settings))
    assert key in str(raised.value)


@pytest.mark.slow
def test_an_eccentricity_needs_several_points(file):
    guard = "task.phases.4.guards=[{of: eccentricity, most: 0.5}]"
    with pytest.raises(ScenarioError, match="eccentricity needs a contact of several points"):
        build_scenario(scenario("wall_polish", guard))


def test_a_face_opens_with_its_distances_in_the_places_of_its_forces(file):
    system = scenario_model(load_scenario(file)).dae
    free = open_contact(system, ["lower.force", "upper.force"])
    assert [s.name for s in free.output_signals] == ["upper.distance", "lower.distance"]
    assert free.num_constraints == 0
    with pytest.raises(ModelError, match="must be one of the outputs by itself"):
        open_contact(system, "upper.force")


@pytest.mark.slow
def test_a_measured_face_is_the_law_of_its_measured_points(file):
    """Gbar (S v - S r) = S Gbar (v - r) for a number Gbar, and so for integrals: to round-off."""
    face = scenario_model(load_scenario(file)).dae
    points = scenario_model(load_scenario(file, ["forces=[upper.force, lower.force]"])).dae
    S, wanted, measured = np.array([[1.0, 1.0], [HALF, -HALF]]), [12.0, 8.0], [10.0, 9.5]
    state = TrackingLaw(face, poles(-25.0)).structure.manifold.project(face.nominal_state)
    controls, rates = [], []
    for system, reference in ((points, wanted), (face, S @ wanted)):
        names = [signal.name for signal in system.output_signals]
        law = TrackingLaw(system, poles(-5.0), measured_force=True, force_gain=0.4, integral=names)
        sigma = np.array([0.2, -0.1]) if system is points else S @ [0.2, -0.1]
        found = law.function(state, reference, measured, sigma, law.all_parameters())
        controls.append(found[0].copy())
        rates.append(found[2].copy())
        least = law.measured_force.inputs_for(ca.SX(reference))
        least = ca.evalf(ca.substitute(least, system.state, state))
        assert_allclose(least.full().ravel(), wanted)
    assert_allclose(controls[1], controls[0], rtol=1e-12)
    assert_allclose(rates[1], S @ rates[0], rtol=1e-12)
    with pytest.raises(GainError, match=r"one number, since 'face\.force' is a combination"):
        TrackingLaw(face, poles(-5.0), measured_force=True, force_gain=np.diag([0.4, 0.2]))


def test_a_face_that_turns_flat_is_braked_by_the_friction_of_its_points():
    """Power -mu F r omega of torsion: the flange turns about the normal at 0.5 rad/s.

    The regularization leaves s = r omega / sqrt((r omega)^2 + v_s^2) of it.
    """
    model = scenario_model(scenario("flat_press"))
    dae, links = model.dae, model.links
    flat = find_structure(dae).manifold.project(dae.nominal_state)
    q, v = flat[: links.q.numel()], np.zeros(links.v.numel())
    names = [signal.name for signal in links.velocity_signals]
    v[names.index("joint7_w")], each = 0.5, 10.0
    forces = ca.SX.sym("force", 3)
    power = dae.trace(
        "power", {"p": ca.dot(links.v, ca.mtimes(dae.g, forces)[-v.size :])}, {"force": forces}
    )
    found = power(np.hstack([q, v]), np.full(3, each), dae.parameter_values)[0].item()
    speed = 0.03 * 0.5
    expected = -0.1 * 3 * each * speed**2 / np.hypot(speed, 0.01)
    assert_allclose(found, expected, rtol=1e-4)  # Points of the file have 7 digits.


@pytest.mark.slow
@pytest.mark.thorough
def test_the_center_of_pressure_stays_while_a_face_slides_with_friction():
    """Within 6 mm of 15 mm to an edge; 11 mm without the observer. On the equations of Drake.

    A tangential force that the law does not know has a lever of 0.47 m: 3 % of the normal force
    would tip the face if it lasted.
    """
    chosen = scenario(
        "flat_press", "plant=!CompliantContact {stiffness: 1.0e5, radius: 0.001, friction: 0.1}"
    )
    loop, context = build_scenario(chosen)
    found = roll_scenario(chosen, loop, context)
    changes = loop.changes(found.context)
    assert changes[-1].phase == "done"
    slides = next(change.time for change in changes if change.phase == "Move 3")
    record = found.record
    rows = (record.time > slides + 1.0) & (record.time < slides + 5.0)
    forces, errors = record["constraint_force"][rows], record["tracking_error"][rows]
    names = [signal.name for signal in record.signals["tracking_error"].signals]
    moments = errors[:, [names.index("face.mx"), names.index("face.my")]]
    assert np.abs(moments / forces.sum(axis=1)[:, None]).max() < 6e-3
    assert forces.min() > 0.0
