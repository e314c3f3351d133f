"""What the problems claim to be, by routes that know nothing of the library."""

import numpy as np
import pytest
from problems import PROBLEMS, Problem

from drake_dae.dae import Verdict, ZeroDynamics


def swing_eigenvalues() -> np.ndarray:
    """M_2 s^2 + D_2 s + K = 0; K is what two springs b_i cos_i in series have, at the given flows.

    The first carries P - P_2 = 0.7, the second P_2 = 0.6.
    """
    first, second = (b * np.cos(np.arcsin(flow / b)) for b, flow in ((2.0, 0.7), (1.5, 0.6)))
    return np.roots([0.15, 0.4, first * second / (first + second)])


EIGENVALUES = {
    "swing_network": swing_eigenvalues(),
    "aircraft": np.array([np.sqrt(2.0), -np.sqrt(2.0)]),
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
