"""What commands tell programs, JSON and exit codes, and what of earlier runs they keep."""

import json

import numpy as np
import pytest

from drake_dae import Record, load_scenario
from drake_dae.cli import main
from drake_dae.running import export as exported
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.shipped import find_scenario
from drake_dae.scenario.start import start_scenario

BARE = ("--set=write.plots=false", "--set=write.animation=false")
QUICK = ("--set=duration=0.2", *BARE)


def told(arguments, capsys):
    """The exit code, and what was printed as JSON."""
    code = main([*map(str, arguments)])
    return code, json.loads(capsys.readouterr().out)


MISSED = {
    # Steps of 0.05 s are too long for Euler's method, and nothing else is wrong.
    "without a reason": [
        "--set=integrator={integration_scheme: explicit_euler, use_error_control: false, "
        "max_step_size: 0.05}",
        "--set=duration=2",
    ],
    # The force would pull: -5 N.
    "a contact that pulls": ["--set=references.wall.force=-5", "--set=duration=0.2"],
    # The mass is another one, to the end.
    "a plant that the law does not know": [
        "--set=plant.parameters={link1.mass: 20}",
        "--set=duration=1",
    ],
}


@pytest.mark.slow
@pytest.mark.parametrize("reason", MISSED)
def test_a_run_that_missed_its_task_is_reported_by_code_and_json(reason, tmp_path, capsys):
    run = ["simulate", "two_link_wall", "--json", *BARE, *MISSED[reason]]
    code, found = told([*run, "--check", f"--out={tmp_path / 'one'}"], capsys)
    assert (code, found["missed"]) == (2, True)
    assert found["outcome"] == "bad"
    kinds = {one["kind"] for one in found["findings"]}
    assert ("prediction" in kinds) is (reason != "a contact that pulls")
    # Whoever does not ask gets 0 for a run that came to its end.
    code, again = told([*run, f"--out={tmp_path / 'two'}"], capsys)
    assert (code, again["missed"]) == (0, True)


def test_a_good_run_is_reported_with_figures_and_files(tmp_path, capsys):
    arguments = ["simulate", "two_link_wall", "--json", "--check", *QUICK, f"--out={tmp_path}"]
    code, found = told(arguments, capsys)
    assert code == 0
    assert found["folder"] == str(tmp_path)
    assert (found["missed"], found["outcome"]) == (False, "good")
    assert sorted(found["files"]) == sorted(path.name for path in tmp_path.iterdir())
    record = Record.load(tmp_path / "record.npz")
    assert found["simulated_time"] == pytest.approx(record.time[-1])
    outputs = {one["name"]: one for one in found["outputs"]}
    assert [*outputs] == [s.name for s in record.signals["tracking_error"].signals]
    assert 0.0 <= max(one["off_prediction"] for one in outputs.values()) < 1e-6


# What it takes.


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["simulate", "--out", ""], "--out"),
        (["sweep", "--vary", "a=1", "--out="], "--out"),
        (["play", ""], "RUN"),
        (["sweep", "--vary", "a=1", "--random=x"], "'x'"),
    ],
)
def test_words_that_mean_nothing_are_wrong_usage(arguments, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


# Where it starts.


@pytest.mark.slow
def test_all_commands_start_at_the_same_state(tmp_path, monkeypatch):
    """Also where start.positions are left out, and the robot's default leads elsewhere."""
    found = {}

    def kept(loop, context, *_):
        own = loop.plant.GetMyContextFromRoot(context)
        found["export"] = own.get_continuous_state_vector().CopyToVector()
        return [tmp_path / "loop.c"]

    monkeypatch.setattr(exported, "export_loop", kept)
    settings = ["--set=start={}", "--set=duration=0.01", *BARE]
    assert main(["export", "two_link_wall", *settings, f"--out={tmp_path / 'code'}"]) == 0
    assert main(["simulate", "two_link_wall", *settings, f"--out={tmp_path / 'run'}"]) == 0
    first = Record.load(tmp_path / "run" / "record.npz")["state"][0]
    np.testing.assert_allclose(found["export"], first, atol=1e-9)
    # And a loop that is started by what it was built from.
    scenario = load_scenario(find_scenario("two_link_wall"), ["start={}"])
    _, loop = build_completed(scenario)
    context = start_scenario(scenario, loop)
    own = loop.plant.GetMyContextFromRoot(context)
    state = own.get_continuous_state_vector().CopyToVector()
    np.testing.assert_allclose(state, first, atol=1e-9)
