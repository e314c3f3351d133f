"""The Painleve paradox of frictional contacts, against closed forms.

The rod: uniform, of length 2 l and mass m, one end on a rough floor, at an angle a to it. With the
friction of an end that slides toward -x, J M^-1 J^T = (1 + 3 cos^2 a) / m and
J M^-1 J_t^T = -3 sin a cos a / m, so that

    m A = 1 + 3 cos^2 a - 3 mu sin a cos a,    mu_crit = (1 + 3 cos^2 a) / (3 sin a cos a),

which is least at tan a = 2, where it is 4/3.
"""

import itertools
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from arms import error_controlled, touching
from numpy.testing import assert_allclose
from painleve import GRAVITY, HALF, MASS, critical, rod, sliding
from pydrake.geometry import SceneGraph
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
from runs import some

from drake_dae import (
    ConstantReference,
    RobotPlant,
    SinusoidReference,
    TrackingLaw,
    analyze,
    load_scenario,
    make_closed_loop,
    poles,
    rollout,
    simulate,
)
from drake_dae.dae import PainleveOutcome, Parameter, Signal, UnilateralInput, painleve_outcome
from drake_dae.dae.contacts import MOST, Contacts, critical_factor
from drake_dae.errors import ModelError, PainleveError
from drake_dae.references import stack_references
from drake_dae.running import start_values
from drake_dae.scenario.model import scenario_model
from drake_dae.scenario.shipped import find_scenario
from drake_dae.trace.functions import TracedFunction


def margin_of(mu, angle):
    return 1.0 - mu / critical(angle)


@pytest.fixture(scope="module")
def steep():
    """A rod with the Painleve paradox between 50 and 76 degrees."""
    return RobotPlant(rod(1.5))


def context_of(plant, state):
    context = plant.CreateDefaultContext()
    plant.GetInputPort("control").FixValue(context, np.zeros(3))
    plant.set_state(context, state)
    return context


@pytest.mark.parametrize("angle", some([0.3, 0.8, 1.0, 1.4], of=3))
@pytest.mark.parametrize("friction", [0.0, 0.3, 0.8])
def test_analyze_finds_the_critical_coefficient_at_a_state(angle, friction):
    """mu_crit in closed form; s is 1 except for (v_s / v)^2 / 2 = 1e-7. Without friction, too."""
    system = rod(friction).dae
    found = analyze(system, states=[sliding(angle)]).contact_margin
    assert found.critical_friction["floor.friction"] == pytest.approx(critical(angle), rel=1e-6)
    assert found.reserve == pytest.approx(margin_of(friction, angle), abs=1e-6)
    assert not found.is_paradoxical


def test_a_rod_that_slides_the_other_way_has_no_paradox():
    found = analyze(rod(0.8).dae, states=[sliding(1.0, slide=2.0)]).contact_margin
    assert found.critical_friction == {"floor.friction": np.inf}
    assert found.reserve == 1.0
    assert "no coefficient" in str(analyze(rod(0.8).dae, states=[sliding(1.0, slide=2.0)]))


@pytest.mark.parametrize("friction", [0.3, 1.2, 1.5])
def test_analyze_finds_the_worst_angle_of_a_region(friction):
    """4/3 at tan a = 2; slow states of the region have s below 1, by less than 1e-3."""
    found = analyze(rod(friction).dae, region={"q2": (0.2, 1.5)})
    margin = found.contact_margin
    assert margin.critical_friction["floor.friction"] == pytest.approx(4.0 / 3.0, rel=1e-3)
    assert np.tan(margin.state[2]) == pytest.approx(2.0, abs=0.05)
    assert margin.reserve == pytest.approx(1.0 - 0.75 * friction, abs=2e-3)
    paradoxical = friction > 4.0 / 3.0
    assert margin.is_paradoxical is paradoxical
    assert any("Painleve" in problem for problem in found.problems) is paradoxical
    assert found.to_dict()["contact_margin"]["critical_friction"]["floor.friction"] > 1.33


@pytest.mark.parametrize(
    ("turn", "outcome"), [(0.0, PainleveOutcome.INCONSISTENT), (6.0, PainleveOutcome.INDETERMINATE)]
)
def test_in_the_paradox_a_rod_has_no_motion_or_two(steep, turn, outcome):
    """b = l sin a a'^2 - g: a rod at rest would pierce the floor, one that turns fast lifts off."""
    state = sliding(1.1, turn)
    context = context_of(steep, state)
    free = HALF * np.sin(1.1) * turn**2 - GRAVITY
    assert (free < 0.0) == (outcome is PainleveOutcome.INCONSISTENT)
    with pytest.raises(PainleveError, match=r"'floor\.force'") as caught:
        steep.EvalTimeDerivatives(context)
    assert caught.value.outcome is outcome
    assert_allclose(caught.value.state, state)


def test_outside_of_the_paradox_a_rod_moves_as_by_hand(steep):
    """At 80 degrees mu_crit is 2.1: lambda = -b / A."""
    angle, turn = np.deg2rad(80.0), 0.7
    context = context_of(steep, sliding(angle, turn))
    A = margin_of(1.5, angle) * (1.0 + 3.0 * np.cos(angle) ** 2) / MASS
    expected = (GRAVITY - HALF * np.sin(angle) * turn**2) / A
    force = steep.GetOutputPort("constraint_force").Eval(context)
    assert force[0] == pytest.approx(expected, rel=1e-5)


def follow(model, references, state, duration, friction=None, accuracy=1e-8):
    """A run under a law; its own model has the model's friction, the plant may have another."""
    law = TrackingLaw(model.dae, poles(-6.0))
    loop = make_closed_loop(RobotPlant(model, structure=law.structure), law, references)
    context = loop.diagram.CreateDefaultContext()
    own = loop.plant.GetMyMutableContextFromRoot(context)
    loop.plant.set_consistent_state(own, state)
    if friction is not None:
        loop.plant.set_parameter(own, "floor.friction", friction)
    try:
        simulate(loop.diagram, context, duration, error_controlled(accuracy))
    finally:
        record = loop.record(context)
    return record


def tilting(speed=-2.0):
    """The rod slides at a constant speed and falls from 80 degrees to 40 within 4 s."""
    path = SinusoidReference(np.deg2rad(60.0), np.deg2rad(20.0), np.pi / 4.0, np.pi / 2.0)
    slide = SinusoidReference(0.0, speed / 1e-2, 1e-2)
    return [slide, path, ConstantReference(5.0)]


@pytest.mark.slow
def test_a_run_that_reaches_the_edge_stops_there():
    """Under a law that knows the friction lambda stays 5 N, so b = -A lambda: beyond, two fit.

    tan a = (9 + 17^(1/2)) / 4 where 3 mu t = t^2 + 4 with mu = 1.5, and a(t) is as commanded.
    """
    start = sliding(np.deg2rad(80.0))
    with pytest.raises(PainleveError) as caught:
        follow(rod(1.5, np.deg2rad(80.0)), tilting(), start, 3.5)
    angle = np.arctan((9.0 + np.sqrt(17.0)) / 4.0)
    when = np.arccos((np.rad2deg(angle) - 60.0) / 20.0) / (np.pi / 4.0)
    assert caught.value.time == pytest.approx(when, abs=1e-5)
    assert caught.value.state[2] == pytest.approx(angle, abs=1e-5)
    assert caught.value.outcome is PainleveOutcome.INDETERMINATE


def test_a_rollout_into_the_edge_ends_with_the_words_of_drakes_simulator():
    """It was told that A(x) is singular. The rod turns up with 6 rad/s, without any control."""
    plant = RobotPlant(rod(1.5, 0.7))
    builder = DiagramBuilder()
    builder.AddSystem(plant)
    still = builder.AddSystem(ConstantVectorSource(np.zeros(3)))
    builder.Connect(still.get_output_port(), plant.GetInputPort("control"))
    builder.ExportOutput(plant.GetOutputPort("state"), "state")
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    plant.set_state(plant.GetMyMutableContextFromRoot(context), sliding(0.7, 6.0))
    config = error_controlled(1e-8)
    (found,) = rollout(diagram, *start_values(diagram, context), [0.0, 0.5], config=config)
    with pytest.raises(PainleveError) as raised:
        simulate(diagram, context, 0.5, config)
    assert isinstance(found.failure, PainleveError)
    assert found.failure.outcome is raised.value.outcome
    assert found.failure.time == pytest.approx(raised.value.time, abs=1e-7)
    words = "'floor.force'"
    assert words in str(found.failure)
    assert words in str(raised.value)


@pytest.mark.slow
def test_analyze_reports_a_reference_that_leads_into_it():
    """The motion ends there, and the margin along it falls to zero as in closed form."""
    law = TrackingLaw(rod(1.5, np.deg2rad(80.0)).dae, poles(-6.0))
    reference = stack_references(tilting(), law.degrees)
    times, start = np.linspace(0.0, 3.5, 200), sliding(np.deg2rad(80.0))
    found = analyze(law.system, reference=reference, times=times, start=start)
    along = found.contact_margin_along
    assert along.time == pytest.approx(1.09045, abs=1e-4)
    assert along.reserve == pytest.approx(margin_of(1.5, along.state[2]), abs=1e-5)
    assert any("A(x) becomes singular" in problem for problem in found.problems)
    gentle = analyze(law.system, reference=reference, times=times[:40], start=start)
    assert not gentle.problems
    assert gentle.contact_margin.is_paradoxical
    assert not gentle.contact_margin_along.is_paradoxical
    assert "along the reference at least" in " ".join(str(gentle).split())
    assert "paradox is at floor.friction" in " ".join(str(gentle).split())


def test_a_law_that_does_not_know_the_friction_does_not_reach_it():
    """With b finite the force would grow as 1 / A: friction turns the motion around before.

    Genot and Brogliato (1999): the edge is reached where A and b vanish together, or not at all.
    """
    start = sliding(np.deg2rad(80.0))
    record = follow(rod(0.0, np.deg2rad(80.0)), tilting(), start, 3.5, friction=1.5)
    assert record.time[-1] == pytest.approx(3.5)
    assert 15.0 < record["constraint_force"].max() < 20.0


# Several contacts: P-matrices.


def minors(matrix, rows):
    kept = [i for i in range(len(matrix)) if i not in rows]
    sets = [np.flatnonzero(bits) for bits in np.ndindex(*(2,) * len(rows)) if any(bits)]
    sets = [[*kept, *np.array(rows)[chosen]] for chosen in sets]
    return np.array([np.linalg.det(matrix[np.ix_(s, s)]) for s in sets])


@pytest.mark.parametrize("seed", range(40))
def test_the_reserve_is_positive_exactly_for_a_p_matrix(seed):
    """Against all principal minors, of contacts 1, 2 and 4 of four constraints and more or less
    friction; the critical factor is where one of them comes to zero."""
    random = np.random.default_rng(seed)
    root = random.standard_normal((4, 6))
    A_0, rows = root @ root.T, [0, 1, 3]
    D = A_0 @ np.diag([1, 1, 0, 1]) * random.uniform(-1.0, 1.0, (4, 4))
    mu = ca.SX.sym("mu")
    parameter = Parameter("mu", np.array([0.0]), symbol=mu)
    names = [Signal(name) for name in "abcd"]
    contacts = Contacts("x", names, [parameter], [UnilateralInput(n, "mu") for n in "abd"])
    assert contacts.rows == rows
    function = TracedFunction("r", {"mu": mu}, {"r": contacts.reserve(ca.SX(A_0) - mu * D)})
    critical = critical_factor(A_0, D, rows)
    for share in (0.3, 0.99, 1.01):
        friction = share * critical if np.isfinite(critical) else 10.0 * share
        reserve = function([friction])[0].item()
        assert (reserve > 0.0) == bool(np.all(minors(A_0 - friction * D, rows) > 0.0))
        assert (reserve > 0.0) == (share < 1.0 or not np.isfinite(critical))


@pytest.mark.parametrize("count", [2, 3, 4])
@pytest.mark.parametrize("seed", range(5))
def test_the_reserve_is_the_least_ratio_of_minors_in_any_order_of_the_contacts(seed, count):
    random = np.random.default_rng(seed)
    root = random.standard_normal((count + 1, count + 3))
    A_0 = root @ root.T
    rows = list(range(count))
    A_1 = A_0 * (1.0 + random.uniform(-0.6, 0.3, A_0.shape))
    A_1[:, count:] = A_0[:, count:]  # The last constraint cannot open, and has no friction.
    mu, names = ca.SX.sym("mu"), [f"f{i}" for i in range(count + 1)]
    parameter = Parameter("mu", np.array([0.0]), symbol=mu)
    wanted = min(1.0, (minors(A_1, rows) / minors(A_0, rows)).min())
    for order in itertools.permutations(rows):
        places = [*order, count]
        contacts = [UnilateralInput(f"f{i}", "mu") for i in range(count)]
        both = Contacts("x", [Signal(names[i]) for i in places], [parameter], contacts)
        matrix = ca.SX(A_0 + 0.0) + mu * (A_1 - A_0)
        reserve = both.reserve(matrix[places, places])
        found = TracedFunction("r", {"mu": mu}, {"r": reserve})([1.0])[0].item()
        # Determinants of four rows, by elimination in another order.
        assert found == pytest.approx(wanted, rel=1e-9, abs=1e-12)


def test_sets_of_forces_are_those_of_complementarity():
    """Two contacts by hand: A = [[-1, 0], [0, 2]], b = -A v."""
    A, A_0 = np.diag([-1.0, 2.0]), np.diag([1.0, 2.0])
    rows, size = [0, 1], np.full(2, 10.0)
    assert (
        painleve_outcome(A, A_0, np.array([3.0, 1.0]), size, rows) is PainleveOutcome.INDETERMINATE
    )
    assert (
        painleve_outcome(A, A_0, np.array([-3.0, 1.0]), size, rows) is PainleveOutcome.INCONSISTENT
    )
    assert painleve_outcome(A_0, A_0, np.array([3.0, 1.0]), size, rows) is None
    assert painleve_outcome(A_0, A_0, np.array([-3.0, -1.0]), size, rows) is PainleveOutcome.OPENING
    edge = np.diag([0.0, 2.0])
    assert (
        painleve_outcome(edge, A_0, np.array([3.0, 0.0]), size, rows)
        is PainleveOutcome.INDETERMINATE
    )
    assert (
        painleve_outcome(edge, A_0, np.array([np.inf, 1.0]), size, rows)
        is PainleveOutcome.INCONSISTENT
    )


def test_too_many_contacts_are_refused():
    names = [Signal(f"f{i}") for i in range(MOST + 1)]
    friction = Parameter("mu", np.array([0.3]))
    with pytest.raises(ModelError, match="9"):
        Contacts("x", names, [friction], [UnilateralInput(n.name, "mu") for n in names])


def test_a_contact_needs_the_friction_that_it_names():
    system = touching("two_link").dae
    with pytest.raises(ModelError, match=r"wall\.friction"):
        replace(system, contacts=(UnilateralInput("wall.force", "wall.friction"),))


@pytest.mark.slow
def test_feet_that_do_not_slide_have_no_paradox():
    """Gripped points with coefficients of their own: whatever these are, s is but round-off."""
    settings = ["constraints.0.friction=0.4", "constraints.1.friction=0.6"]
    scenario = load_scenario(find_scenario("biped"), settings)
    found = analyze(scenario_model(scenario, SceneGraph()).dae, count=5).contact_margin
    assert found.critical_friction == {"front.friction": np.inf, "rear.friction": np.inf}
    assert found.reserve == pytest.approx(1.0, abs=1e-9)
