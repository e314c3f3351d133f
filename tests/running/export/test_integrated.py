"""A plant, and a loop as a whole, over time in C, against Drake's Simulator."""

import re
import shutil

import numpy as np
import pytest
from c_controller import compile_c
from c_integrated import CIntegrated
from pydrake.systems.analysis import SimulatorConfig
from runs import scenario

from drake_dae import Record, build_scenario, export_controller, simulate
from drake_dae.errors import ModelError
from drake_dae.running import export_code
from drake_dae.running.export.steps.boundary import loop_part, plant_part
from drake_dae.running.export.steps.integrated import fixed_steps, write_integrated

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")

STEP = 0.001
CONFIG = SimulatorConfig(
    integration_scheme="runge_kutta3", use_error_control=False, max_step_size=STEP
)
SAMPLED = "sampling={period: 0.001}"
EVERYTHING = (
    "sampling={period: 0.002, delay: 0.003}",
    "estimator={rate: 20.0}",
    "saturation=true",
    "sensors.encoders={resolution: 1.0e-5, velocity_bandwidth: 500}",
    "sensors.force={sample_period: 0.002}",
    "law.integral=[tool.z, wall.force]",
)


def in_drake(name: str, *settings: str, duration: float = 0.3):
    """The loop, its context at the start, and Drake's record of fixed steps."""
    loop, context = build_scenario(scenario(name, *settings))
    run = context.Clone()
    simulate(loop.diagram, run, duration, CONFIG)
    return loop, context, loop.record(run)


def assert_same(found: np.ndarray, record: Record, name: str, places: slice = slice(None)) -> None:
    """To 1e-12 of the largest in the run: the same operations in another order."""
    wanted = record[name][places]
    scale = max(np.abs(wanted).max(), 1e-3 if name == "constraint_residual" else 0.0)
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-12 * scale, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("two_link_wall", (SAMPLED,)),
        ("two_link_wall", ()),
        ("two_link_wall", EVERYTHING),
        pytest.param("seven_joint_wall", (SAMPLED,), marks=pytest.mark.slow),
        pytest.param(
            "seven_joint_moving_plate", (), marks=[pytest.mark.slow, pytest.mark.thorough]
        ),
    ],
)
def test_a_loop_does_what_it_does_in_drakes_simulator(name, settings, tmp_path):
    loop, context, record = in_drake(name, *settings)
    code = CIntegrated(
        write_integrated(loop_part(loop, context), "loop", context, name, tmp_path, CONFIG)
    )
    rows = []
    for time in record.time[:-1]:
        assert code.advance(time) == 0
        rows.append(np.array(code.own.row))
    for key, places in code.outputs.items():
        # The last row of a record follows the updates of its time.
        assert_same(np.array(rows)[:, places], record, key, slice(-1))


@pytest.mark.slow
def test_a_loop_with_a_task_has_its_phases(tmp_path):
    """Drake's contact law with a sampled task, through its touch and the press after it."""
    settings = ["task.signals={ready: !PointToPoint {start: [0], end: [1], end_time: 0.5}}"]
    loop, context, record = in_drake("wall_guarded", *settings, duration=1.7)
    part = loop_part(loop, context)
    code = CIntegrated(write_integrated(part, "loop", context, "task", tmp_path, CONFIG))
    rows = []
    for time in record.time[:-1]:
        assert code.advance(time) == 0
        rows.append(np.array(code.own.row))
    values = {key: np.array(rows)[:, places] for key, places in code.outputs.items()}
    for key in ("state", "control", "constraint_force", "desired_output"):
        assert_same(values[key], record, key, slice(-1))
    np.testing.assert_array_equal(values["change"][:, 1], record["phase"][:-1].argmax(axis=1))
    assert {*values["change"][:, 1]} == {0.0, 1.0, 2.0, 3.0}


@pytest.fixture(scope="module")
def plant(tmp_path_factory):
    """A plant with its sensors, and Drake's record of the loop."""
    loop, context, record = in_drake("two_link_wall", *EVERYTHING)
    folder = tmp_path_factory.mktemp("plant")
    part = plant_part(loop, context)
    return CIntegrated(write_integrated(part, "plant", context, "arm", folder, CONFIG)), record


@pytest.mark.slow
def test_a_plant_follows_the_recorded_control(plant):
    code, record = plant
    code.reset()
    assert list(code.outputs)[4:] == ["estimated_state", "measured_force"]
    found = []
    for k, time in enumerate(record.time[:-1]):
        if k:
            # What acted from the last step on is what a record has at its end.
            code.own.inputs[:2] = record["control"][k]
            assert code.advance(time) == 0
        found.append(np.array(code.own.row))
    for key, places in code.outputs.items():
        assert_same(np.array(found)[:, places], record, key, slice(-1))


def test_a_long_way_is_made_of_the_same_steps(plant):
    code, _ = plant
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


def test_a_state_off_the_manifold_is_brought_there(plant):
    code, _ = plant
    code.reset()
    code.own.state[0] += 1e-3
    assert code.show() == 0
    assert np.abs(code.output("constraint_residual")).max() > 1e-4
    assert code.advance(STEP) == 0
    # What is left is the error of one step.
    assert np.abs(code.output("constraint_residual")).max() < 1e-8


def test_what_has_no_value_is_told(plant):
    code, record = plant
    for bad in (np.nan, np.inf):
        code.reset()
        code.own.inputs[0] = bad
        assert code.advance(STEP) == 1
        assert code.own.time == 0.0
    code.reset()
    code.own.state[0] = 1e3 * np.pi  # The tool is far behind the wall.
    code.own.state[1] = 0.0
    assert code.advance(STEP) in (1, 2)
    code.reset()
    assert code.advance(STEP) == 0
    assert_same(code.output("state"), record, "state", 1)


@pytest.mark.slow
def test_numbers_are_those_of_the_model_with_all_optimizations(tmp_path):
    """On processors with AVX-512 gcc 12 takes wrong what is equal and followed by zeros."""
    loop, context = build_scenario(scenario("two_link_wall", *EVERYTHING))
    written = write_integrated(loop_part(loop, context), "loop", context, "arm", tmp_path, CONFIG)
    code = CIntegrated(written, "-O2", "-march=native")
    np.testing.assert_array_equal(code.own.parameters, written.values)
    np.testing.assert_array_equal(code.own.state[: written.start.size], written.start)


def test_all_files_are_linked_together(tmp_path):
    """Names of one file are no names of another."""
    loop, context = build_scenario(scenario("two_link_wall", SAMPLED))
    for name in ("one", "two"):
        export_code(loop, context, name, tmp_path)
        export_controller(loop, context, name, tmp_path, CONFIG, 0.01)
        write_integrated(plant_part(loop, context), "plant", context, name, tmp_path, CONFIG)
        write_integrated(loop_part(loop, context), "loop", context, name, tmp_path, CONFIG)
    sources = [
        f"{name}{end}.c"
        for name in ("one", "two")
        for end in ("", "_controller", "_plant", "_loop")
    ]
    compile_c(tmp_path, sources, "all.so", "-O0", "-shared", "-fPIC")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "settings", "reason"),
    [
        ("wall_point_contact", (), "'seven_joint_arm'"),
        (
            "two_link_wall",
            (
                SAMPLED,
                "sensors.force={sample_period: 0.01, noise_deviation: [0.1]}",
            ),
            "random",
        ),
    ],
)
def test_what_is_no_function_of_the_time_is_refused(name, settings, reason):
    loop, context = build_scenario(scenario(name, *settings))
    for make in (loop_part, plant_part):
        with pytest.raises(ModelError, match=re.escape(reason)) as caught:
            make(loop, context)
        assert "\n" not in str(caught.value)


def test_steps_are_those_of_the_run_where_they_are_fixed():
    assert fixed_steps(None) == ("runge_kutta5", 1e-3)
    assert fixed_steps(CONFIG) == ("runge_kutta3", STEP)
    controlled = SimulatorConfig(integration_scheme="radau3", max_step_size=1e-4)
    assert fixed_steps(controlled) == ("runge_kutta5", 1e-4)
    controlled.use_error_control = False
    with pytest.raises(ModelError, match="radau3"):
        fixed_steps(controlled)
