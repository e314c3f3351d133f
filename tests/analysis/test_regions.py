"""Regions and given states at which a system is analyzed."""

import casadi as ca
import numpy as np
import pytest
from problems import (
    PROBLEMS,
    changed,
    hanging_pendulum,
    system_of,
)
from problems.found import NO, findings

from drake_dae.analysis.analyze import analyze
from drake_dae.dae import DaeSystem, Manifold, Region
from drake_dae.dae.samples import ConsistentRegion
from drake_dae.errors import InconsistentStateError, ModelError


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
    with pytest.raises(InconsistentStateError, match=r"x in \["):
        analyze(PROBLEMS["pendulum"]().system, region=region)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"region": {"vxx": (0, 1)}},
            r"region: .*'vxx'.*'vx'",
        ),
        ({"region": {"x": (1, 0)}}, r"region: 'x'.*\(1, 0\)"),
        ({"region": {"x": (0, np.inf)}}, r"region\['x'\]"),
        ({"region": {"x": ("low", "high")}}, r"region\['x'\]"),
        ({"states": [[0.4, -0.6, 0.1]]}, r"states.*\(k, 4\)"),
        ({"states": [[np.nan] * 4]}, "states"),
        ({"states": "all"}, "states"),
        ({"states": [[0.48, -0.64, 0, 0]], "region": {}}, r"region .*states"),
        ({"times": [0, 1]}, "times"),
        ({"start": [0.48, -0.64, 0, 0]}, "start"),
        ({"reference": lambda t: np.zeros(3)}, "times"),
        ({"count": -1}, r"count.*-1"),
        ({"count": 2.5}, r"count.*2\.5"),
    ],
)
def test_arguments_that_make_no_sense(options, message):
    with pytest.raises(ModelError, match=rf"(pendulum|analyze): .*{message}"):
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
    with pytest.raises(InconsistentStateError, match=r"states\[0\]"):
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
    with pytest.raises(ModelError, match="x ="):
        analyze(system, region={"x0": (-1.0, 1.0)})


def test_given_states_must_be_consistent():
    states = [[0.48, -0.64, 0.0, 0.0], [0.48, -0.64, 0.1, 0.0]]
    with pytest.raises(InconsistentStateError, match=r"states\[1\].*y0' = 0\.048"):
        analyze(PROBLEMS["pendulum"]().system, states=states)


def test_given_states_must_be_in_the_domain():
    tank = system_of(1, f=lambda x: -ca.sqrt(x), h=lambda x: 1, l=lambda x: x, nominal_state=[0.5])
    with pytest.raises(ModelError, match=r"states\[1\]"):
        analyze(tank, states=[[0.5], [-0.5]])


def test_systems_that_are_not_well_formed():
    pendulum = PROBLEMS["pendulum"]().system
    with pytest.raises(InconsistentStateError, match="pendulum"):
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
