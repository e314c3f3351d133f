"""What the problems claim of their zero dynamics, by routes that know nothing of the library."""

import numpy as np
import pytest
from problems import PROBLEMS

from drake_dae.dae import Verdict, ZeroDynamics


@pytest.mark.parametrize(
    ("name", "verdict"), [("linear", Verdict.STABLE), ("aircraft", Verdict.UNSTABLE)]
)
def test_the_verdict_is_that_of_the_literature(name, verdict):
    stability = ZeroDynamics(PROBLEMS[name]().system).stability()
    assert stability.verdict is verdict
    if name == "aircraft":  # e roll'' = sin roll with e = 0.5.
        expected = [-np.sqrt(2.0), np.sqrt(2.0)]
        np.testing.assert_allclose(np.sort_complex(stability.eigenvalues), expected, rtol=1e-7)
