"""References along which a system is analyzed: margins, reach, and contradictions."""

import re

import numpy as np
import pytest
from problems import (
    PROBLEMS,
    double_integrator,
)

from drake_dae.analysis.analyze import analyze
from drake_dae.errors import ModelError


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


def test_a_reference_of_a_wrong_size():
    with pytest.raises(ModelError, match="reference"):
        analyze(PROBLEMS["pendulum"]().system, reference=lambda t: np.zeros(2), times=[0.0, 1.0])


def rising(changes=lambda t, wanted: wanted):
    """R(t) of z = 0.3 sin 2t for degree 2, and what a test changes."""
    size, w = 0.3, 2.0
    return lambda t: changes(
        t,
        np.array([size * np.sin(w * t), size * w * np.cos(w * t), -size * w**2 * np.sin(w * t)]),
    )


@pytest.mark.slow
@pytest.mark.parametrize("length", [1e-3, 5.0, 1e4])
def test_references_that_agree_with_themselves(length):
    """Over any time: the differences of a slow and of a fast reference are within the tolerance."""
    system = double_integrator()
    for rate in (1.0, 20.0):
        time = 5.0 / length

        def reference(t, rate=rate, time=time):
            return rising()(rate * time * t) * (rate * time) ** np.arange(3)

        motion = analyze(system, reference=reference, times=np.linspace(0.0, length, 11)).motion
        assert motion.ending is None
        assert motion.states[-1, 0] == pytest.approx(reference(length)[0], rel=1e-9)


def test_a_highest_derivative_may_jump():
    """r'' = 1, then -1: the motion is that of r, and r' has a kink."""

    def reference(t):
        s = t - 1.0
        return np.array([s * abs(s) / 2 * -1 + s, -abs(s) + 1.0, -np.sign(s)])

    times = np.linspace(0.0, 2.0, 21)
    assert analyze(double_integrator(), reference=reference, times=times).problems == ()


CONTRADICTIONS = {
    "derivatives left out": (lambda t, r: r * [1, 0, 0], "q0' = 0 .*q0"),
    "a factor of 1 %": (lambda t, r: r * [1, 1.01, 1.01], "q0' = .*q0"),
    "a wrong sign": (lambda t, r: r * [1, 1, -1], "q0'' = .*q0'"),
}


@pytest.mark.parametrize("what", CONTRADICTIONS)
def test_references_that_contradict_themselves_are_refused(what):
    changes, message = CONTRADICTIONS[what]
    system = double_integrator(output_signals=["q0"])
    with pytest.raises(ModelError, match=rf"double integrator: .*{message}"):
        analyze(system, reference=rising(changes), times=np.linspace(0.0, 5.0, 51))
