"""The place of a surface from the depth to which a force presses a tool into it."""

import casadi as ca
import numpy as np
import pytest

from drake_dae import DaeSystem
from drake_dae.dae.beyond.identified import IdentifiedTerms
from drake_dae.dae.system.signals import Parameter
from drake_dae.systems.observing.parameter_filter import FADING, ParameterFilter, Sampled

RATE, PERIOD, PLACE = 20.0, 0.002, 3e-3


def filter_of_a_wall():
    """A filter of the place of a wall within 10 mm, and its step: (state, x, force) -> state."""
    place = Parameter("place", 0.0, "m", bounds=(-0.01, 0.01))
    x, force, none = ca.SX.sym("x", 2), ca.SX.sym("force", 1), ca.SX(0, 1)
    body = DaeSystem(
        x,
        ca.vertcat(x[1], 0),
        ca.SX([0, -1]),
        ca.SX(2, 0),
        place.symbol - x[0],
        none,
        ca.SX(0, 1),
        parameters=(place,),
    )
    still = dict.fromkeys(("momentum", "drift", "inputs"), ca.SX(1, 1))
    terms = IdentifiedTerms.of(body, (place,), still, {"constraint_input": force})
    estimator = ParameterFilter(terms, np.zeros(1), 1.0, 1, RATE, PERIOD)
    memory = estimator.memory
    zero, nothing, own = ca.SX.zeros(1, 1), ca.SX(1, 0), memory.values[0]
    sample = Sampled(
        *(zero, zero, zero, nothing, own - x[0], ca.SX.ones(1, 1), zero, force),
        is_closed=force > 0.5,
        inertia=ca.SX.ones(1, 1),
        hold=zero,
    )
    regressor = estimator.regressor(sample)
    after, _ = estimator.after(sample, regressor, zero, ca.SX(0, 1), zero)
    return estimator, ca.Function("step", [memory.column, x, force], [after])


def found_place(depth):
    """The place of a wall after 5 s: a ramp to 10 N in the first second, then 5 to 35 N.

    The wall is at 3 mm; the tool is at 3 mm and the depth.
    """
    estimator, step = filter_of_a_wall()
    state, memory = estimator.start, estimator.memory
    for time in PERIOD * np.arange(2500):
        pressed = 10.0 * time if time < 1.0 else 20.0 + 15.0 * np.sin(4.0 * time)
        state = step(state, [PLACE + depth(pressed), 0.0], pressed)
    return float(state[memory.parts["values"]][0])


@pytest.mark.parametrize(
    ("depth", "tolerance"),
    [
        (lambda force: 0.0, 2e-6),
        (lambda force: 1e-5 * force, 1e-5),
        (lambda force: 2.5e-5 * force ** (2.0 / 3.0), 3.5e-5),
        (lambda force: 4.2e-5 * force**0.5, 6e-5),
    ],
    ids=["rigid", "spring", "Hertz", "layer"],
)
def test_a_wall_is_found_however_its_depth_grows_with_the_force(depth, tolerance):
    """A filter with the compliance of a spring alone leaves 0.1 um, 14 um, 51 um and 77 um.

    The depths are up to 0.35 mm.
    """
    assert abs(found_place(depth) - PLACE) < tolerance


def test_what_was_measured_fades_while_nothing_touches():
    """P' = (P - P^2 / P_0) / F is a logistic growth; steps of 2 ms in 10 s are off by 1e-3 at most.

    From a hundredth of the bounds' deviation: 0.0165 of it after F, 0.12 after 5 F.
    """
    estimator, step = filter_of_a_wall()
    state, part = ca.DM(estimator.start), estimator.memory.parts["covariance"]
    least, prior = 1e-4, estimator.prior[0] ** 2
    state[part.start] = least * prior
    after = step.mapaccum("run", round(FADING / PERIOD))
    for times in (1, 5):
        run = after if times == 1 else step.mapaccum("long", round(times * FADING / PERIOD))
        left = float(run(state, ca.DM([0.0, 0.0]), 0.0)[part.start, -1]) / prior
        assert left == pytest.approx(1.0 / (1.0 + (1.0 / least - 1.0) * np.exp(-times)), rel=1e-3)
