"""A loop over time in C, against Drake's Simulator."""

import re
import shutil

import numpy as np
import pytest
from arms import fixed_step
from c_controller import compile_c
from c_loop import CLoop, code_of
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from runs import scenario

from drake_dae import build_scenario, export_controller
from drake_dae.errors import ModelError
from drake_dae.running.export import fixed_steps

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")

STEP = 0.001
CONFIG = fixed_step(STEP, "runge_kutta3")
SAMPLED = "sampling={period: 0.001}"
EVERYTHING = (
    "sampling={period: 0.002, delay: 0.003}",
    "estimator={rate: 20.0}",
    "saturation=true",
    "sensors.encoders={resolution: 1.0e-5, velocity_bandwidth: 500}",
    "sensors.force={sample_period: 0.002}",
    "law.integral=[tool.z, wall.force]",
)


def assert_as_in_drake(name: str, settings, duration: float, folder) -> CLoop:
    """All signals after the updates of each step, to 1e-12 of the largest: the same operations."""
    loop, context = build_scenario(scenario(name, *settings))
    code = CLoop(code_of(loop, context), folder, CONFIG)
    simulator = Simulator(loop.diagram, context)
    ApplySimulatorConfig(CONFIG, simulator)
    simulator.Initialize()
    found, wanted = [], []
    for k in range(round(duration / STEP)):
        simulator.AdvanceTo(k * STEP)
        simulator.AdvancePendingEvents()
        assert code.advance(k * STEP) == 0
        found.append(np.array(code.own.row))
        ports = [loop.diagram.GetOutputPort(name) for name in code.outputs]
        wanted.append(np.concatenate([port.Eval(context) for port in ports]))
    found, wanted = np.array(found), np.array(wanted)
    for key, places in code.outputs.items():
        least = 1e-3 if key == "constraint_residual" else 0.0
        scale = max(np.abs(wanted[:, places]).max(), least)
        np.testing.assert_allclose(
            found[:, places], wanted[:, places], rtol=0.0, atol=1e-12 * scale, err_msg=key
        )
    return code


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "settings", "duration"),
    [
        ("two_link_wall", (), 0.3),
        ("two_link_wall", EVERYTHING, 0.3),
        pytest.param("seven_joint_moving_plate", (), 0.1, marks=pytest.mark.thorough),
        pytest.param(
            "wall_guarded",
            ["task.signals={ready: !PointToPoint {start: [0], end: [1], end_time: 0.5}}"],
            1.7,
        ),
    ],
)
def test_a_loop_does_what_it_does_in_drakes_simulator(name, settings, duration, tmp_path):
    assert_as_in_drake(name, settings, duration, tmp_path)


@pytest.fixture(scope="module")
def code(tmp_path_factory):
    loop, context = build_scenario(scenario("two_link_wall", *EVERYTHING))
    return CLoop(code_of(loop, context), tmp_path_factory.mktemp("loop"), CONFIG)


def test_a_long_way_is_made_of_the_same_steps(code):
    code.reset()
    for k in range(1, 51):
        assert code.advance(k * STEP) == 0
    there = np.array(code.own.row)
    code.reset()
    assert code.advance(0.05) == 0
    # Times of steps differ by round-off.
    np.testing.assert_allclose(code.own.row, there, rtol=1e-12, atol=1e-12)
    code.own.longest = 0.01
    assert code.advance(0.06) == 0
    assert code.advance(0.05) == 0  # What is past does nothing.
    assert code.own.time == 0.06


def test_a_state_off_the_manifold_is_brought_there(code):
    code.reset()
    code.own.state[0] += 1e-3
    assert code.advance(0.0) == 0
    assert np.abs(code.output("constraint_residual")).max() < 1e-10


@pytest.mark.parametrize("bad", [np.nan, 1e3 * np.pi])
def test_what_has_no_value_is_told(code, bad):
    """No number, and a tool far behind the wall."""
    code.reset()
    assert code.advance(0.01) == 0
    before = np.array(code.own.state)
    code.own.state[0], code.own.state[1] = bad, 0.0
    assert code.advance(0.02) in (1, 2)
    assert code.own.time == 0.01
    code.own.state[:] = before
    code.reset()
    assert code.advance(0.02) == 0


@pytest.mark.slow
def test_numbers_are_those_of_the_model_with_all_optimizations(tmp_path):
    """On processors with AVX-512 gcc 12 takes wrong what is equal and followed by zeros."""
    loop, context = build_scenario(scenario("two_link_wall", *EVERYTHING))
    own = code_of(loop, context)
    code = CLoop(own, tmp_path, CONFIG, "-O2", "-march=native")
    np.testing.assert_array_equal(code.own.parameters[: own.values.size], own.values)
    np.testing.assert_array_equal(code.own.state[:4], own.steps.block.default("state"))


def test_all_files_are_linked_together(tmp_path):
    """Names of one file are no names of another."""
    loop, context = build_scenario(scenario("two_link_wall", SAMPLED))
    for name in ("one", "two"):
        export_controller(loop, context, name, tmp_path, CONFIG, 0.01)
        CLoop(code_of(loop, context), tmp_path, CONFIG, name=name)
    sources = [f"{name}_{part}.c" for name in ("one", "two") for part in ("controller", "loop")]
    for compiler in filter(shutil.which, ("cc", "gcc", "clang")):
        compile_c(tmp_path, sources, "all.so", "-O0", "-shared", "-fPIC", compiler=compiler)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "settings", "reason"),
    [
        ("wall_point_contact", (), "CompliantPlant"),
        (
            "two_link_wall",
            (SAMPLED, "sensors.force={sample_period: 0.01, noise_deviation: [0.1]}"),
            "noise_deviation",
        ),
    ],
)
def test_what_is_no_function_of_the_time_is_refused(name, settings, reason):
    loop, context = build_scenario(scenario(name, *settings))
    with pytest.raises(ModelError, match=re.escape(reason)):
        code_of(loop, context)


def test_steps_are_those_of_the_run_where_they_are_fixed():
    assert fixed_steps(None) == ("runge_kutta5", 1e-3)
    assert fixed_steps(CONFIG) == ("runge_kutta3", STEP)
    controlled = SimulatorConfig(integration_scheme="radau3", max_step_size=1e-4)
    assert fixed_steps(controlled) == ("runge_kutta5", 1e-4)
    controlled.use_error_control = False
    with pytest.raises(ModelError, match="radau3"):
        fixed_steps(controlled)
