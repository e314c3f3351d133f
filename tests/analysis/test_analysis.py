"""The report: what it knows of systems with known answers, and of systems that violate it."""

import json
import re

import casadi as ca
import numpy as np
import pytest
from problems import (
    PROBLEMS,
    changed,
    double_integrator,
    early_control,
    hanging_pendulum,
    redundant,
    system_of,
)

from drake_dae.analysis.analyze import analyze
from drake_dae.analysis.findings import Finding
from drake_dae.analysis.report import Analysis
from drake_dae.dae.manifold.manifold import Manifold
from drake_dae.dae.states.region import ConsistentRegion, Region
from drake_dae.dae.structure.structure import find_structure
from drake_dae.dae.system.system import DaeSystem
from drake_dae.dae.zero_dynamics.stability import Verdict
from drake_dae.errors import InconsistentStateError, ModelError


def findings(analysis: Analysis) -> list[Finding]:
    return [assumption.finding for assumption in analysis.assumptions]


YES, NO, OPEN = Finding.SATISFIED, Finding.VIOLATED, Finding.NOT_EXAMINED


# ---- systems that satisfy the assumptions


@pytest.mark.slow
def test_what_is_known_of_the_problems(problem):
    analysis = analyze(problem.system, count=12)
    assert findings(analysis) == [YES] * 5
    assert analysis.constraint_degrees == problem.constraint_degrees
    assert analysis.output_degrees == problem.output_degrees
    assert analysis.output_order == problem.output_order
    assert analysis.index == problem.index
    assert analysis.manifold_dimension == problem.manifold_dimension
    assert analysis.zero_dynamics_dimension == problem.zero_dynamics
    assert analysis.structure.output_degrees == problem.output_degrees
    # Found by going downhill from the sampled states, so at most what these have.
    a, b = (analysis.assumptions[i].margin for i in (1, 4))
    sampled = [problem.known(x) for x in analysis.states]
    least = min(np.linalg.svd(k.control_matrix)[1][-1] for k in sampled)
    assert 0.0 < b.singular_value <= least * (1 + 1e-10)
    if problem.constraint_degrees:
        least = min(np.linalg.svd(k.constraint_matrix)[1][-1] for k in sampled)
        assert 0.0 < a.singular_value <= least * (1 + 1e-10)
    else:
        assert a is None


@pytest.mark.slow
def test_margins_belong_to_their_states(problem):
    """The state of a margin is consistent, and A or B is as near to singular there as said."""
    analysis = analyze(problem.system, count=12)
    for margin in (analysis.assumptions[1].margin, analysis.assumptions[4].margin):
        if margin is not None:
            # Projected to round-off of numbers of order 10.
            np.testing.assert_allclose(problem.derivatives(margin.state), 0.0, atol=1e-13)
    b = analysis.assumptions[4].margin
    found = np.linalg.svd(problem.known(b.state).control_matrix)[1][-1]
    assert b.singular_value <= found * (1 + 1e-10)


@pytest.mark.slow
def test_the_gradients_of_all_chains(problem):
    """Theorem 2.1, from the chains that find_structure returns, by NumPy's rank."""
    analysis = analyze(problem.system, count=3)
    structure, system = find_structure(problem.system), problem.system
    chains = [e for chain in structure.output_chains for e in chain]
    rows = ca.vertcat(structure.manifold.residual_expression, *chains)
    if not rows.numel():
        assert analysis.independence is None
        return
    symbols = [system.state, system.parameter_symbol]
    gradient = ca.Function("gradient", symbols, [ca.densify(ca.jacobian(rows, system.state))])
    values = [gradient(x, system.parameter_values).full() for x in analysis.states]
    assert all(np.linalg.matrix_rank(value) == rows.numel() for value in values)
    least = min(np.linalg.svd(value)[1][-1] for value in values)
    assert analysis.independence.singular_value == pytest.approx(least, rel=1e-9)


def test_zero_dynamics_that_are_unstable_are_a_problem():
    """x0' = x1 + u, x1' = 2 x1 + u, z = x0: u = -x1 pins z, and x1' = x1 runs away."""
    analysis = analyze(
        system_of(2, f=lambda x: [x[1], 2 * x[1]], h=lambda x: [1, 1], l=lambda x: x[0])
    )
    assert analysis.zero_dynamics.verdict is Verdict.UNSTABLE
    np.testing.assert_allclose(analysis.zero_dynamics.eigenvalues, [1.0], rtol=1e-9)
    (problem,) = analysis.problems
    assert "Assumption 2.2: non-minimum phase" in problem
    assert re.search(r"2\.2  zero dynamics are stable +violated", str(analysis))
    assert "eigenvalues 1 1/s" in str(analysis)


def test_zero_dynamics_that_are_undecided_are_none():
    """A pendulum held by its tension swings for ever."""
    analysis = analyze(PROBLEMS["pendulum_tension"]().system)
    assert analysis.problems == ()
    assert re.search(r"2\.2  zero dynamics are stable +undecided", str(analysis))
    assert re.search(r"eigenvalues 0 ± 3\.8\d+i 1/s", str(analysis))


# ---- violated assumptions, and what is known before


def test_1_a_degree_that_is_not_defined():
    fields = {
        "f": lambda x: [0, 0, 0],
        "h": lambda x: [1, 0, 0],
        "k": lambda x: x[1] - 1,
        "l": lambda x: x[0],
        "m": lambda x: 0,
    }
    analysis = analyze(system_of(3, g=lambda x: [0, x[0], 0], **fields))
    assert findings(analysis) == [NO, OPEN, OPEN, OPEN, OPEN]
    assert (analysis.constraint_degrees, analysis.index, analysis.structure) == (None, None, None)
    (problem,) = analysis.problems
    assert problem.startswith("Assumption (1): the relative degree of constraint 'y0' is not")
    assert "index ?, N* of dimension ?, zero dynamics of dimension ?" in str(analysis)
    # Beside the nominal state only, and without a change of sign.
    beside = system_of(3, g=lambda x: [0, (x[0] - 0.03) ** 2, 0], state_scale=np.ones(3), **fields)
    find_structure(beside)
    analysis = analyze(beside)
    assert findings(analysis) == [NO, OPEN, YES, YES, YES]
    assert analysis.assumptions[0].margin.state[0] == pytest.approx(0.03, abs=1e-3)
    assert analysis.constraint_degrees == (1,)
    assert analysis.structure is not None


def test_2_redundant_constraints():
    analysis = analyze(redundant(lambda x: [x[0], x[0]]))
    assert findings(analysis) == [YES, NO, YES, OPEN, OPEN]
    assert (analysis.constraint_degrees, analysis.index) == ((2, 2), None)
    assert (analysis.output_degrees, analysis.structure) == (None, None)
    assert "Remove a redundant constraint" in analysis.problems[0]
    assert analysis.assumptions[1].margin.relative < 1e-12
    assert analysis.assumptions[3].reason == "Assumption (2) is violated"


def test_2_more_constraints_than_states():
    analysis = analyze(
        system_of(
            1,
            f=lambda x: 0,
            g=lambda x: [[1, 1]],
            h=lambda x: 1,
            k=lambda x: [x[0], x[0] + 1],
            l=lambda x: x[0],
            m=lambda x: [[0, 0]],
        )
    )
    assert findings(analysis) == [OPEN, NO, OPEN, OPEN, OPEN]
    assert "m = 2 constraints are more than the states" in str(analysis)


def test_3_a_control_that_enters_before_the_force_does():
    analysis = analyze(early_control())
    assert findings(analysis) == [OPEN, OPEN, NO, OPEN, OPEN]
    assert "add an actuator state in front of it" in analysis.problems[0]


def test_4_a_degree_that_is_not_defined():
    analysis = analyze(double_integrator(l=lambda x: x[0] + x[1] ** 2))
    assert findings(analysis) == [YES, YES, YES, NO, OPEN]
    assert analysis.constraint_degrees == ()
    assert analysis.index == 0
    assert "output 'z0' is not defined at x = [0., 0.]" in analysis.problems[0]


def test_5_an_output_that_no_control_reaches():
    arm = PROBLEMS["two_link_arm"]().system
    analysis = analyze(changed(arm, l=ca.vertcat(0, arm.k)))
    assert findings(analysis) == [YES, YES, YES, OPEN, NO]
    assert (analysis.constraint_degrees, analysis.output_degrees) == ((2,), None)
    assert analysis.structure is None
    assert re.search(r"height +\? +\?", str(analysis))


def test_5_outputs_that_repeat_each_other():
    analysis = analyze(
        system_of(2, f=lambda x: [0, 0], h=lambda x: [[1, 0], [0, 1]], l=lambda x: [x[0], 2 * x[0]])
    )
    assert findings(analysis) == [YES, YES, YES, YES, NO]
    assert analysis.output_degrees == (1, 1)
    # Their gradients depend on each other as well, which is nothing new.
    assert len(analysis.problems) == 1
    assert analysis.independence.is_singular
    assert re.search(r"^2\.1 .* does not hold ", str(analysis), re.M)
    constraints = re.findall(r"^\([123]\) .*: m = 0 +satisfied$", str(analysis), re.M)
    assert len(constraints) == 3
    assert (analysis.structure, analysis.zero_dynamics) == (None, None)


# ---- singular states between the sampled ones


def nearly_singular(gap: float) -> DaeSystem:
    """B = [[1, 1], [1, 1 + gap + (x2 - 0.3)^2]], whose determinant does not change its sign."""
    return system_of(
        3,
        f=lambda x: [0, 0, 0],
        h=lambda x: [[1, 1], [1, 1 + gap + (x[2] - 0.3) ** 2], [0, 0]],
        l=lambda x: x[:2],
    )


def test_a_singular_b_without_a_change_of_sign():
    system = nearly_singular(0.0)
    find_structure(system, spread=1.0)  # Does not find it.
    analysis = analyze(system, region={"x2": (-1.0, 1.0)})
    assert findings(analysis) == [YES, YES, YES, YES, NO]
    margin = analysis.assumptions[4].margin
    # Singular is what is below 1e-6, and the determinant (x2 - 0.3)^2.
    assert margin.state[2] == pytest.approx(0.3, abs=2e-3)
    assert analysis.structure is not None
    # A region that does not hold it.
    assert findings(analyze(system, region={"x2": (0.35, 1.0)})) == [YES] * 5


def test_the_least_margin_in_a_region():
    """Where there is no zero, the least is approached: at x2 = 0.3, and at the edge of a box."""
    for low, best in ((-1.0, 0.3), (0.5, 0.5)):
        analysis = analyze(nearly_singular(0.05), region={"x2": (low, 1.0)}, count=20)
        margin = analysis.assumptions[4].margin
        least = np.linalg.svd([[1, 1], [1, 1.05 + (best - 0.3) ** 2]])[1][-1]
        # Flat at the least: 5% of the width away from it costs 1% of the 0.05 there.
        assert margin.singular_value == pytest.approx(least, rel=0.01)
        assert margin.state[2] == pytest.approx(best, abs=0.05)


def test_a_singularity_of_two_dimensions_less():
    """det B = (x2 - 0.3)^2 + (x2 + x3)^2 vanishes at one point of a plane."""
    system = system_of(
        4,
        f=lambda x: [0, 0, 0, 0],
        h=lambda x: [[1, 1], [1, 1 + (x[2] - 0.3) ** 2 + (x[3] + x[2]) ** 2], [0, 0], [0, 0]],
        l=lambda x: x[:2],
    )
    analysis = analyze(system, region={"x2": (-1.0, 1.0), "x3": (-1.0, 1.0)})
    assert findings(analysis)[4] is NO
    np.testing.assert_allclose(analysis.assumptions[4].margin.state[2:], [0.3, -0.3], atol=2e-3)


def stretching() -> DaeSystem:
    """Two massless links of 1 m with unit inertias at their joints, the tip on a rail at (s, 0)."""
    q, v = ca.SX.sym("q", 3), ca.SX.sym("v", 3)
    phi = ca.vertcat(ca.cos(q[0]) + ca.cos(q[0] + q[1]) - q[2], ca.sin(q[0]) + ca.sin(q[0] + q[1]))
    jacobian = ca.jacobian(phi, q)
    return DaeSystem(
        state=ca.vertcat(q, v),
        f=ca.vertcat(v, ca.SX.zeros(3)),
        g=ca.vertcat(ca.SX(3, 2), jacobian.T),
        h=ca.vertcat(ca.SX(3, 1), ca.SX([0, 0, 1])),
        k=phi,
        l=q[2],
        m=ca.SX(1, 2),
        nominal_state=[0.9, -1.8, 1.2, 0.0, 0.0, 0.0],
        name="stretching arm",
    )


@pytest.mark.slow
def test_an_arm_that_stretches_out():
    """On N* x1 = -2 x0 and s = 2 cos x0, so s is stationary at x0 = 0 and B vanishes there."""
    analysis = analyze(stretching(), region={"x1": (-2.5, 0.5)})
    assert findings(analysis)[:3] == [YES] * 3
    assert NO in findings(analysis)
    violated = next(a for a in analysis.assumptions if a.finding is NO)
    np.testing.assert_allclose(violated.margin.state[:3], [0.0, 0.0, 2.0], atol=2e-3)
    assert findings(analyze(stretching(), region={"x1": (-2.5, -1.0)})) == [YES] * 5


# ---- regions and given states


def test_a_region_bounds_all_states():
    """The pendulum with y in [-0.5, -0.2]: x follows from the rod, the velocities are free."""
    system = PROBLEMS["pendulum"]().system
    analysis = analyze(system, region={"y": (-0.5, -0.2), "x": (0.0, 1.0)})
    x, y = analysis.states[:, 0], analysis.states[:, 1]
    assert len(y) > 40
    np.testing.assert_array_less(np.abs(y + 0.35), 0.15 + 1e-6)
    assert np.ptp(y) > 0.2
    np.testing.assert_allclose(x, np.sqrt(0.64 - y**2), rtol=1e-5)
    # B = y^2 / (m L^2) is least at the upper edge.
    margin = analysis.assumptions[4].margin
    assert margin.singular_value == pytest.approx(0.04 / (2.0 * 0.64), rel=1e-4)
    assert analysis.where.endswith("with y in [-0.5, -0.2], x in [0, 1]")


def test_a_state_can_be_held():
    system = PROBLEMS["pendulum"]().system
    analysis = analyze(system, region={"x": (0.48, 0.48)})
    assert len(analysis.states) == 51
    np.testing.assert_allclose(analysis.states[:, :2], [[0.48, -0.64]] * 51, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("region", [{"x": (1.0, 2.0)}, {"x": (0.5, 0.7), "y": (-0.3, -0.2)}])
def test_a_region_without_consistent_states(region):
    """The rod is 0.8 m long."""
    with pytest.raises(InconsistentStateError, match=r"no consistent state found with x in \["):
        analyze(PROBLEMS["pendulum"]().system, region=region)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"region": {"vxx": (0, 1)}},
            r"region: no state 'vxx'; did you mean 'vx'\? there are x, y",
        ),
        ({"region": {"x": (1, 0)}}, r"region: 'x' needs the lowest and the highest.* got \(1, 0\)"),
        ({"region": {"x": (0, np.inf)}}, r"region\['x'\] must be two finite numbers"),
        ({"region": {"x": (np.nan, 1)}}, r"region\['x'\] must be two finite numbers"),
        ({"region": {"x": 3.0}}, r"region\['x'\] must be two finite numbers"),
        ({"region": {"x": ("low", "high")}}, r"region\['x'\] must be two finite numbers"),
        ({"states": [[0.4, -0.6, 0.1]]}, r"states must be finite numbers of shape \(k, 4\)"),
        ({"states": [0.48, -0.64, 0, 0]}, r"states must be finite numbers of shape \(k, 4\)"),
        ({"states": np.zeros((0, 4))}, r"states must be finite numbers of shape \(k, 4\)"),
        ({"states": [[np.nan] * 4]}, "states must be finite real numbers"),
        ({"states": "all"}, "states must be finite real numbers"),
        ({"states": [[0.48, -0.64, 0, 0]], "region": {}}, "give a region or states, not both"),
        ({"times": [0, 1]}, "a reference needs times"),
        ({"start": [0.48, -0.64, 0, 0]}, "start is where a reference begins, and there is none"),
        ({"reference": lambda t: np.zeros(3)}, "a reference needs times"),
        ({"count": -1}, "count must be a whole number from 1, got -1"),
        ({"count": 2.5}, r"count must be a whole number, got 2\.5"),
    ],
)
def test_arguments_that_make_no_sense(options, message):
    with pytest.raises(ModelError, match=f"(pendulum|analyze): {message}"):
        analyze(PROBLEMS["pendulum"]().system, **options)


def test_given_states():
    problem = PROBLEMS["pendulum"]()
    random = np.random.default_rng(0)
    states = np.array([problem.consistent(random) for _ in range(4)])
    analysis = analyze(problem.system, states=states)
    np.testing.assert_allclose(analysis.states, states, atol=1e-12)
    # These alone, nothing between them.
    least = min(problem.known(x).control_matrix.item() for x in states)
    assert analysis.assumptions[4].margin.singular_value == pytest.approx(least, rel=1e-10)
    assert analysis.where == "4 consistent states as given"


def test_a_zero_at_the_given_state_alone_is_no_degree():
    """Ball and beam: the control acts on derivative 3 of the position, but not at rest."""
    beam = DaeSystem.from_functions(
        ["r", "vr", "th", "w"],
        f=lambda x: [x[1], x[0] * x[3] ** 2 - 9.81 * ca.sin(x[2]), x[3], 0],
        h=lambda x: [0, 0, 0, 1],
        l=lambda x: [x[0]],
    )
    analysis = analyze(beam, states=[[0.0, 0.0, 0.0, 0.0]])
    assert findings(analysis)[3] == NO
    assert "derivative 3" in analysis.assumptions[3].reason
    assert analysis.output_degrees is None


def test_a_region_for_one_state_leaves_the_others_near_the_nominal_one():
    """The pendulum's B vanishes at x = 1, far from where states are drawn."""
    pendulum = PROBLEMS["pendulum"]().system
    assert not analyze(pendulum).problems
    assert not analyze(pendulum, region={"vx": (-1.0, 1.0)}).problems


def test_a_region_is_covered_whatever_the_constraints_move():
    """A point on a circle: B = -y vanishes at (-1, 0) and (1, 0)."""
    circle = DaeSystem.from_functions(
        ["x", "y"],
        f=lambda s: [0, 0],
        g=lambda s: [2 * s[0], 2 * s[1]],
        h=lambda s: [-s[1], s[0]],
        k=lambda s: [s[0] ** 2 + s[1] ** 2 - 1],
        l=lambda s: [s[0]],
        m=lambda s: [[0]],
        nominal_state=[0.6, 0.8],
    )
    analysis = analyze(circle, region={"x": (-1.1, 1.1)})
    assert np.ptp(analysis.states[:, 0]) > 1.8
    assert NO in findings(analysis)


def test_consistency_does_not_depend_on_units():
    """A pendulum of a micrometre that is 30 % off N*, and one of 1e9 m that is on it."""
    with pytest.raises(InconsistentStateError, match=r"states\[0\] is not consistent"):
        analyze(hanging_pendulum(1e-6), states=[[0.0, -1.3e-6, 0.0, 0.0]])
    on = [1e9 * np.sin(0.3), -1e9 * np.cos(0.3), 0.0, 0.0]
    assert analyze(hanging_pendulum(1e9), states=[on]).index == 3


def test_redundant_constraints_have_no_index():
    """k = (x - 1, 2 x - 2): the dimension of N* is 2, and not n - r_1 - r_2 = 0."""
    system = DaeSystem.from_functions(
        ["x", "y", "vx", "vy"],
        f=lambda s: [s[2], s[3], 0, 0],
        g=lambda s: [[0, 0], [0, 0], [1, 2], [0, 0]],
        h=lambda s: [0, 0, 0, 1],
        k=lambda s: [s[0] - 1, 2 * s[0] - 2],
        l=lambda s: [s[1]],
        m=lambda s: [[0, 0]],
        nominal_state=[1, 0, 0, 0],
    )
    analysis = analyze(system)
    assert findings(analysis)[1] == NO
    assert analysis.constraint_degrees == (2, 2)
    assert (analysis.index, analysis.manifold_dimension) == (None, None)
    assert "index ?, N* of dimension ?" in str(analysis)


def test_a_mass_matrix_must_be_positive_definite_at_every_state():
    x = ca.SX.sym("x", 2)
    system = DaeSystem(
        state=x,
        f=[0, 0],
        g=[],
        h=[[1, 0], [0, 1]],
        k=[],
        l=[x[0], x[1]],
        m=[],
        mass_matrix=ca.diag(ca.vertcat(1, 1 - 4 * x[0])),
    )
    assert not analyze(system).problems
    with pytest.raises(ModelError, match="not symmetric and positive definite at x ="):
        analyze(system, region={"x0": (-1.0, 1.0)})


def test_given_states_must_be_consistent():
    states = [[0.48, -0.64, 0.0, 0.0], [0.48, -0.64, 0.1, 0.0]]
    with pytest.raises(InconsistentStateError, match=r"states\[1\] is not consistent: y0' = 0.048"):
        analyze(PROBLEMS["pendulum"]().system, states=states)


def test_given_states_must_be_in_the_domain():
    tank = system_of(1, f=lambda x: -ca.sqrt(x), h=lambda x: 1, l=lambda x: x, nominal_state=[0.5])
    with pytest.raises(ModelError, match=r"states\[1\] is outside the domain"):
        analyze(tank, states=[[0.5], [-0.5]])


def test_systems_that_are_not_well_formed():
    pendulum = PROBLEMS["pendulum"]().system
    with pytest.raises(InconsistentStateError, match="no consistent state found near"):
        analyze(changed(pendulum, k=pendulum.k + 1.0))  # x^2 + y^2 = 0.64 - 2


def circle() -> Manifold:
    x = ca.SX.sym("x", 2)
    system = DaeSystem(
        state=x,
        f=[0, 0],
        g=[1, 0],
        h=[0, 1],
        k=ca.sumsqr(x) - 1,
        l=x[1],
        m=[0],
        name="circle",
    )
    return Manifold(system, [[system.k]])


def test_downhill_along_the_manifold():
    """|x - (0.6, 0.8)|, on the unit circle, from the other side: to the zero, or to the edge."""
    goal = np.array([0.6, 0.8])

    def distance(state):
        offset = state - goal
        size = float(np.linalg.norm(offset))
        return size, offset / size if size else offset

    start = np.array([-0.8, 0.6])
    for high, end in ((2.0, goal), (0.28, np.array([0.28, 0.96]))):
        region = Region(np.array([-2.0, -2.0]), np.array([high, 2.0]))
        found = ConsistentRegion(circle(), region).descend(distance, start)
        assert np.linalg.norm(found) == pytest.approx(1.0, abs=1e-12)
        np.testing.assert_allclose(found, end, atol=1e-5)


# ---- along a reference


def test_margins_along_a_reference():
    """A = L^2/m all along; B = y^2/(m L^2) is least where the pendulum is highest."""

    def reference(t):
        return np.array([0.45 + 0.2 * np.sin(t), 0.2 * np.cos(t), -0.2 * np.sin(t)])

    times = np.linspace(0.0, 3.0, 301)
    analysis = analyze(PROBLEMS["pendulum"]().system, reference=reference, times=times)
    motion = analysis.motion
    assert motion.ending is None
    worst = int(np.argmin(motion.control_margins))
    # The grid has a point within 5 ms of the top, where the slope is zero.
    assert times[worst] == pytest.approx(np.pi / 2, abs=0.005)
    assert motion.control_margins[worst] == pytest.approx((0.64 - 0.65**2) / 1.28, rel=1e-4)
    assert re.search(r"B\(x\) +0\.1699 +1\.57 s", str(analysis))
    assert re.search(r"A\(x\) +0\.32 +", str(analysis))
    found = analysis.to_dict()["reference"]
    assert found["margins"]["B(x)"] == {
        "smallest": float(motion.control_margins[worst]),
        "time": times[worst],
    }


def test_a_reference_that_leaves_what_can_be_reached():
    """x = 0.45 + t/2 comes to the rod's length 0.8 at t = 0.7, where B = y^2/(m L^2) vanishes."""
    analysis = analyze(
        PROBLEMS["pendulum"]().system,
        reference=lambda t: np.array([0.45 + t / 2, 0.5, 0.0]),
        times=np.linspace(0.0, 2.0, 201),
    )
    assert analysis.motion.ending.time == pytest.approx(0.7, abs=1e-3)
    assert analysis.problems == (str(analysis.motion.ending),)
    text = " ".join(str(analysis).split())
    assert str(analysis.motion.ending) in text
    assert "along the reference, 0 to 0." in text


def test_a_reference_of_a_wrong_size():
    with pytest.raises(ModelError, match="reference must have size 3"):
        analyze(PROBLEMS["pendulum"]().system, reference=lambda t: np.zeros(2), times=[0.0, 1.0])


# ---- printed


@pytest.mark.slow
def test_text_is_aligned_and_not_too_wide(problem):
    lines = str(analyze(problem.system, count=3)).splitlines()
    assert max(map(len, lines)) <= 100
    assert all(line == line.rstrip() for line in lines)
    start = next(i for i, line in enumerate(lines) if line.startswith("assumption"))
    rows = lines[start : start + 8]
    for row in rows[1:]:
        assert row[rows[0].index("finding") - 1] == " "
        assert row[rows[0].index("finding") :].split()[0] in map(str, Finding)


@pytest.mark.slow
def test_markdown_has_the_same_words(problem):
    analysis = analyze(problem.system, count=3)
    markdown = analysis._repr_markdown_()
    assert markdown == analysis.to_markdown()
    words = re.findall(r"[^\s|]+", re.sub(r"(:--|--:)", "", markdown.replace("\\|", "|")))
    assert words == str(analysis).replace("|", " ").split()
    tables = [block for block in markdown.split("\n\n") if block.startswith("|")]
    for table in tables:
        assert len({line.count("|") for line in table.splitlines()}) == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", [*PROBLEMS, "redundant"])
def test_the_dictionary_is_json(name):
    twice = redundant(lambda x: [x[0], x[0]])
    system = twice if name == "redundant" else PROBLEMS[name]().system
    analysis = analyze(system, count=3)
    found = json.loads(json.dumps(analysis.to_dict(), allow_nan=False))
    assert found == analysis.to_dict()
    names = [signal.name for signal in system.constraint_output_signals]
    assert found["constraint_degrees"] == dict(zip(names, analysis.constraint_degrees, strict=True))
    assert found["index"] == analysis.index
    assert [a["finding"] for a in found["assumptions"]] == findings(analysis)
    assert found["problems"] == list(analysis.problems)
    margin = found["assumptions"][1]["margin"]
    if margin:
        assert margin["relative"] == analysis.assumptions[1].margin.relative
        assert len(margin["state"]) == system.num_states


def rising(changes=lambda t, wanted: wanted):
    """R(t) of z = 0.3 sin 2t for degree 2, and what a test changes."""
    size, w = 0.3, 2.0
    return lambda t: changes(
        t,
        np.array([size * np.sin(w * t), size * w * np.cos(w * t), -size * w**2 * np.sin(w * t)]),
    )


@pytest.mark.slow
@pytest.mark.parametrize("length", [1e-3, 5.0, 1e4])
def test_references_that_agree_with_themselves(length):
    """Over any time: the differences of a slow and of a fast reference are within the tolerance."""
    system = double_integrator()
    for rate in (1.0, 20.0):
        time = 5.0 / length

        def reference(t, rate=rate, time=time):
            return rising()(rate * time * t) * (rate * time) ** np.arange(3)

        motion = analyze(system, reference=reference, times=np.linspace(0.0, length, 11)).motion
        assert motion.ending is None
        assert motion.states[-1, 0] == pytest.approx(reference(length)[0], rel=1e-9)


def test_a_highest_derivative_may_jump():
    """r'' = 1, then -1: the motion is that of r, and r' has a kink."""

    def reference(t):
        s = t - 1.0
        return np.array([s * abs(s) / 2 * -1 + s, -abs(s) + 1.0, -np.sign(s)])

    times = np.linspace(0.0, 2.0, 21)
    assert analyze(double_integrator(), reference=reference, times=times).problems == ()


CONTRADICTIONS = {
    "derivatives left out": (lambda t, r: r * [1, 0, 0], "q0' = 0 at .* q0 changes by"),
    "a factor of 1 %": (lambda t, r: r * [1, 1.01, 1.01], "q0' = .* but q0 changes by"),
    "a wrong sign": (lambda t, r: r * [1, 1, -1], "q0'' = .* but q0' changes by"),
}


@pytest.mark.parametrize("what", CONTRADICTIONS)
def test_references_that_contradict_themselves_are_refused(what):
    changes, message = CONTRADICTIONS[what]
    system = double_integrator(output_signals=["q0"])
    with pytest.raises(ModelError, match=f"double integrator: the reference contra.* {message}"):
        analyze(system, reference=rising(changes), times=np.linspace(0.0, 5.0, 51))


BAD_ARGUMENTS = {
    "a list as region": ({"region": [(0, 1)]}, "region must be a dictionary or None"),
    "text as seed": ({"seed": "a"}, "seed must be a whole number, got 'a'"),
    "no function": ({"reference": [0.0] * 3, "times": [0, 1]}, "reference must be a function"),
    "no value": ({"reference": lambda t: None, "times": [0, 1]}, "must have size 3 .* got None"),
    "text": ({"reference": lambda t: "a", "times": [0, 1]}, r"reference\(0\) must be real numbers"),
}


@pytest.mark.parametrize("what", BAD_ARGUMENTS)
def test_arguments_of_a_wrong_kind_are_refused(what):
    arguments, message = BAD_ARGUMENTS[what]
    with pytest.raises(ModelError, match=message):
        analyze(double_integrator(), **arguments)


def test_what_is_no_system_is_refused():
    with pytest.raises(ModelError, match="analyze: system must be a DaeSystem, got None"):
        analyze(None)


def test_one_line_at_the_prompt():
    assert repr(analyze(double_integrator())) == "Analysis('double integrator': no problem found)"
    constant = double_integrator(l=lambda x: 3.0)
    assert repr(analyze(constant)) == "Analysis('double integrator': 1 problem)"


def test_a_matrix_that_is_constant_on_the_manifold():
    """c1 + c2 = 1 is kept by v, which acts by -(c1 + c2)."""
    analysis = analyze(
        system_of(
            3,
            f=lambda x: [1 - x[0] * x[2], x[0] * x[2], -x[2]],
            g=lambda x: [-x[0], -x[1], 0],
            h=lambda x: [0, 0, 1],
            k=lambda x: [x[0] + x[1] - 1],
            l=lambda x: [x[2]],
            m=lambda x: [[0]],
            nominal_state=[0.6, 0.4, 1.0],
        )
    )
    assert "A(x) is the same at all examined states." in str(analysis)
    assert "B(x) is the same at all states." in str(analysis)
