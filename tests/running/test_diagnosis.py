"""Ends of runs say their cause: singular states, paths out of reach, wires, limits, stiffness."""

import re
import warnings

import numpy as np
import pytest
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import DiagramBuilder
from runs import scenario

from drake_dae import DaePlant, DaeSystem, simulate
from drake_dae.errors import SimulationError, SingularityError, WiringError
from drake_dae.running.diagnosis import RunWatch, fastest_rate
from drake_dae.scenario.build import build_scenario, roll_scenario

REACH = "references.tool.z=!PointToPoint {start: [0.3], end: [3], end_time: 3}"
"""Two links of 1 m reach z = 1.6 m on the wall at x = 1.2 m."""


def failed(case):
    loop, context = build_scenario(case)
    with pytest.raises(SimulationError) as caught:
        simulate(loop.diagram, context, case.duration, case.integrator)
    return caught.value


@pytest.mark.parametrize("rolls", [False, True])
def test_a_path_that_leaves_the_reach_is_said_so(rolls):
    """10 s^3 - 15 s^4 + 6 s^5 = 1.3 / 2.7 at s = 0.49, and there the arm is stretched."""
    case = scenario("two_link_wall", REACH, "start.errors={}", "compiled=false")
    error = roll_scenario(case, *build_scenario(case)).failure if rolls else failed(case)
    assert isinstance(error, SingularityError)
    assert error.time == pytest.approx(1.4702, abs=1e-3)
    assert error.constraints == ("wall.distance",)
    for name in ("t = 1.470", "B(x)", "tool.z"):
        assert name in str(error)


def test_a_dead_point_is_a_singularity_with_its_constraint():
    """The slider of crank 0.2 m and rod 0.4 m comes to 0.6 m; the pin then holds it."""
    case = scenario(
        "slider_crank",
        "outputs=[!JointPositions {joints: [slider]}]",
        "references={slider: !PointToPoint {start: [0.4], end: [0.9], end_time: 2}}",
        "start.errors={}",
        "compiled=false",
    )
    error = failed(case)
    assert isinstance(error, SingularityError)
    assert error.constraints == ("pin.x",)
    assert "slider" in str(error)


def test_a_run_does_not_take_thousands_of_ever_shorter_steps():
    case = scenario("two_link_wall", REACH, "start.errors={}", "compiled=false")
    loop, context = build_scenario(case)
    with pytest.raises(SingularityError):
        simulate(loop.diagram, context, case.duration, case.integrator)
    times = loop.record(context).time
    assert times.size < 600
    assert np.diff(times).min() > 1e-10


@pytest.mark.parametrize("alone", [False, True])
def test_a_port_without_a_wire_is_named(alone):
    system = DaeSystem.from_functions(["a"], f=lambda x: [0], h=lambda x: [1], name="still")
    block = DaePlant(system)
    if not alone:
        builder = DiagramBuilder()
        builder.AddSystem(block)
        block = builder.Build()
    with pytest.raises(WiringError, match="'control' of 'still'"):
        simulate(block, block.CreateDefaultContext(), 1.0)


def spring(rate):
    """A free vibration of a given rate."""
    return DaePlant(
        DaeSystem.from_functions(
            ["a", "b"], f=lambda x: [rate * x[1], -rate * x[0]], nominal_state=[1.0, 0.0]
        )
    )


def test_fixed_steps_that_are_too_long_for_a_spring_say_how_long_they_may_be():
    """Runge-Kutta's third order is stable up to 1.73 on the imaginary axis."""
    plant = spring(400.0)
    assert fastest_rate(plant, plant.CreateDefaultContext(), 0.0, np.array([1.0, 0.0])) == (
        pytest.approx(400.0, rel=1e-6)
    )
    config = SimulatorConfig(
        integration_scheme="runge_kutta3", use_error_control=False, max_step_size=0.01
    )
    with pytest.raises(SimulationError, match=r"0\.01 s .* 400 1/s") as caught:
        simulate(plant, plant.CreateDefaultContext(), 10.0, config)
    longest = re.search(r"at most ([0-9.]+) s", str(caught.value))
    assert float(longest[1]) == pytest.approx(1.73 / 400.0, rel=0.03)
    config.max_step_size = 0.004
    simulate(plant, plant.CreateDefaultContext(), 1.0, config)


def test_a_stiff_loop_says_so_and_an_implicit_scheme_is_silent():
    """Robertson's reactions: rates from 0.04 to 2e3 1/s."""
    system = DaeSystem.from_functions(
        ["a", "b", "c"],
        f=lambda x: [
            -0.04 * x[0] + 1e4 * x[1] * x[2],
            0.04 * x[0] - 1e4 * x[1] * x[2] - 3e7 * x[1] ** 2,
            3e7 * x[1] ** 2,
        ],
        nominal_state=[1.0, 0.0, 0.0],
        name="robertson",
    )
    plant = DaePlant(system)

    def told(scheme, duration):
        context = plant.CreateDefaultContext()
        config = SimulatorConfig(integration_scheme=scheme, accuracy=1e-6)
        watch = RunWatch(plant, context, config, 400.0)
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            simulate(plant, context, duration, config, look=lambda now: watch.look(now, 1))
        return [str(one.message) for one in found]

    # Of a run of 400 s the first 6 s: by then 2000 steps are long past.
    (text,) = told("runge_kutta3", 6.0)
    assert "radau3" in text
    assert told("radau3", 0.1) == []
