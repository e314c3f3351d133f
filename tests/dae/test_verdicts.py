"""Verdicts at rest: by eigenvalues, at what is an equilibrium; everything else is not decided."""

import casadi as ca
import numpy as np
import pytest
from runs import some

from drake_dae.dae import DaeSystem, Verdict, ZeroDynamics
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


def test_an_equilibrium_inside_a_limit_cycle_is_unstable_and_the_cycle_is_not_judged():
    """The oscillator of FitzHugh and Nagumo: v' = v - v^3/3 - w + 0.5, w' = (v + 0.7 - 0.8 w)/12.5.

    Its only equilibrium is an unstable focus; the eigenvalues follow from trace and determinant.
    """
    system = DaeSystem.from_functions(
        ["z", "v", "w"],
        f=lambda x: [0, x[1] - x[1] ** 3 / 3 - x[2] + 0.5, (x[1] + 0.7 - 0.8 * x[2]) / 12.5],
        h=lambda x: [1, 0, 0],
        l=lambda x: x[0],
        nominal_state=[0.0, 1.0, 0.5],
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
    guesses = random.uniform(-3.0, 60.0, (6, 2 + others))
    assert not len(dynamics.equilibria(guesses, outputs=[0.0]))
    assert dynamics.stability().verdict is not Verdict.STABLE


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
