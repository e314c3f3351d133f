"""Runs that end where their errors leave what is tolerated."""

import warnings

import numpy as np
import pytest
from numpy.testing import assert_allclose
from runs import run_scenario, scenario

from drake_dae import Tolerances, build_scenario, rollout, simulate, start_values
from drake_dae.errors import MachineCodeWarning, ModelError, ScenarioError, SimulationError

CONTACT = "plant=!MultibodyPlant {time_step: 1.0e-3}", "constraint_damping=!Poles {all: [-50.0]}"


@pytest.mark.slow
def test_run_ends_when_the_recent_error_is_too_large():
    """e = e0 exp(-4 t) (1 + 4 t): with a short window it is tolerated from after on, or not."""
    still = "references={tool.z: 0.3, wall.force: 20}"
    settings = "two_link_wall", still, "start.errors={tool.z: 0.05}", "gains.all=[-4.0]"
    late = "tolerances={outputs: {tool.z: 0.04}, after: 0.25, window: 2.0e-2}"
    assert run_scenario(scenario(*settings, late, "duration=0.3"))[2].time[-1] == 0.3
    loop, context = build_scenario(scenario(*settings, late.replace("0.25", "0.05")))
    with pytest.raises(
        SimulationError, match=r"recent error of tool\.z is 0\.04\d* m .* tolerated"
    ):
        simulate(loop.diagram, context, 0.3, scenario(*settings).integrator)
    assert_allclose(context.get_time(), 0.05, atol=1e-3)
    # What was run stays.
    assert loop.record(context)["tracking_error"][-1, 0] > 0.04


def test_recent_error_is_that_of_its_equation():
    """s_(k+1) = s_k + (1 - exp(-h / window)) (e_k^2 - s_k) of what is logged until the end."""
    window, largest = 0.02, 8.0
    found = scenario(
        "two_link_wall",
        *CONTACT,
        "start.errors={}",
        f"tolerances={{outputs: {{wall.force: {largest}}}, after: 0.0, window: {window}}}",
    )
    loop, context = build_scenario(found)
    with pytest.raises(SimulationError, match=r"tolerated; then wall\.force = .* N") as raised:
        simulate(loop.diagram, context, 1.0, found.integrator)
    record, recent = loop.record(context), 0.0
    for time, error in zip(record.time, record["tracking_error"][:, 1], strict=True):
        recent += -np.expm1(-1e-3 / window) * (error**2 - recent)
        assert (np.sqrt(recent) > largest) == (time > raised.value.time - 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("compiled", [False, True])
def test_a_rollout_ends_where_simulate_does(compiled):
    """With fixed steps both see the same errors at the same samples, and say the same."""
    steps = "integrator={use_error_control: false, max_step_size: 1.0e-3}"
    chosen = scenario("two_link_wall", steps, "tolerances={outputs: {tool.z: 0.01}, window: 0.05}")
    loop, context = build_scenario(chosen)
    given = start_values(loop, context)
    with pytest.raises(SimulationError, match=r"recent error of tool\.z") as wanted:
        simulate(loop.diagram, context, 1.0, chosen.integrator)
    times = np.linspace(0.0, 1.0, 1001)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MachineCodeWarning)  # Not everywhere there is a compiler.
        (run,) = rollout(loop, *given, times, config=chosen.integrator, compiled=compiled)
    assert str(run.failure) == str(wanted.value)
    assert run.record.time[-1] == pytest.approx(wanted.value.time)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("tolerances={outputs: {tool.x: 1.0}}", r"tolerances: no output 'tool\.x'; did you mean"),
        ("tolerances={outputs: {}}", "tolerances need an output"),
        ("tolerances={outputs: {tool.z: 0.0}}", r"tolerance of tool\.z must be positive"),
        ("tolerances={outputs: {tool.z: 1.0}, window: 0}", "window must be positive"),
    ],
)
def test_what_cannot_be_tolerated_is_refused(setting, message):
    with pytest.raises(ScenarioError, match=message):
        build_scenario(scenario("two_link_wall", setting))


def test_numbers_are_checked():
    with pytest.raises(ModelError, match="after"):
        Tolerances({"tool.z": 1.0}, after=np.inf)
