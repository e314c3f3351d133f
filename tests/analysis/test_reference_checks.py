"""References along which a system is analyzed: margins, reach, and contradictions."""

import re

import numpy as np
import pytest
from problems import PROBLEMS

from drake_dae.analysis import analyze


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
