"""What the problems claim to be, by routes that know nothing of the library."""

import casadi as ca
import numpy as np
import pytest
import scipy.linalg
from problems import PROBLEMS, Problem, hidden_normal_form
from runs import some

from drake_dae.dae.structure.structure import find_structure
from drake_dae.dae.system.system import DaeSystem
from drake_dae.dae.zero_dynamics.stability import Verdict
from drake_dae.dae.zero_dynamics.zero_dynamics import ZeroDynamics


def test_a_dozen_come_from_the_literature():
    sources = [make().source for make in PROBLEMS.values()]
    assert sum(bool(source) for source in sources) >= 12


def test_all_kinds_are_there():
    problems = [make() for make in PROBLEMS.values()]
    assert {problem.index for problem in problems} == {0, 2, 3, 4}
    constraints = {problem.constraint_degrees for problem in problems}
    assert {(), (1,), (1, 1), (2,), (2, 2), (3,), (1, 2)} <= constraints
    outputs = {degree for problem in problems for degree in problem.output_degrees}
    assert outputs == {0, 1, 2, 3, 4}
    assert {problem.minimum_phase for problem in problems} == {None, True, False}
    assert any(problem.zero_dynamics == 0 for problem in problems)


# ---- linear systems by matrix computations


Matrices = dict[str, np.ndarray]


def matrices(system: DaeSystem) -> Matrices:
    """F, G, H, K, L, M of a linear system."""
    x = system.state
    expressions = {
        "F": ca.jacobian(system.f, x),
        "G": system.g,
        "H": system.h,
        "K": ca.jacobian(system.k, x),
        "L": ca.jacobian(system.l, x),
        "M": system.m,
    }
    function = ca.Function(
        "m", [x, system.parameter_symbol], [ca.densify(e) for e in expressions.values()]
    )
    values = function(np.zeros(system.num_states), system.parameter_values)
    return {key: np.array(value) for key, value in zip(expressions, values, strict=True)}


def rank(matrix: np.ndarray) -> int:
    """Numbers of order 1 to 100: what is below 1e-8 of the largest is round-off."""
    return int(np.linalg.matrix_rank(matrix, tol=1e-8 * max(np.linalg.norm(matrix, 2), 1e-8)))


def kronecker_index(a: Matrices) -> int:
    """The nilpotency index of the pencil s E - P of (1), (2) in (x, v) with u = 0.

    (E, P) is brought to (N, I) on its infinite part by (P + c E)^-1 E, whose zero eigenvalue has
    chains of just this length (Dai, Singular Control Systems, 1989, chapter 1).
    """
    n, m = a["G"].shape
    e = scipy.linalg.block_diag(np.eye(n), np.zeros((m, m)))
    pencil = np.block([[a["F"], a["G"]], [a["K"], np.zeros((m, m))]])
    power = scaled = np.linalg.solve(pencil + 0.731 * e, e)
    index = 0 if m == 0 else 1
    while m and rank(power @ scaled) < rank(power):
        power, index = power @ scaled, index + 1
    return index


def invariant_zeros(a: Matrices, longest: int) -> np.ndarray:
    """Finite s where Rosenbrock's matrix of (1)-(3) from (v, u) to (y, z) loses rank.

    Args:
        a: The matrices.
        longest: Of the degrees r and mu.
    """
    n, m = a["G"].shape
    p = a["H"].shape[1]
    rosenbrock = np.block(
        [
            [a["F"], a["G"], a["H"]],
            [a["K"], np.zeros((m, m)), np.zeros((m, p))],
            [a["L"], a["M"], np.zeros((p, p))],
        ]
    )
    e = scipy.linalg.block_diag(np.eye(n), np.zeros((m + p, m + p)))
    # Turned around a regular point, finite zeros s are 1/(s - c) and infinite ones 0. These are in
    # chains of length degree + 1, which round-off of 1e-14 brings to the root of that order.
    shift = 0.731
    turned = np.linalg.eigvals(np.linalg.solve(rosenbrock - shift * e, e))
    finite = np.abs(turned) > 10.0 * 1e-14 ** (1.0 / (longest + 1))
    return np.sort_complex(shift + 1.0 / turned[finite])


def linear_system(seed: int) -> tuple[DaeSystem, tuple[int, ...], tuple[int, ...], np.ndarray]:
    """A linear normal form behind a change of basis and a state feedback.

    Returns:
        The system, r, mu, and the eigenvalues of its zero dynamics.
    """
    random = np.random.default_rng(seed)
    m, p, free = (int(random.integers(low, high)) for low, high in ((0, 3), (1, 3), (0, 3)))
    r = tuple(int(i) for i in random.integers(1, 4, m))
    mu = tuple(int(i) for i in random.integers(1, 4, p))
    n = sum(r) + sum(mu) + free
    f, g, h = np.zeros((n, n)), np.zeros((n, m)), np.zeros((n, p))
    heads, row = np.zeros((m + p, n)), 0
    inputs = np.linalg.qr(random.normal(size=(m + p, m + p)))[0]
    if m:  # A is regular.
        inputs[:m, :m] += 2.0 * np.eye(m)
    for i, degree in enumerate(r + mu):
        heads[i, row] = 1.0
        f[row : row + degree - 1, row + 1 : row + degree] = np.eye(degree - 1)
        row += degree
        f[row - 1] = random.normal(size=n)
        g[row - 1], h[row - 1] = inputs[i, :m], inputs[i, m:]
    f[row:] = random.normal(size=(free, n))
    zeros = np.linalg.eigvals(f[row:, row:])
    t = np.linalg.qr(random.normal(size=(n, n)))[0] @ np.diag(random.uniform(0.5, 2.0, n))
    back = np.linalg.inv(t)
    f = f + h @ random.normal(size=(p, n))
    x = ca.SX.sym("x", n)
    system = DaeSystem(
        state=x,
        f=(t @ f @ back) @ x,
        g=t @ g,
        h=t @ h,
        k=(heads[:m] @ back) @ x if m else [],
        l=(heads[m:] @ back) @ x,
        m=np.zeros((p, m)),
        name=f"linear {seed}",
    )
    return system, r, mu, np.sort_complex(zeros.astype(complex))


@pytest.mark.parametrize("name", ["circuit", "linear", "cart", "held_point"])
def test_linear_problems_by_matrices(name):
    problem = PROBLEMS[name]()
    a = matrices(problem.system)
    assert kronecker_index(a) == problem.index
    longest = max(problem.constraint_degrees + problem.output_degrees)
    assert len(invariant_zeros(a, longest)) == problem.zero_dynamics


@pytest.mark.slow
@pytest.mark.parametrize("seed", some(range(20), of=4))
def test_linear_systems_by_matrices(seed):
    """Degrees as built, index and zeros as the pencils have them, by the library and by SciPy."""
    system, r, mu, zeros = linear_system(seed)
    structure = find_structure(system)
    assert structure.constraint_degrees == r
    assert structure.output_degrees == mu
    assert structure.index == kronecker_index(matrices(system))
    found = invariant_zeros(matrices(system), max(r + mu))
    assert len(found) == structure.zero_dynamics_dimension == len(zeros)
    # What Rosenbrock's matrix and a basis change of condition 4 leave of 1e-16.
    np.testing.assert_allclose(found, zeros, rtol=1e-7, atol=1e-7)
    dynamics = ZeroDynamics(structure.system, structure=structure)
    if len(zeros):
        values = np.sort_complex(dynamics.eigenvalues(np.zeros(system.num_states)))
        np.testing.assert_allclose(values, zeros, rtol=1e-7, atol=1e-7)


# ---- zero dynamics


def swing_eigenvalues() -> np.ndarray:
    """M_2 s^2 + D_2 s + K = 0; K is what two springs b_i cos_i in series have, at the given flows.

    The first carries P - P_2 = 0.7, the second P_2 = 0.6.
    """
    first, second = (b * np.cos(np.arcsin(flow / b)) for b, flow in ((2.0, 0.7), (1.5, 0.6)))
    return np.roots([0.15, 0.4, first * second / (first + second)])


def tank_eigenvalues(levels, splits) -> np.ndarray:
    """(1 + s T_3)(1 + s T_4) = (1 - g_1)(1 - g_2)/(g_1 g_2) (Johansson 2000)."""
    area, hole, (g1, g2) = np.array([28.0, 32.0]), np.array([0.071, 0.057]), splits
    t3, t4 = area / hole * np.sqrt(2 * np.array(levels) / 981.0)
    return np.roots([t3 * t4, t3 + t4, 1 - (1 - g1) * (1 - g2) / (g1 * g2)])


EIGENVALUES = {
    "swing_network": swing_eigenvalues(),
    "aircraft": np.array([np.sqrt(2.0), -np.sqrt(2.0)]),
    "dc_motor": np.array([-0.8]),
    "linear": invariant_zeros(matrices(PROBLEMS["linear"]().system), 1),
}


@pytest.mark.parametrize("name", EIGENVALUES)
def test_zero_dynamics_have_the_eigenvalues_found_by_hand(name):
    problem = PROBLEMS[name]()
    stability = ZeroDynamics(problem.system).stability()
    expected = np.sort_complex(EIGENVALUES[name].astype(complex))
    np.testing.assert_allclose(np.sort_complex(stability.eigenvalues), expected, rtol=1e-7)


@pytest.mark.parametrize("name", ["quadruple_tank", "quadruple_tank_crossed"])
def test_tanks_have_the_zeros_of_johansson(name):
    """At the equilibrium next to the nominal state, by his formula; and near his numbers."""
    problem, splits = PROBLEMS[name](), {"quadruple_tank": (0.70, 0.60)}.get(name, (0.43, 0.34))
    stability = ZeroDynamics(problem.system).stability()
    expected = np.sort(tank_eigenvalues(stability.state[2:], splits).real)
    np.testing.assert_allclose(np.sort(stability.eigenvalues.real), expected, rtol=1e-7)
    published = {"quadruple_tank": (-0.060, -0.018)}.get(name, (-0.057, 0.013))
    # Published with two digits, and the levels with which they were made too.
    np.testing.assert_allclose(expected, published, atol=2e-3)


@pytest.fixture(
    params=[name for name, make in PROBLEMS.items() if make().minimum_phase is not None]
)
def decided(request) -> Problem:
    return PROBLEMS[request.param]()


def test_the_verdict_is_that_of_the_literature(decided):
    verdict = ZeroDynamics(decided.system).stability().verdict
    assert verdict is (Verdict.STABLE if decided.minimum_phase else Verdict.UNSTABLE)


# ---- systems made from their normal form


@pytest.mark.slow
def test_hidden_normal_forms_are_of_all_kinds():
    """The property tests over them see every kind of degree and of output."""
    systems = [hidden_normal_form(seed) for seed in range(60)]
    assert {len(h.constraint_degrees) for h in systems} == {0, 1, 2, 3}
    assert {h.system.num_controls for h in systems} == {1, 2, 3, 4}
    assert {degree for h in systems for degree in h.constraint_degrees} == {1, 2, 3}
    assert {degree for h in systems for degree in h.output_degrees} == {0, 1, 2, 3}
    assert {h.zero_dynamics for h in systems} == {0, 1, 2, 3}
    mixed = [h for h in systems if len(set(h.constraint_degrees)) > 1]
    assert len(mixed) > 5
    # Constraint inputs that are outputs, although the control does not act on them at once.
    felt = [
        h
        for h in systems
        if any(d and not h.system.m[i, :].is_zero() for i, d in enumerate(h.output_degrees))
    ]
    assert len(felt) > 5


@pytest.mark.slow
@pytest.mark.parametrize("seed", some(range(30, 60), of=10))
def test_hidden_normal_forms_are_found(seed):
    """As in test_structure.py, with other seeds."""
    hidden = hidden_normal_form(seed)
    structure = find_structure(hidden.system)
    assert structure.constraint_degrees == hidden.constraint_degrees
    assert structure.output_degrees == hidden.output_degrees
    assert structure.zero_dynamics_dimension == hidden.zero_dynamics
    assert structure.index == max((r + 1 for r in hidden.constraint_degrees), default=0)
