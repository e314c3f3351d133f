"""Runs that diverge end with what grew; those that do something violent go on."""

import warnings

import numpy as np
import pytest
from arms import fixed_step
from runs import some

from drake_dae import DaePlant, DaeSystem, TrackingLaw, make_closed_loop, poles
from drake_dae.errors import NonMinimumPhaseWarning, SimulationError
from drake_dae.running.simulate import simulate
from drake_dae.scenario.build import build_scenario, roll_scenario
from tests.support.runs import scenario

LATE = "sampling={period: %g, delay: %g}"


def test_a_loop_that_diverges_ends_with_what_grew():
    """Read late: the law answers an error of long ago."""
    case = scenario("two_link_wall", "law.gains=!Poles {all: [-2000.0]}", LATE % (0.001, 0.001))
    loop, context = build_scenario(case)
    with pytest.raises(SimulationError, match=r"wall\.force.*may_diverge") as caught:
        simulate(loop.diagram, context, case.duration, case.integrator)
    # Far before numbers end: the reported numbers can be read.
    assert np.isfinite(caught.value.state).all()
    assert caught.value.time < 1.0


FIXED = (
    "integrator.use_error_control=false",
    "integrator.integration_scheme=runge_kutta3",
    "integrator.max_step_size=1e-4",
)


@pytest.mark.slow
@pytest.mark.parametrize("fixed", [(), FIXED])
@pytest.mark.parametrize("compiled", some(["true", "false"]))
def test_rollouts_diverge_as_simulations_do(fixed, compiled):
    settings = ("law.gains=!Poles {all: [-2000.0]}", LATE % (0.001, 0.001), *fixed)
    case = scenario("two_link_wall", *settings, f"compiled={compiled}")
    loop, context = build_scenario(case)
    found = roll_scenario(case, loop, context)
    assert found.failure is not None
    assert "wall.force" in str(found.failure)
    # What was recorded is kept, up to where it says so.
    assert found.record.time[-1] == found.failure.time < 0.1
    assert found.record.time.size > 1
    errors = np.abs(found.record["tracking_error"][:, -1])
    assert errors[-1] > 1e3 * 20.0
    if fixed:  # Under error control what may diverge takes shorter and shorter steps.
        may = scenario(
            "two_link_wall", *settings, f"compiled={compiled}", "judgement.may_diverge=true"
        )
        later = roll_scenario(may, *build_scenario(may)).failure  # Numbers end.
        assert "the run diverges" not in str(later)
        assert later.time > found.failure.time


def unstable_inside(size, period):
    """A loop whose output is held while x_2' = x_2 / period - x_1 runs off, with its context.

    Lengths are counted in 1 / size m, and times in period s.
    """
    system = DaeSystem.from_functions(
        ["a", "b"],
        f=lambda x: [0, (x[1] - x[0]) / period],
        h=lambda x: [1 / period, 0],
        l=lambda x: [x[0]],
        nominal_state=[0.1 * size, 0.1 * size],
        state_scale=[size, size],
        name="runaway",
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NonMinimumPhaseWarning)
        law = TrackingLaw(system, poles(-2.0 / period))
        loop = make_closed_loop(DaePlant(system), law, {"z0": 0.1 * size})
    context = loop.diagram.CreateDefaultContext()
    loop.set_state(context, [0.1 * size, 0.1 * size * (1.0 + 1e-3)])
    return loop, context


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size", "period"), some([(1.0, 1.0), (1e3, 1.0), (1e-3, 60.0), (1e6, 1e-3)])
)
def test_when_it_ends_does_not_depend_on_units(size, period):
    """b - a = 1e-4 size e^(t / period) is 1e9 size after 13 ln 10 = 29.9 periods.

    It is looked at every 32nd step, of period / 50 here.
    """
    loop, context = unstable_inside(size, period)
    config = fixed_step(period / 50.0, "runge_kutta3")
    with pytest.raises(SimulationError, match=r"\bb\b") as caught:
        simulate(loop.diagram, context, 40.0 * period, config)
    expected = 13.0 * np.log(10.0)
    assert expected <= caught.value.time / period <= expected + 33 / 50
