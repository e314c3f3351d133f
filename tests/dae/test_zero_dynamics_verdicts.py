"""What the zero dynamics are said to be: bounded only what returns, at rest only what is."""

import casadi as ca
import numpy as np
import pytest
from runs import some
from scipy.integrate import solve_ivp

from drake_dae import analyze
from drake_dae.analysis.findings import Finding
from drake_dae.dae.system.system import DaeSystem
from drake_dae.dae.zero_dynamics.stability import Verdict
from drake_dae.dae.zero_dynamics.zero_dynamics import ZeroDynamics
from drake_dae.errors import InconsistentStateError


def beside(rates, count, start=0.1):
    """z' = u, and internal states with given rates, which are functions of these and of z."""
    return DaeSystem.from_functions(
        ["z", *[f"s{i}" for i in range(count)]],
        f=lambda x: [0, *rates(*ca.vertsplit(x)[1:], x[0])],
        h=lambda x: [1] + [0] * count,
        l=lambda x: x[0],
        nominal_state=[0.0, *[start] * count],
    )


def van_der_pol(a, b, strength=1.0):
    return [b, strength * (1 - a * a) * b - a]


# Bounded.

NOT_BOUNDED = {
    "a drift": (lambda a, b, z: [b, 1 - b], 2),
    "a drift that waves": (lambda a, b, z: [1 + 0.5 * ca.sin(b), -b + ca.sin(a)], 2),
    "a rotor": (lambda a, b, z: [b, 1 - b + 0.5 * ca.cos(a)], 2),
    "a cycle that drives another state": (lambda a, b, c, z: [*van_der_pol(a, b), a * a], 3),
    "slowly": (lambda a, b, c, z: [*van_der_pol(a, b), 0.02 * a * a], 3),
    "to infinity": (lambda a, b, z: [ca.exp(-a), -b], 2),
    "slowly to infinity": (lambda a, b, z: [1 / (1 + a * a), -b + ca.sin(a)], 2),
}
"""Rates of internal states that draw their neighbours to them, and how many there are."""


@pytest.mark.slow
@pytest.mark.parametrize("name", some(NOT_BOUNDED))
def test_what_is_not_seen_to_return_is_not_called_bounded(name):
    told = ZeroDynamics(beside(*NOT_BOUNDED[name])).stability()
    assert told.verdict is Verdict.UNDECIDED


@pytest.mark.slow
@pytest.mark.parametrize("rate", some([1e-5, 0.3]))
def test_a_cycle_beside_something_that_grows_is_unstable(rate):
    """However slowly: the multiplier of the cycle is exp(rate times its period)."""
    system = beside(lambda a, b, c, z: [*van_der_pol(a, b), rate * c], 3)
    told = ZeroDynamics(system).stability()
    assert told.verdict is Verdict.UNSTABLE
    if rate < 0.1:  # Else c grows out of sight before the cycle is reached.
        assert "unstable periodic motion" in told.reason
        multiplier = float(told.reason.split("largest multiplier ")[1].rstrip(")"))
        assert multiplier == pytest.approx(np.exp(6.663287 * rate), rel=2e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("strength", "decay"), some([(0.3, None), (5.0, None), (1.0, 0.01)]))
def test_a_limit_cycle_is_shown_by_its_return(strength, decay):
    """The period against SciPy, between two crossings after 100 s; the multiplier against that of
    the divergence, exp of the integral of e (1 - a^2)."""

    def oscillation(a, b, *rest):
        return [*van_der_pol(a, b, strength), *(-decay * c for c in rest[:-1])]

    told = ZeroDynamics(beside(oscillation, 2 if decay is None else 3)).stability()
    assert told.verdict is Verdict.BOUNDED
    period, multiplier = (
        float(told.reason.split(word)[1].split(end)[0])
        for word, end in (("(period ", " s"), ("largest multiplier ", ")"))
    )

    def rate(t, x):
        return [*van_der_pol(x[0], x[1], strength), strength * (1 - x[0] ** 2)]

    def crosses(t, x):
        return x[0]

    crosses.direction = 1
    truth = solve_ivp(
        rate, (0.0, 100.0), [0.1, 0.1, 0.0], method="LSODA", rtol=1e-11, atol=1e-11, events=crosses
    )
    assert period == pytest.approx(np.diff(truth.t_events[0])[-1], rel=1e-5)
    # Along a and b one multiplier is 1, and their product is the other.
    area = np.exp(np.diff(truth.y_events[0][:, 2])[-1])
    largest = max(area, 0.0 if decay is None else np.exp(-decay * period))
    assert multiplier == pytest.approx(largest, abs=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rates", "count"),
    some(
        [
            (lambda a, b, z: [b + z**2, 1 - b], 2),
            (lambda a, b, z: [b, 1 - b + 0.1 * z], 2),
            (lambda a, z: [0.2 + 0.1 * z - 1e-9 * a], 1),
        ]
    ),
)
def test_a_drift_along_a_periodic_reference_is_not_bounded(rates, count):
    dynamics = ZeroDynamics(beside(rates, count))

    def reference(t):
        return 0.5 * np.array([np.cos(2.0 * t), -2.0 * np.sin(2.0 * t)])

    motion = dynamics.motion(reference, np.linspace(0.0, 60.0, 61))
    told = dynamics.stability_along(reference, motion)
    assert told.verdict in (Verdict.UNDECIDED, Verdict.UNSTABLE)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("force", "count"), [(0.28, 2), pytest.param(0.65, 2, marks=pytest.mark.thorough)]
)
def test_a_motion_that_repeats_itself_after_several_periods_is_found(force, count):
    """Duffing's oscillator with two wells, s'' = -0.3 s' + s - s^3 + force cos 1.2 t.

    The periods are those of the literature (Jordan and Smith, Nonlinear Ordinary Differential
    Equations, 2007), and SciPy's.
    """
    period = 2.0 * np.pi / 1.2

    def reference(t):
        return force * np.array([np.cos(1.2 * t), -1.2 * np.sin(1.2 * t)])

    system = beside(lambda a, b, z: [b, -0.3 * b + a - a**3 + z], 2, start=1.0)
    dynamics = ZeroDynamics(system)
    motion = dynamics.motion(reference, period * np.arange(61))
    told = dynamics.stability_along(reference, motion)
    assert told.verdict in (Verdict.STABLE, Verdict.BOUNDED)
    if told.verdict is Verdict.STABLE:
        assert told.period == pytest.approx(count * period)
    else:
        assert f"limit cycle (period {count * period:.6g} s" in told.reason
    truth = solve_ivp(
        lambda t, x: [x[1], -0.3 * x[1] + x[0] - x[0] ** 3 + force * np.cos(1.2 * t)],
        (0.0, 150.0 * period),
        [1.0, 1.0],
        t_eval=period * np.arange(150 - count, 151),
        rtol=1e-8,
        atol=1e-8,
    ).y
    assert np.max(np.abs(truth[:, -1] - truth[:, 0])) < 1e-3
    assert all(np.max(np.abs(truth[:, -1] - truth[:, i])) > 1e-2 for i in range(1, count))


# At rest.

AT_INFINITY = {
    "exp": lambda a: ca.exp(-a),
    "logistic": lambda a: 1 / (1 + ca.exp(a)),
    "tanh": lambda a: 1 - ca.tanh(a),
    "bell": lambda a: ca.exp(-(a**2)),
    "arc tangent": lambda a: ca.pi / 2 - ca.atan(a),
    "small": lambda a: 1e-3 * ca.exp(-2 * a),
    "falling": lambda a: -1 / (1 + a**2),
}
"""Rates that fall to zero far away, and are zero nowhere."""


@pytest.mark.slow
@pytest.mark.parametrize("name", some(AT_INFINITY, of=3))
@pytest.mark.parametrize("others", some([0, 1, 2], of=3))
def test_what_only_falls_is_no_equilibrium(name, others):
    """Alone, beside a state that decays, and beside an oscillation that does."""
    rate = AT_INFINITY[name]
    more = [lambda *_: [], lambda a, b, z: [-b], lambda a, b, c, z: [c, -b - c]][others]
    dynamics = ZeroDynamics(beside(lambda *x: [rate(x[0]), *more(*x)], 1 + others))
    with pytest.raises(InconsistentStateError, match="state at rest"):
        dynamics.equilibrium([0.0])
    random = np.random.default_rng(0)
    # Beyond, doubles tell nothing of a bell.
    guesses = random.uniform(-3.0, 8.0 if name == "bell" else 30.0, (12, 2 + others))
    assert not len(dynamics.equilibria(guesses, outputs=[0.0]))
    assert dynamics.stability().verdict is not Verdict.STABLE


DEGENERATE = {
    "cubic": (lambda a: -(a**3), [0.0]),
    "fifth": (lambda a: -(a**5), [0.0]),
    "square": (lambda a: -(a**2), [0.0]),
    "elsewhere": (lambda a: -((a - 0.3) ** 3), [0.3]),
    "two": (lambda a: -((a + 1) ** 3) * (a - 2) ** 3, [-1.0, 2.0]),
    "one of each kind": (lambda a: -(a**3) * (a - 2), [0.0, 2.0]),
    "uneven": (lambda a: -(a**3) + 0.1 * a**4, [0.0, 10.0]),
}
"""Rates, and where they are zero."""


@pytest.mark.slow
@pytest.mark.parametrize("name", some(DEGENERATE, of=3))
@pytest.mark.parametrize("others", [0, pytest.param(1, marks=pytest.mark.thorough)])
def test_an_equilibrium_without_a_slope_is_one(name, others):
    """However many searches end near it, and its linearization decides nothing."""
    rate, places = DEGENERATE[name]
    more = [lambda *_: [], lambda a, b, z: [-b]][others]
    dynamics = ZeroDynamics(beside(lambda *x: [rate(x[0]), *more(*x)], 1 + others))
    random = np.random.default_rng(0)
    guesses = np.zeros((25, 2 + others))
    guesses[:, 1:] = random.uniform(-3.0, 12.0 if name == "uneven" else 3.0, (25, 1 + others))
    found = dynamics.equilibria(guesses, outputs=[0.0])
    # A rate of 1e-8 is rest: of a^5 that is at 0.025.
    np.testing.assert_allclose(np.sort(found[:, 1]), places, rtol=0, atol=0.03)
    for state in found:
        told = dynamics.stability(state)
        slope = np.diff([float(ca.evalf(rate(ca.DM(state[1] + d)))) for d in (-0.05, 0.05)])
        steep = abs(slope[0]) > 0.01
        assert (told.verdict is Verdict.UNDECIDED) is not steep


@pytest.mark.slow
@pytest.mark.parametrize("rate", some([1e-9, 1e-6, 0.3, 1e6], of=3))
@pytest.mark.parametrize("others", [0, 1])
def test_slow_and_fast_states_have_one_equilibrium(rate, others):
    more = [lambda *_: [], lambda a, b, z: [-b + a]][others]
    system = beside(lambda *x: [-rate * (x[0] - 0.2), *more(*x)], 1 + others)
    told = analyze(system)
    assert [one.verdict for one in told.equilibria] == [Verdict.STABLE]
    assert told.zero_dynamics.state[1] == pytest.approx(0.2, abs=1e-6)


DEFECTIVE = {
    "two": [[-0.1, 1.0], [0.0, -0.1]],
    "two of 1e-3": [[-1e-3, 1.0], [0.0, -1e-3]],
    "three": [[-0.1, 1.0, 0.0], [0.0, -0.1, 1.0], [0.0, 0.0, -0.1]],
    "four": -0.5 * np.eye(4) + np.diag([1.0] * 3, 1),
    "spirals": np.kron(np.eye(2), [[-0.1, 1.0], [-1.0, -0.1]]) + np.diag([1.0, 1.0], 2),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", some(DEFECTIVE))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_defective_matrix_is_decided(name, sign):
    """Its eigenvalues are known to the root of round-off alone, and far from the axis."""
    matrix = np.array(DEFECTIVE[name], dtype=float)
    if sign < 0.0:
        matrix = -matrix.T
    # In coordinates in which it is not triangular.
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=matrix.shape))[0]
    mixed = ca.DM(turn @ matrix @ turn.T)
    system = beside(
        lambda *x: ca.vertsplit(ca.mtimes(mixed, ca.vertcat(*x[:-1]))), len(matrix), 0.0
    )
    told = ZeroDynamics(system).stability()
    assert told.verdict is (Verdict.STABLE if sign > 0.0 else Verdict.UNSTABLE)


def test_several_equilibria_of_a_slow_state_are_several():
    dynamics = ZeroDynamics(beside(lambda a, z: [1e-9 * ca.sin(a)], 1))
    guesses = np.array([[0.0, s] for s in (0.1, 3.0, 6.0, -3.3, 3.2)])
    found = np.sort(dynamics.equilibria(guesses, outputs=[0.0])[:, 1])
    np.testing.assert_allclose(found, [-np.pi, 0.0, np.pi, 2 * np.pi], rtol=0, atol=1e-6)


# In a region.


@pytest.mark.slow
@pytest.mark.parametrize(
    ("region", "inside"),
    some([((-2.0, 2.0), 1), ((0.5, 1.5), 0), ((-1.6, -0.5), 0), (None, None)]),
)
def test_an_unstable_equilibrium_inside_the_region_is_a_finding(region, inside):
    """s'' = s - s^3 - s': unstable at 0, and stable at 1 and -1, from which it begins."""
    system = DaeSystem.from_functions(
        ["z", "s", "w"],
        f=lambda x: [0, x[2], x[1] - x[1] ** 3 - x[2]],
        h=lambda x: [1, 0, 0],
        l=lambda x: x[0],
        nominal_state=[0.0, 0.95, 0.0],
    )
    told = analyze(system, region=None if region is None else {"s": region})
    assert told.zero_dynamics.verdict is Verdict.STABLE
    if inside is None:
        assert not told.problems
        return
    assert len(told.problems) == inside
    (row,) = (line for line in str(told).splitlines() if line.startswith("2.2 "))
    assert (str(Finding.VIOLATED) in row) == bool(inside)
    if inside:
        assert told.problems[0].startswith("Assumption 2.2: inside the region, at rest at z=")
        assert "s=" in told.problems[0]
        assert "non-minimum phase" in told.problems[0]
