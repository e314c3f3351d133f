"""The whole controller as one step of C, against Drake's Simulator."""

import re
import shutil
import subprocess

import numpy as np
import pytest
from arms import arm, law
from c_controller import CController, compile_c
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
from runs import MANY_PIECES, scenario

from drake_dae import CompliantPlant, build_scenario, export_controller, make_closed_loop
from drake_dae.dae import Signal
from drake_dae.errors import ModelError
from drake_dae.running.c_code import identifiers
from drake_dae.running.export import ControllerPart, Ticks
from drake_dae.systems import PointMaterial

needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
RUNNING, HOLDING, STOPPED, WAITING = range(4)
NONE, NUMBER, STALE, LATE, CLOCK, VALUE = range(6)

SAMPLED = "sampling={period: 0.001}"
EVERYTHING = (
    "sampling={period: 0.002, delay: 0.003}",
    "estimator={rate: 20.0}",
    "saturation=true",
    "sensors.encoders={resolution: 1.0e-5, velocity_bandwidth: 500}",
    "sensors.force={sample_period: 0.002, noise_deviation: [0.1]}",
    "law.integral=[tool.z, wall.force]",
)
"""What a loop may have besides plant and law; the delay ends between two samples."""


def exported(folder, name: str, *settings: str, steps: float = 300) -> str:
    chosen = scenario(name, *settings)
    loop, context = build_scenario(chosen)
    period = ControllerPart(loop.diagram, context).ticks.period
    export_controller(loop, context, name, folder, chosen.integrator, steps * period)
    return name


def played(folder, name: str, *flags: str) -> "subprocess.CompletedProcess[str]":
    program = folder / f"play_{name}_controller.c"
    source = program.read_text()
    # A million calls tell the time; here a few will do.
    program.write_text(source.replace("CALLS = 1000000", "CALLS = 1000"))
    sources = [f"play_{name}_controller.c", f"{name}_controller.c"]
    run = [compile_c(folder, sources, "play", *flags), str(folder / f"{name}_controller_run.csv")]
    return subprocess.run(run, capture_output=True, text=True, check=False)


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("two_link_wall", (SAMPLED,)),
        ("two_link_wall", (SAMPLED, MANY_PIECES)),
        ("two_link_wall", EVERYTHING),
        # Another mass than the model has: what the observer holds is more than rounding.
        ("wall_polish", ("plant.parameters={link6.mass: 3.0}",)),
    ],
)
def test_the_controller_does_what_it_does_in_drakes_simulator(name, settings, tmp_path):
    """All that it gives, at each step; the program says to how much of the largest."""
    exported(tmp_path, name, *settings)
    done = played(tmp_path, name, "-O0")
    assert done.returncode == 0, done.stdout
    lines = done.stdout.splitlines()
    count, off = re.fullmatch(
        r"played: (\d+) steps as in Drake, at most (\S+) of the largest off", lines[0]
    ).groups()
    assert int(count) == 300
    # The same operations in the same order: what differs are the last bits of sin and cos, if any.
    assert float(off) <= 1e-12
    assert re.fullmatch(r"a step: .* us in the median, .* at the 99.9th percentile.*", lines[1])


@needs_compiler
def test_a_controller_that_samples_nothing_is_one_step_too(tmp_path):
    """It acts at each step of a discrete plant, here one whose contact gives way."""
    found = arm("two_link")
    plant = CompliantPlant(found.model, PointMaterial(), structure=found.structure)
    loop = make_closed_loop(plant, law("two_link"), {"tool.z": 0.3, "wall.force": 20.0})
    context = loop.diagram.CreateDefaultContext()
    loop.set_state(context, found.structure.states[0])
    assert ControllerPart(loop.diagram, context).code.steps.rates == []
    export_controller(loop, context, "arm", tmp_path, duration=0.03)
    done = played(tmp_path, "arm", "-O1")
    assert done.returncode == 0, done.stdout


@pytest.fixture(scope="module")
def two_link(tmp_path_factory):
    """A law with integrals and an observer, whose control acts half a period later."""
    if shutil.which("cc") is None:
        pytest.skip("there is no C compiler")
    folder = tmp_path_factory.mktemp("controller")
    exported(folder, "two_link_wall", *EVERYTHING)
    compile_c(folder, ["two_link_wall_controller.c"], "controller.so", "-O0", "-shared", "-fPIC")
    return folder


@pytest.fixture
def controller(two_link):
    return CController(two_link, "two_link_wall")


@pytest.fixture
def rows(two_link):
    """Times and inputs of the run."""
    table = np.loadtxt(two_link / "two_link_wall_controller_run.csv", delimiter=",", skiprows=1)
    return [(row[0], row[1:6]) for row in table]


@pytest.mark.slow
def test_the_program_finds_what_is_wrong(two_link, tmp_path):
    for path in two_link.iterdir():
        shutil.copy(path, tmp_path)
    source = (tmp_path / "two_link_wall_controller.c").read_text()
    wrong = re.sub(r"parameters\[\] = \{[\d.]+", "parameters[] = {12.01", source, count=1)
    assert wrong != source
    (tmp_path / "two_link_wall_controller.c").write_text(wrong)
    done = played(tmp_path, "two_link_wall", "-O0")
    assert done.returncode == 1
    assert re.search(r"control\[\d\] in line \d+ is .*, and Drake has", done.stdout)
    assert done.stdout.endswith("FAILED\n")


def test_it_plays_with_other_roundings_too(two_link):
    """As of another processor or libm: multiplications and additions are joined."""
    done = played(two_link, "two_link_wall", "-O2", "-ffp-contract=fast", "-march=native")
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize("bad", [np.nan, np.inf, -2e30])
def test_what_is_no_number_is_held(controller, rows, bad):
    """As if the last good inputs were there again, which another controller is given."""
    other = CController(controller.folder, "two_link_wall")
    for time, inputs in rows[:50]:
        assert controller.step(time, inputs) == other.step(time, inputs) == RUNNING
    broken = rows[50][1].copy()
    broken[4] = bad
    assert controller.step(rows[50][0], broken) == HOLDING
    assert (controller.out.fault, controller.out.bad_steps) == (NUMBER, 1)
    other.step(rows[50][0], rows[49][1])
    np.testing.assert_array_equal(controller.control, other.control)
    assert controller.step(*rows[51]) == RUNNING
    other.step(*rows[51])
    np.testing.assert_array_equal(controller.control, other.control)
    assert (controller.out.fault, controller.out.bad_steps) == (NONE, 0)


def test_missed_steps_are_made_up_for(controller, rows):
    """As if the last good inputs had come again and again, in time."""
    other = CController(controller.folder, "two_link_wall")
    for time, inputs in rows[:50]:
        controller.step(time, inputs)
        other.step(time, inputs)
    for time, _ in rows[50:54]:
        other.step(time, rows[49][1])
    assert controller.step(*rows[54]) == other.step(*rows[54]) == RUNNING
    assert controller.out.fault == LATE
    np.testing.assert_array_equal(controller.control, other.control)
    assert list(controller.own.held) == list(other.own.held)


@pytest.mark.parametrize("fault", [NUMBER, STALE, LATE, CLOCK])
def test_what_stays_wrong_leads_to_a_stop(controller, rows, fault):
    """After the patience that is set, linearly to the control that is set, and for good."""
    controller.own.patience = 3
    controller.own.stop_control[:] = [1.0, -2.0]
    controller.own.stop_time = period = 8 * (rows[1][0] - rows[0][0])
    for time, inputs in rows[:30]:
        controller.step(time, inputs)
    count = 0
    while controller.out.status != STOPPED:
        last, (time, inputs) = controller.control, rows[30 + count]
        if fault == NUMBER:
            controller.step(time, np.full(5, np.nan))
        elif fault == STALE:
            controller.step(time, inputs, rows[29][0] - 0.01)
        elif fault == LATE:
            controller.step(time + 0.05, inputs)
        else:
            controller.step(np.nan if count % 2 else -1.0, inputs)
        count += 1
        assert np.isfinite(controller.control).all()
    assert controller.out.fault == fault
    assert count == (1 if fault == LATE else 4)
    begin = controller.control
    if fault != LATE:
        assert np.abs(begin - last).max() < 1.0  # No jump: what was held is what it begins with.
    clock = rows[29][0] + (0.05 + 1e-3 if fault == LATE else 4e-3)
    for share in (0.25, 0.5, 1.0, 5.0):
        assert controller.step(clock + share * period, rows[40][1]) == STOPPED
        wanted = begin + min(share, 1.0) * (np.array([1.0, -2.0]) - begin)
        np.testing.assert_allclose(controller.control, wanted, atol=1e-9)
    controller.reset()
    assert controller.step(*rows[0]) == RUNNING


def test_before_the_first_good_inputs_it_waits(controller, rows):
    controller.own.stop_control[:] = [3.0, 4.0]
    for time in (0.0, 0.1, 5.0):
        assert controller.step(time, np.full(5, np.nan)) == WAITING
        np.testing.assert_array_equal(controller.control, [3.0, 4.0])
    # The clock's zero is that of the first good step.
    for time, inputs in rows[:100]:
        assert controller.step(1234.5 + time, inputs) == RUNNING
    later = controller.control
    controller.reset()
    for time, inputs in rows[:100]:
        controller.step(time, inputs)
    np.testing.assert_array_equal(controller.control, later)


def test_within_a_period_the_outputs_are_the_same(controller, rows):
    for time, inputs in rows[:20]:
        controller.step(time, inputs)
        control, held = controller.control, list(controller.own.held)
        # Whatever jitter of the clock and inputs there are.
        assert controller.step(time + 0.4 * (rows[1][0] - rows[0][0]), 1.1 * inputs) == RUNNING
        np.testing.assert_array_equal(controller.control, control)
        assert list(controller.own.held) == held


def test_where_the_law_has_no_value_the_control_stays(controller, rows):
    """An arm that points straight at the wall can not press against it: B(x) is singular."""
    for time, inputs in rows[:52]:
        controller.step(time, inputs)
    held = list(controller.own.held)
    due = 52 + rows[52:].index(next(r for r in rows[52:] if is_sample(r[0])))
    for time, inputs in rows[52:due]:
        controller.step(time, inputs)
    control = controller.control
    straight = np.zeros(5)
    assert controller.step(rows[due][0], straight) == HOLDING
    assert controller.out.fault == VALUE
    np.testing.assert_array_equal(controller.control, control)
    assert np.isfinite(held).all()


def is_sample(time: float) -> bool:
    return abs(time / 0.002 - round(time / 0.002)) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "settings", "reason"),
    [
        ("two_link_wall", (), "samples"),
        ("two_link_wall", ("law.integral=[tool.z]", "sampling=null"), "'tracking_controller'"),
        (
            "two_link_wall",
            ("sampling={period: 0.001, delay: 0.00012345678}",),
            "periods and delays",
        ),
    ],
)
def test_what_has_no_steps_is_refused_in_one_sentence(name, settings, reason, tmp_path):
    loop, context = build_scenario(scenario(name, *settings))
    with pytest.raises(ModelError, match=re.escape(reason)) as caught:
        export_controller(loop, context, name, tmp_path / "none")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "none").exists()


def test_a_diagram_is_cut_at_its_plant(tmp_path):
    """Of a loop that a user wires the controller is the same; without a plant there is none."""
    builder = DiagramBuilder()
    builder.AddSystem(ConstantVectorSource([0.0]))
    diagram = builder.Build()
    with pytest.raises(ModelError, match=r"plant.*\b0\b"):
        export_controller(diagram, diagram.CreateDefaultContext(), "none", tmp_path)
    loop, context = build_scenario(scenario("two_link_wall", SAMPLED))
    export_controller(loop.diagram, context, "arm", tmp_path / "a", duration=0.05)
    export_controller(loop, context, "arm", tmp_path / "b", duration=0.05)
    a, b = ((tmp_path / each / "arm_controller.c").read_text() for each in "ab")
    assert a == b


def test_ticks_are_the_largest_that_all_times_are_multiples_of():
    ticks = Ticks([(0.001, 0.0), (0.001, 0.0025 - 0.002), (0.004, 0.0)])
    assert ticks.period == 0.0005
    assert [*ticks.rates.values()] == [(2, 0), (2, 1), (8, 0)]
    assert [ticks.at(time) for time in (0.0, 0.0005, 0.0005 + 1e-15, 0.0006)] == [0, 1, 1, 2]
    # To the bit those of Drake: 9 * 0.001 + 0.0005 is not 19 * 0.0005.
    assert ticks.time(19) == (0.0025 - 0.002) + 9 * 0.001
    assert Ticks([], 0.01).period == 0.01


def test_names_that_are_one_in_c_get_members_of_their_own():
    vectors = {"a b": [Signal("p")], "a_b": [Signal("q"), Signal("r")], "a-b": [Signal("s")]}
    found = identifiers(vectors)
    assert len(found) == 3
    assert list(found.values()) == list(vectors.values())
