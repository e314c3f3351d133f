"""Verdicts at rest: by eigenvalues, at what is an equilibrium; everything else is not decided."""

import casadi as ca
import numpy as np
import pytest
from runs import some

from drake_dae import DaePlant, analyze, make_closed_loop
from drake_dae.dae import DaeSystem, TrackingLaw, Verdict, ZeroDynamics, poles
from drake_dae.errors import InconsistentStateError, ModelError, NonMinimumPhaseWarning


def beside(rates, count, start=0.1):
    """z' = u, and internal states with given rates, which are functions of these and of z."""
    return DaeSystem.from_functions(
        ["z", *[f"s{i}" for i in range(count)]],
        f=lambda x: [0, *rates(*ca.vertsplit(x)[1:], x[0])],
        h=lambda x: [1] + [0] * count,
        l=lambda x: x[0],
        nominal_state=[0.0, *[start] * count],
    )


def double_pendulum(first: float, second: float) -> DaeSystem:
    """It stands on a cart that is held, with joint friction in N m s; rods of 1 m with 1 kg.

    M(a, b) (a'', b'') + c + d = gravity, with the absolute angles from upright.
    """

    def rates(a, b, da, db, z):
        c, s = ca.cos(a - b), ca.sin(a - b)
        mass = ca.vertcat(ca.horzcat(2, c), ca.horzcat(c, 1))
        force = ca.vertcat(
            2 * 9.81 * ca.sin(a) - s * db**2 - first * da - second * (da - db),
            9.81 * ca.sin(b) + s * da**2 - second * (db - da),
        )
        return [da, db, *ca.vertsplit(ca.solve(mass, force))]

    return beside(rates, 4, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("friction", [(0.1, 0.0), (1.0, 1.0), (0.5, 4.0), (5.0, 0.2), (10.0, 10.0)])
def test_a_standing_double_pendulum_is_unstable(friction):
    """M s^2 + D s - G, linearized by hand; friction slows its fall, and does not stop it."""
    first, second = friction
    mass, weight = np.array([[2.0, 1.0], [1.0, 1.0]]), 9.81 * np.diag([2.0, 1.0])
    damping = np.array([[first + second, -second], [-second, second]])
    inverse = np.linalg.inv(mass)
    matrix = np.block([[np.zeros((2, 2)), np.eye(2)], [inverse @ weight, -inverse @ damping]])
    told = analyze(double_pendulum(*friction))
    found = told.zero_dynamics
    expected = np.sort_complex(np.linalg.eigvals(matrix) + 0j)
    np.testing.assert_allclose(np.sort_complex(found.eigenvalues), expected, rtol=1e-8, atol=1e-9)
    assert np.count_nonzero(expected.real > 0) == 2
    assert found.verdict is Verdict.UNSTABLE
    assert len(told.problems) == 1


@pytest.mark.slow
def test_the_loop_warns_of_an_unstable_equilibrium():
    system = double_pendulum(1.0, 1.0)
    law = TrackingLaw(system, poles(-2.0))
    with pytest.warns(NonMinimumPhaseWarning):
        make_closed_loop(DaePlant(law.system, structure=law.structure), law, {"z0": 0.0})


@pytest.mark.parametrize("start", [(0.1, 0.1), (1.0, 0.5)])
def test_an_equilibrium_inside_a_limit_cycle_is_unstable_and_the_cycle_is_not_judged(start):
    """The oscillator of FitzHugh and Nagumo: v' = v - v^3/3 - w + 0.5, w' = (v + 0.7 - 0.8 w)/12.5.

    Its only equilibrium is an unstable focus; the eigenvalues follow from trace and determinant.
    """
    system = DaeSystem.from_functions(
        ["z", "v", "w"],
        f=lambda x: [
            0,
            x[1] - x[1] ** 3 / 3 - x[2] + 0.5,
            (x[1] + 0.7 - 0.8 * x[2]) / 12.5,
        ],
        h=lambda x: [1, 0, 0],
        l=lambda x: x[0],
        nominal_state=[0.0, *start],
    )
    (v,) = (
        r.real for r in np.roots([-1 / 3, 0, 1 - 1 / 0.8, 0.5 - 0.7 / 0.8]) if abs(r.imag) < 1e-9
    )
    told = ZeroDynamics(system).stability()
    expected = np.roots([1.0, v**2 - 1 + 0.064, 0.08 - 0.064 * (1 - v**2)])
    np.testing.assert_allclose(
        np.sort_complex(told.eigenvalues), np.sort_complex(expected), rtol=1e-7
    )
    assert told.verdict is Verdict.UNSTABLE
    assert told.state[1] == pytest.approx(v, abs=1e-9)


NO_REST = {
    "a drift": (lambda a, b, z: [b, 1 - b], 2),
    "a drift that waves": (lambda a, b, z: [1 + 0.5 * ca.sin(b), -b + ca.sin(a)], 2),
    "a rotor": (lambda a, b, z: [b, 1 - b + 0.5 * ca.cos(a)], 2),
    "to infinity": (lambda a, b, z: [ca.exp(-a), -b], 2),
    "slowly to infinity": (lambda a, b, z: [1 / (1 + a * a), -b + ca.sin(a)], 2),
    "within a finite time": (lambda a, z: [1 + a**2], 1),
}
"""Rates of internal states that rest nowhere, and how many there are."""


@pytest.mark.slow
@pytest.mark.parametrize("name", some(NO_REST))
def test_what_rests_nowhere_is_not_decided(name):
    told = ZeroDynamics(beside(*NO_REST[name])).stability()
    assert told.verdict is Verdict.UNDECIDED


def test_a_pole_on_a_cart_that_rests_anywhere_is_unstable():
    """The Jacobian is singular, since the second cart may be anywhere; its pole falls over."""
    told = ZeroDynamics(
        beside(lambda s, v, a, w, z: [v, -v, w, 9.81 * ca.sin(a)], 4, 0.0)
    ).stability()
    assert told.verdict is Verdict.UNSTABLE
    np.testing.assert_allclose(
        np.sort(told.eigenvalues.real), [-(9.81**0.5), -1.0, 0.0, 9.81**0.5], atol=1e-9
    )
    hanging = beside(lambda s, v, a, w, z: [v, -v, w, -9.81 * ca.sin(a) - w], 4, 0.0)
    assert ZeroDynamics(hanging).stability().verdict is Verdict.UNDECIDED


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
    with pytest.raises(InconsistentStateError, match="z0 = 0"):
        dynamics.equilibrium([0.0])
    random = np.random.default_rng(0)
    guesses = random.uniform(-3.0, 60.0, (12, 2 + others))
    assert not len(dynamics.equilibria(guesses, outputs=[0.0]))
    assert dynamics.stability().verdict is not Verdict.STABLE


DEGENERATE = {
    "cubic": (lambda a: -(a**3), []),
    "fifth": (lambda a: -(a**5), []),
    "square": (lambda a: -(a**2), []),
    "elsewhere": (lambda a: -((a - 0.3) ** 3), []),
    "one of each kind": (lambda a: -(a**3) * (a - 2), [2.0]),
    "uneven": (lambda a: -(a**3) + 0.1 * a**4, [10.0]),
}
"""Rates, and where they are zero with a slope."""


@pytest.mark.slow
@pytest.mark.parametrize("name", some(DEGENERATE, of=3))
@pytest.mark.parametrize("others", [0, pytest.param(1, marks=pytest.mark.thorough)])
def test_a_zero_without_a_slope_is_no_equilibrium(name, others):
    rate, places = DEGENERATE[name]
    more = [lambda *_: [], lambda a, b, z: [-b]][others]
    dynamics = ZeroDynamics(beside(lambda *x: [rate(x[0]), *more(*x)], 1 + others))
    random = np.random.default_rng(0)
    guesses = np.zeros((25, 2 + others))
    guesses[:, 1:] = random.uniform(-3.0, 12.0 if name == "uneven" else 3.0, (25, 1 + others))
    found = dynamics.equilibria(guesses, outputs=[0.0])
    np.testing.assert_allclose(np.sort(found[:, 1]), places, rtol=0, atol=1e-6)
    # From near the other zero.
    assert dynamics.stability([0.0, *[0.01] * (1 + others)]).verdict is Verdict.UNDECIDED


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


@pytest.mark.slow
def test_several_equilibria():
    """s'' = s - s^3 - s': at rest at 0, with l^2 + l - 1, and at +-1, with l^2 + l + 2."""
    system = beside(lambda s, w, z: [w, s - s**3 - w], 2, 0.01)
    dynamics = ZeroDynamics(system)
    guesses = np.array([[0, s, 0] for s in (0.1, 0.9, -1.2, 1.1, 0.05)], dtype=float)
    found = dynamics.equilibria(guesses)
    np.testing.assert_allclose(np.sort(found[:, 1]), [-1.0, 0.0, 1.0], rtol=0, atol=1e-9)
    told = analyze(system, region={"s0": (-2.0, 2.0)})
    assert [one.verdict for one in told.equilibria] == [
        Verdict.UNSTABLE,
        Verdict.STABLE,
        Verdict.STABLE,
    ]
    np.testing.assert_allclose(
        sorted(one.state[1] for one in told.equilibria), [-1.0, 0.0, 1.0], rtol=0, atol=1e-9
    )
    with pytest.raises(ModelError, match="guesses"):
        dynamics.equilibria([0.0, 0.0, 0.0])


@pytest.mark.slow
@pytest.mark.parametrize("small", [-1e-3, 1e-3])
def test_eigenvalues_eleven_orders_apart_are_decided(small):
    """Triangular: s1' = -1e8 s1 + 3e4 s2, s2' = small s2."""
    system = DaeSystem.from_functions(
        3,
        f=lambda x: [0, -1e8 * x[1] + 3e4 * x[2], small * x[2]],
        h=lambda x: [1, 2, 3],
        l=lambda x: x[0],
    )
    found = ZeroDynamics(system).stability()
    values = sorted(found.eigenvalues.real)
    np.testing.assert_allclose(values, [-1e8, small], rtol=1e-9)
    assert found.verdict is (Verdict.STABLE if small < 0 else Verdict.UNSTABLE)


# In a region.
