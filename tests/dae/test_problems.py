"""What the problems claim to be, by routes that know nothing of the library."""

import casadi as ca
import numpy as np
import pytest
import scipy.linalg
from problems import PROBLEMS, Problem

from drake_dae.dae import DaeSystem, Verdict, ZeroDynamics

# ---- linear systems by matrix computations


Matrices = dict[str, np.ndarray]


def matrices(system: DaeSystem) -> Matrices:
    """F, G and K of a linear system."""
    x = system.state
    expressions = {"F": ca.jacobian(system.f, x), "G": system.g, "K": ca.jacobian(system.k, x)}
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


@pytest.mark.parametrize("name", ["circuit", "linear", "cart", "held_point"])
def test_linear_problems_by_matrices(name):
    problem = PROBLEMS[name]()
    a = matrices(problem.system)
    assert kronecker_index(a) == problem.index


# ---- zero dynamics


def swing_eigenvalues() -> np.ndarray:
    """M_2 s^2 + D_2 s + K = 0; K is what two springs b_i cos_i in series have, at the given flows.

    The first carries P - P_2 = 0.7, the second P_2 = 0.6.
    """
    first, second = (b * np.cos(np.arcsin(flow / b)) for b, flow in ((2.0, 0.7), (1.5, 0.6)))
    return np.roots([0.15, 0.4, first * second / (first + second)])


EIGENVALUES = {
    "swing_network": swing_eigenvalues(),
    "aircraft": np.array([np.sqrt(2.0), -np.sqrt(2.0)]),
    "dc_motor": np.array([-0.8]),
}


@pytest.mark.parametrize("name", EIGENVALUES)
def test_zero_dynamics_have_the_eigenvalues_found_by_hand(name):
    problem = PROBLEMS[name]()
    stability = ZeroDynamics(problem.system).stability()
    expected = np.sort_complex(EIGENVALUES[name].astype(complex))
    np.testing.assert_allclose(np.sort_complex(stability.eigenvalues), expected, rtol=1e-7)


@pytest.fixture(
    params=[name for name, make in PROBLEMS.items() if make().minimum_phase is not None]
)
def decided(request) -> Problem:
    return PROBLEMS[request.param]()


def test_the_verdict_is_that_of_the_literature(decided):
    verdict = ZeroDynamics(decided.system).stability().verdict
    assert verdict is (Verdict.STABLE if decided.minimum_phase else Verdict.UNSTABLE)
