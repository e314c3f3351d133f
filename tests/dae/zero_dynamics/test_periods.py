"""The period of a reference that is known by its values alone."""

import numpy as np
import pytest

from drake_dae.dae.zero_dynamics.periods import find_period


@pytest.mark.parametrize("begin", [0.0, 100.0])
def test_a_period_is_found_wherever_the_interval_begins(begin):
    """To 1e-9: the values are known to 1e-16, and repeat to 1e-12 where they are refined."""

    def reference(time):
        assert begin <= time <= begin + 10.0
        return np.array([np.sin(2.1 * time), 3.0 + np.cos(6.3 * time)])

    found = find_period(reference, begin, begin + 10.0)
    assert found == pytest.approx(2.0 * np.pi / 2.1, rel=1e-9)
