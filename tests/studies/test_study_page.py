"""The page of a study: its numbers, its names, and what it does in a browser."""

import json
import re
import shlex
from html import unescape

import numpy as np
import pytest
from browser import needs_chromium, shown
from matplotlib.figure import Figure

from drake_dae import Record, Study, load_scenario, sweep
from drake_dae.cli import main
from drake_dae.errors import ModelError
from drake_dae.scenario.forms.typed_yaml import TAG
from drake_dae.scenario.shipped import find_scenario
from drake_dae.studies.results import Outcome, RunResult
from drake_dae.studies.run_names import run_name, setting

MARKUP = '</script><img src=x onerror="window.hit = 1">'


def study(count=6):
    changes = [{"a.b.mass": 1.0 + k, "surface": "plane" if k % 2 else MARKUP} for k in range(count)]
    results = [
        RunResult(k, Outcome.FINISHED, "", {"error [m]": float((7 * k) % count), "late": 0.5 * k})
        for k in range(count - 1)
    ]
    results.append(RunResult(count - 1, Outcome.FAILED, f"it fell {MARKUP}"))
    return Study(tuple(changes), tuple(results))


def data(page):
    (text,) = re.findall(r"const study = (.*);\n", page)
    return json.loads(text)


def test_a_page_has_the_numbers_of_the_study_and_nothing_from_outside(tmp_path):
    one = study()
    files = one.save(tmp_path, "title", [f"command {k}" for k in range(6)], 3.0)
    assert tmp_path / "study.html" in files
    page = (tmp_path / "study.html").read_text("utf-8")
    said, table = data(page), one.table()
    assert {c["name"]: c["values"] for c in said["columns"]} == {
        name: table[name] for name in ("a.b.mass", "surface", "outcome", "error [m]", "late")
    }
    assert said["bad"] == [False] * 5 + [True]
    assert said["again"][4] == "command 4"
    assert said["names"][1] == "b.mass=2, surface=plane"
    assert not re.search(r"https?://(?!www\.w3\.org/2000/svg)", page)
    assert MARKUP not in page
    assert "srcdoc=" in one._repr_html_()
    with pytest.raises(ModelError, match="6 runs need as many commands, got 1"):
        one.save(tmp_path, "title", ["command"])


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"a.b.mass": 9.654321}, "b.mass=9.6543"),
        ({"x.tool.mass": 1, "y.tool.mass": 2}, "x.tool.mass=1, y.tool.mass=2"),
        ({"gains.all": [-4, -8.0]}, "gains.all=[-4, -8.0]"),
        ({"on": True, "what": None, "text": "yes"}, "on=true, what=null, text='yes'"),
        ({}, ""),
    ],
)
def test_a_run_is_named_by_what_varies(changes, name):
    assert run_name(changes) == name


def test_the_command_of_a_run_makes_its_scenario():
    """As a shell splits it and `--set` reads it."""
    values = {
        "duration": 2.5,
        "start.errors.tool.z": -0.05,
        "constraints.0.surface": {TAG: "!Plane", "point": [1.2, 0, 0], "normal": [-1, 0, 0]},
        "description": "it's: a #1, {x}",
    }
    words = shlex.split(shlex.join(setting(*item) for item in values.items()))
    scenario = load_scenario(find_scenario("two_link_wall"), words)
    assert scenario.duration == 2.5
    assert scenario.start.errors["tool.z"] == -0.05
    assert scenario.description == "it's: a #1, {x}"


@pytest.mark.slow
def test_a_sweep_writes_the_page_and_its_commands_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = [
        "--set",
        "duration=0.1",
        "--vary",
        "start.errors.tool.z=0,0.02".replace(",", "..") + ":2",
    ]
    assert (
        main(["sweep", "two_link_wall", "--rollout", *words, "--workers", "1", "--out", "s"]) == 0
    )
    said = data((tmp_path / "s" / "study.html").read_text("utf-8"))
    assert said["duration"] == 0.1
    assert said["title"].startswith("two_link_wall: ")
    command = shlex.split(said["again"][1])
    assert command[0] == "drake-dae"
    assert main(command[1:]) == 0
    for name in ("animation.html", "outputs.png"):
        assert (tmp_path / "s" / "run1" / name).exists()
    errors = load_scenario(tmp_path / "s" / "run1" / "scenario.yaml").start.errors
    assert errors["tool.z"] == 0.02
    capsys.readouterr()


def test_a_study_of_a_scenario_says_how_its_runs_are_made_again(tmp_path):
    given = load_scenario(find_scenario("two_link_wall"), ["duration=0.1"])
    one = study(2)
    changes = ({"start.errors.tool.z": 0.0}, {"start.errors.tool.z": 0.02})
    Study(changes, one.results, given, True).save(tmp_path)
    said = data((tmp_path / "study.html").read_text("utf-8"))
    assert said["duration"] == 0.1
    words = shlex.split(said["again"][1])
    assert words[:4] == ["drake-dae", "simulate", str(tmp_path / "scenario.yaml"), "--rollout"]
    assert words[4:6] == ["--set", "start.errors.tool.z=0.02"]
    assert words[6:] == ["--set", "write.plots=true", "--out", str(tmp_path / "run1")]
    again = load_scenario(words[2], [words[5]])
    assert (again.duration, again.start.errors["tool.z"]) == (0.1, 0.02)
    assert again.references.keys() == given.references.keys()


@pytest.mark.slow
@pytest.mark.thorough
def test_a_sweep_in_python_says_how_its_runs_are_made_again(tmp_path):
    """The scenario stands beside the page, with what was set before."""
    given = load_scenario(find_scenario("two_link_wall"), ["duration=0.1", "start.errors={}"])
    runs = sweep(given, [{"start.errors.tool.z": 0.0}, {"start.errors.tool.z": 0.02}],
                 tmp_path / "runs.jsonl", workers=1, rollout=True)  # fmt: skip
    runs.save(tmp_path / "s")
    said = data((tmp_path / "s" / "study.html").read_text("utf-8"))
    assert said["duration"] == 0.1
    command = shlex.split(said["again"][1])
    assert command[:4] == ["drake-dae", "simulate", str(tmp_path / "s/scenario.yaml"), "--rollout"]
    assert main(command[1:]) == 0
    again = Record.load(tmp_path / "s" / "run1" / "record.npz")
    # The figure of the study is that of the run that was made again.
    (name,) = (n for n in runs.figures if "tool.z" in n and "largest" in n)
    error = np.abs(again["tracking_error"][:, 0]).max()
    assert runs.values(name)[1] == pytest.approx(error, rel=1e-6)


@needs_chromium
@pytest.mark.slow
def test_two_runs_stand_side_by_side_with_one_clock(tmp_path):
    study(3).save(tmp_path, "t", duration=2.0)
    for run in (0, 2):
        folder = tmp_path / f"run{run}"
        folder.mkdir()
        Figure(figsize=(1, 1)).savefig(folder / "outputs.png")
        tell = f"parent.postMessage({{run: {run}, after: event.data.after}}, '*')"
        text = f"<script>window.onmessage = event => {tell};</script>"
        (folder / "animation.html").write_text(text)
    script = """
      const frames = document.querySelectorAll('#picked iframe');
      if (!window.heard) {
        window.heard = {};
        window.addEventListener('message', ({data: {run, after}}) =>
          (window.heard[run] = window.heard[run] || []).push(after));
      }
      if (frames.length === 2 && !window.moved) {
        window.moved = true;
        setTimeout(() => {
          const slider = document.querySelector('#clock input');
          slider.value = 1.25;
          slider.dispatchEvent(new Event('input'));
          setTimeout(() => document.querySelector('#clock button').click(), 300);
        }, 500);
      }
      return JSON.stringify(window.heard);
    """
    told = json.loads(unescape(shown(tmp_path / "study.html", script, "#runs=0,2")))
    assert told["0"] == told["2"]
    assert told["0"][0] == 1.25
    # It plays on from there, forward.
    assert len(told["0"]) > 3
    assert told["0"][2] > 1.25


@needs_chromium
@pytest.mark.slow
def test_a_page_sorts_keeps_a_part_and_shows_a_run(tmp_path):
    study(40).save(tmp_path, "t", [f"command {k}" for k in range(40)])
    script = """
      if (!window.done) {
        window.done = true;
        const rows = () => [...document.querySelectorAll('tbody tr')].map(
          row => parseInt(row.firstChild.textContent));
        const head = name => [...document.querySelectorAll('th')].find(
          one => one.title === name).click();
        const found = {first: rows()};
        head('error [m]');
        found.sorted = rows();
        head('error [m]');
        found.back = rows();
        head('run');
        // Along the axis of the mass: its lower half.
        const area = document.querySelectorAll('svg .axis')[0].getBoundingClientRect();
        const at = share => ({clientX: area.left + 16, clientY: area.bottom - 6 -
          share * (area.height - 12), bubbles: true});
        document.querySelectorAll('svg .axis')[0].dispatchEvent(
          new PointerEvent('pointerdown', at(0)));
        window.dispatchEvent(new PointerEvent('pointermove', at(0.5)));
        window.dispatchEvent(new PointerEvent('pointerup', at(0.5)));
        found.kept = rows();
        document.querySelectorAll('tbody tr')[3].click();
        document.querySelectorAll('tbody tr')[5].click();
        found.picked = [...document.querySelectorAll('#picked pre')].map(one => one.textContent);
        found.hit = window.hit || 0;
        found.count = document.getElementById('count').textContent;
        window.found = JSON.stringify(found);
      }
      return window.found;
    """
    found = json.loads(shown(tmp_path / "study.html", script))
    assert found["first"] == list(range(40))
    errors = study(40).table()["error [m]"]
    wanted = sorted(range(39), key=lambda run: errors[run])
    assert found["sorted"] == [*wanted, 39]
    assert found["back"] == [*reversed(wanted), 39]  # What has no value stays last.
    assert found["kept"] == list(range(20))
    assert found["count"] == "20 of 40 runs are kept."
    assert found["picked"] == ["command 3", "command 5"]
    assert found["hit"] == 0
