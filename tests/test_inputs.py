"""Inputs that were accepted, hung or ended in exceptions of others: each refused, with words."""

import os

import numpy as np
import pytest
from arms import arm, fixed_step
from pydrake.systems.analysis import SimulatorConfig
from runs import scenario

from drake_dae import (
    ConstantReference,
    DcMotors,
    Encoders,
    FlexibleJoints,
    Parameter,
    Record,
    RobotPlant,
    build_scenario,
    load_scenario,
    make_animation,
    simulate,
)
from drake_dae.arrays import brief
from drake_dae.errors import DrakeDaeError, ModelError, NonFiniteError, ScenarioError
from drake_dae.running import export_loop, start_values
from drake_dae.scenario.form import load_yaml

LAUGHS = "a0: &a0 [lol, lol, lol, lol, lol, lol, lol, lol, lol]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 10)
)

YAML = {
    "a billion laughs": (LAUGHS, "line .*100000"),
    "laughs in merged keys": ("a: &a {x: 1}\n" + LAUGHS.replace("lol", "*a"), "100000"),
    "an alias inside of itself": ("a: &a [*a]", "file: too many lists"),
    "5,000 brackets": ("[" * 5000 + "]" * 5000, "file: "),
    "two megabytes": ("a: " + "x" * 2_000_000, "1000000"),
    "a date that is none": ("a: !!timestamp abc", "file: .*!!"),
    "a whole number that is none": ("a: !!int ''", "file: .*!!"),
    "a number that is none": ("a: !!float ''", "file: .*!!"),
    "values without brackets": ("[-4], [-8]", r"\[\["),
    "a null byte": ("a: \0", "file: "),
}


@pytest.mark.parametrize("what", YAML)
def test_yaml_without_end_or_sense_is_refused(what):
    text, message = YAML[what]
    with pytest.raises(ScenarioError, match=message) as caught:
        load_yaml(text, "file")
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize("text", ["1:30", "1_000", "010", "\uff11\uff12"])
def test_numbers_that_only_yaml_1_1_reads_are_text(text):
    assert load_yaml(f"a: {text}", "file") == {"a": text}
    with pytest.raises(ScenarioError, match="duration: "):
        scenario("two_link_wall", f"duration={text}")


@pytest.mark.parametrize("text", ["-3", "+2", ".5", "-1.e3", "2E5"])
def test_numbers_of_json_stay_numbers(text):
    assert load_yaml(f"a: {text}", "file") == {"a": float(text)}


def test_messages_are_short_whatever_the_value_is():
    deep = ["x"] * 9
    for _ in range(9):
        deep = [deep] * 9
    for value in (deep, "x" * 10**6, {i: deep for i in range(10**4)}, np.zeros(10**6), object()):
        assert len(brief(value)) <= 200


def test_paths_that_are_none(tmp_path, monkeypatch):
    for path in ("a\0b", "x" * 5000):
        with pytest.raises(ScenarioError):
            load_scenario(path)
    for setting in ('robot.file="a\\0b"', 'robot.packages={a: "a\\0b"}'):
        with pytest.raises(ScenarioError):
            build_scenario(scenario("two_link_wall", setting))
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    if not os.path.exists(os.curdir):
        with pytest.raises(ScenarioError):
            load_scenario("scenario.yaml")


def test_a_context_of_another_loop_is_refused_in_a_sentence(tmp_path):
    """Drake's own text of it has no remedy, and a link to an issue."""
    (loop, _), (other, context) = (build_scenario(scenario("two_link_wall")) for _ in "ab")
    own = other.plant.GetMyMutableContextFromRoot(context)
    for refused in (
        lambda: simulate(loop.diagram, context, 0.01),
        lambda: loop.record(context),
        lambda: loop.set_state(context, arm("two_link").structure.states[0]),
        lambda: loop.plant.get_parameter(own, "link1.mass"),
        lambda: loop.plant.set_parameter(own, "link1.mass", 2.0),
        lambda: start_values(loop, context),
        lambda: export_loop(loop, context, "a", tmp_path),
        lambda: make_animation(loop, loop.record(loop.diagram.CreateDefaultContext()), context),
    ):
        with pytest.raises(ModelError, match=r"'(closed_loop|two_link_arm)'"):
            refused()


@pytest.mark.parametrize(
    ("make", "kept"),
    [
        (lambda a: FlexibleJoints(a), "stiffness"),
        (lambda a: Encoders(resolution=a), "resolution"),
        (lambda a: DcMotors(a, 1.0, 1.0), "torque_constant"),
        (lambda a: ConstantReference(a), "values"),
        (lambda a: Record(a, {}), "time"),
        (lambda a: Parameter("a", a), "value"),
    ],
)
def test_what_is_made_of_a_callers_array_does_not_change_with_it(make, kept):
    given = np.array([1.0, 2.0])
    made = make(given)
    given[:] = -1.0
    np.testing.assert_array_equal(np.ravel(getattr(made, kept)), [1.0, 2.0])


@pytest.mark.parametrize("start", [np.nan, np.inf, 1e18])
def test_a_start_from_which_time_does_not_go_on_is_refused(start):
    plant = RobotPlant(arm("two_link").model, structure=arm("two_link").structure)
    config = SimulatorConfig(max_step_size=0.01, use_error_control=False, start_time=start)
    with pytest.raises(ModelError, match="start_time"):
        simulate(plant, plant.CreateDefaultContext(), 1.0, config)


def test_a_lag_that_is_none_ends_the_run_and_leaves_a_finite_record():
    chosen = scenario("two_link_wall", "sensors.force={time_constant: 1e-300}", "duration=0.1")
    loop, context = build_scenario(chosen)
    with pytest.raises((NonFiniteError, DrakeDaeError)):
        simulate(loop.diagram, context, chosen.duration, fixed_step())
    record = loop.record(context)
    for recorded in record.signals.values():
        assert np.isfinite(recorded.values).all()
