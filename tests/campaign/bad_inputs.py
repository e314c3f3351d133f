"""Scenarios, robots and command lines with mistakes, read by what users read them with."""

import contextlib
import io
import os
import random
import re
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from campaign.outcomes import RAW, REFUSED, Outcome, checked

from drake_dae import build_scenario, load_scenario, simulate
from drake_dae.cli import main
from drake_dae.scenario.form import dump_yaml, load_yaml
from drake_dae.scenario.robot_file.reading import finalize, read_robot
from drake_dae.scenario.robot_file.robot import Robot
from drake_dae.scenario.shipped import FOLDER, shipped_scenarios
from drake_dae.systems.ideal_plants import DaePlant

ROBOTS = Path(__file__).parents[1] / "scenario" / "robots"
URDFS = {"two_link_arm": "two_link_wall", "five_bar": "five_bar"}
"""Model -> the scenario that reads it as a file."""

VALUES = {
    "nothing": None,
    "yes": True,
    "no number": float("nan"),
    "infinity": float("inf"),
    "minus infinity": float("-inf"),
    "huge": 1e300,
    "a huge integer": 10**40,
    "tiny": 1e-300,
    "zero": 0,
    "minus one": -1.0,
    "empty text": "",
    "text": "abc",
    "a number as text": "1.0",
    "text with nulls": "a\0b",
    "strange text": "ü$\u202e\n${x} {0} %s",
    "long text": "x" * 10_000,
    "an empty list": [],
    "a list": [1.0, 2.0],
    "a deep list": [[[[[1.0]]]]],
    "an empty mapping": {},
    "a mapping": {"a": 1.0},
    "an unknown tag": {"_tag": "!Nonsense", "a": 1.0},
    "another surface": {"_tag": "!Sphere", "center": [0, 0, 0], "radius": 1.0},
}

NUMBERS = (
    *("nan", "inf", "-inf", "-1", "0", "1e300", "1e-300", "1e-320", "1e3000", "1" * 400, "abc", ""),
    *("1 2", "0 0 0", "1,5", "1_0", "0x1", "\u0661", "\0", "--1", "1e"),
)

YAML_PIECES = (":", "- ", "[", "]", "{", "}", "&a ", "*a", "!X ", '"', "'", "#", "\t", "\n", "\0")
URDF_PIECES = ("<", ">", "/", '"', "&", "<robot>", "</link>", "<!--", "\0", "<joint/>", "<axis/>")


class BadInput(NamedTuple):
    """A scenario file with a mistake, in words, and whether what runs has the predicted error."""

    what: str
    path: Path
    is_exact: bool = True


def scenario_attempt(seed: int, folder: Path) -> Outcome:
    """Loads, builds and runs a bad scenario, or a good one of a bad robot, for some steps."""
    choice = random.Random(seed)
    kinds = _bad_values, _bad_structure, _bad_text, _bad_robot
    bad = choice.choices(kinds, (8, 3, 2, 4))[0](choice, folder)
    with checked(bad.what) as outcome:
        scenario = load_scenario(bad.path)
        loop, context = build_scenario(scenario)
        # What is slow by request shall not be slow here.
        scenario.integrator.target_realtime_rate = 0.0
        duration = min(scenario.duration, 0.01, 100 * scenario.integrator.max_step_size)
        simulate(loop.diagram, context, duration, scenario.integrator)
        record = loop.record(context)
        measured = scenario.sensors.force is not None or scenario.sampling is not None
        # (30) and (31) hold where the plant is what the law's model says, at all times.
        exact = not (scenario.plant.parameters or measured) and bad.is_exact
        is_ideal = isinstance(loop.plant, DaePlant)
        predicted = loop.predicted_error(record) if exact and is_ideal else None
        outcome.figures(record, predicted, is_ideal)
    return outcome


def _bad_values(choice: random.Random, folder: Path) -> BadInput:
    """Other values at one to three random places: what is wrong with one hides another."""
    data, told, is_lost = _shipped(choice), [], False
    count = choice.choice((1, 1, 1, 2, 3))
    for _ in range(count):
        place, key = choice.choice(list(_places(data)))
        name = choice.choice(list(VALUES))
        path, value = _path_of(data, place, key), VALUES[name]
        told.append(f"{path}: {name}")
        # What stands beside a large number is lost.
        is_lost |= isinstance(value, (int, float)) and abs(value) > 1e15
        place[key] = deepcopy(value)
    return BadInput("; ".join(told), _written(data, folder), count == 1 and not is_lost)


def _bad_structure(choice: random.Random, folder: Path) -> BadInput:
    """A key or an entry that is missing, has another name, is there twice, or changed places."""
    data = _shipped(choice)
    place, key = choice.choice(list(_places(data)))
    path = _path_of(data, place, key)
    how = choice.choice(("delete", "rename", "swap", "repeat", "move up"))
    if how == "rename" and isinstance(place, dict):
        new = choice.choice((f"{key}x", key[:-1] or "x", key.upper(), f" {key}", f"_{key}"))
        place[new] = place.pop(key)
        how = f"rename to '{new}'"
    elif how == "swap":
        other = choice.choice(list(place) if isinstance(place, dict) else range(len(place)))
        place[key], place[other] = place[other], place[key]
        how = f"swap with {other}"
    elif how == "repeat" and isinstance(place, list):
        place.insert(key, deepcopy(place[key]))
    elif how == "move up" and place is not data and str(key) not in data:
        data[str(key)] = place[key]
        del place[key]
    else:
        how = "delete"
        del place[key]
    return BadInput(f"{path}: {how}", _written(data, folder))


def _bad_text(choice: random.Random, folder: Path) -> BadInput:
    """Broken YAML."""
    path = choice.choice(list(shipped_scenarios().values()))
    text, how = _spoiled(path.read_text(), YAML_PIECES, choice)
    target = folder / "scenario.yaml"
    target.write_text(text)
    return BadInput(f"{path.stem}: {how}", target)


def _bad_robot(choice: random.Random, folder: Path) -> BadInput:
    """A broken URDF."""
    model = choice.choice(list(URDFS))
    text = (FOLDER / "models" / f"{model}.urdf").read_text()
    # Comments are no place for mistakes.
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    if choice.random() < 0.6:
        found = choice.choice(list(re.finditer(r'([\w:]+)="([^"]*)"', text)))
        new = choice.choice(NUMBERS)
        text = f"{text[: found.start(2)]}{new}{text[found.end(2) :]}"
        how = f'{found[0]} at {found.start()} becomes "{new}"'
    elif choice.random() < 0.5:
        lines = text.splitlines(keepends=True)
        index = choice.randrange(len(lines))
        how = f"without line {index + 1}, {lines[index].strip()}"
        text = "".join(lines[:index] + lines[index + 1 :])
    else:
        text, how = _spoiled(text, URDF_PIECES, choice)
    (folder / "robot.urdf").write_text(text)
    data = load_yaml(shipped_scenarios()[URDFS[model]].read_text(), model)
    data["robot"] = {"file": "robot.urdf"}
    return BadInput(f"{model}: {how}", _written(data, folder))


def _spoiled(text: str, pieces: tuple[str, ...], choice: random.Random) -> tuple[str, str]:
    """A text with a piece more, or damaged."""
    if choice.random() < 0.33:
        place, piece = choice.randrange(len(text)), choice.choice(pieces)
        return text[:place] + piece + text[place:], f"{piece!r} at {place}"
    data, how = _damaged(text.encode(), choice)
    return data.decode("utf-8", errors="replace"), how


def _damaged(data: bytes, choice: random.Random) -> tuple[bytes, str]:
    """Bytes that end too early, or lack, have or change something in the middle."""
    place = choice.randrange(max(1, len(data)))
    how = choice.choice(("cut", "gap", "insert", "change", "twice"))
    if how == "cut":
        return data[:place], f"cut at {place}"
    if how == "twice":
        return data + data, "twice"
    if how == "gap":
        end = place + choice.randrange(1, 40)
        return data[:place] + data[end:], f"without {data[place:end]!r} at {place}"
    some = bytes(choice.randrange(256) for _ in range(choice.randint(1, 4)))
    rest = data[place:] if how == "insert" else data[place + len(some) :]
    return data[:place] + some + rest, f"{how} {some!r} at {place}"


def _shipped(choice: random.Random) -> Any:
    # Small ones more often: a 7-joint robot takes a second.
    names = sorted(shipped_scenarios())
    name = choice.choices(names, [1 if "seven" in name or "arms" in name else 4 for name in names])
    return load_yaml(shipped_scenarios()[name[0]].read_text(), name[0])


def _places(data: Any) -> Iterator[tuple[Any, Any]]:
    """All (container, key) of plain data."""
    for key in list(data) if isinstance(data, dict) else range(len(data)):
        if key != "_tag":
            yield data, key
            if isinstance(data[key], (dict, list)):
                yield from _places(data[key])


def _path_of(data: Any, place: Any, key: Any) -> str:
    """The dotted key of an entry of a container in plain data."""
    if place is data:
        return str(key)
    for outer in list(data) if isinstance(data, dict) else range(len(data)):
        inner = data[outer]
        if isinstance(inner, (dict, list)):
            found = _path_of(inner, place, key)
            if found:
                return f"{outer}.{found}"
    return ""


def _written(data: Any, folder: Path) -> Path:
    path = folder / "scenario.yaml"
    try:
        text = dump_yaml(data)
    except (yaml.YAMLError, AttributeError, TypeError):  # What has no tag as YAML.
        text = yaml.safe_dump(data)
    path.write_text(text)
    return path


# Files and commands.


def file_attempt(seed: int, folder: Path) -> Outcome:
    """Reads a bad robot, or runs a bad command."""
    choice = random.Random(seed)
    return choice.choices((_any_robot, _command), (4, 5))[0](choice, folder)


def _any_robot(choice: random.Random, folder: Path) -> Outcome:
    """An SDFormat, MJCF, URDF or directives file with something damaged, or with a loop."""
    shipped = ("three_fingers.dmd.yaml", "boom.urdf", "held_box.urdf")
    files = [ROBOTS / name for name in ("five_bar.sdf", "leaning_arm.xml")]
    file = choice.choice([*files, *(FOLDER / "models" / name for name in shipped)])
    text = file.read_text("utf-8")
    numbers = [i for i, word in enumerate(text.split(" ")) if any(c.isdigit() for c in word)]
    how = choice.choice(("damage", "damage", "number", "number", "line", "include"))
    if how == "number" and numbers:
        words = text.split(" ")
        place, new = choice.choice(numbers), choice.choice(NUMBERS)
        words[place], how = new, f"{words[place][:20]!r} becomes {new[:8]!r}"
        text = " ".join(words)
    elif how == "include":
        loops = {
            ".sdf": "<include><uri>package://mine/robot.sdf</uri></include>",
            ".xml": '<include file="robot.xml"/>',
        }
        place = text.rfind("</")
        text = text[:place] + loops.get(file.suffix, "<include/>") + text[place:]
    else:
        text, how = _spoiled(text, URDF_PIECES, choice)
    name = "robot" + "".join(file.suffixes)
    (folder / name).write_text(text, "utf-8")
    (folder / "package.xml").write_text("<package format='2'><name>mine</name></package>")

    with checked(f"{file.name}: {how}") as outcome:
        finalize(read_robot(Robot(file=str(folder / name)))[0])
    return outcome


WORDS = (
    *("two_link_wall", "no_such", "", ".", "/dev/zero", "a\u00e9", "--set", "--set=duration=0.01"),
    *("--set=duration=-1", "--set=duration=1e400", "--set=duration=1_0", "--set=a.b=1", "--set=="),
    *("--set=write={}", "--set=start={}", "--set=sampling={period: 0.001, delay: 1.0e+6}"),
    "--set=references={tool.z: !Csv {file: /dev/zero, columns: [z]}}",
    '--set=constraints.0.name="\\ud800"',
    *("--out=", "--out", "--out=results", "--out=/dev/null/a", "--json", "--check", "--rollout"),
    *("--force", "--nonsense", "-h", "--surface=plane", "--surface=cube", "--tip=a:1,2,nan"),
    *("--tip=a:1_0,2,3", "--tip=:1,2,3", "--path"),
)

VARY = (
    *("start.errors.tool.z=-1e308..1e308:3", "start.errors.tool.z=0..1e300:2", "a=", "="),
    *("law.gains.all=[]", "law.gains.all=0..1:999999999", "sensors.force.seed=0..1e300"),
    *("duration=1..0:3", "duration=1..2", "duration=[nothing, 1]", "duration=[[[[1]]]]"),
    *("duration=nan..1:2", "x=[1, [2]]", "plant.parameters.no=[1]"),
)


def _command(choice: random.Random, folder: Path) -> Outcome:
    """A command line with random words, as far as it goes in a moment."""
    names = "simulate", "analyze", "sweep", "plot", "play", "new", "print", "list", "export"
    command = choice.choice(names)
    words = [command, *choice.sample(WORDS, choice.randint(0, 3))]
    if command == "sweep":
        words.append(f"--vary={choice.choice(VARY)}")
        words += choice.choice(([], ["--random=2"], ["--together"]))
    if command in ("simulate", "export") and not any(w.startswith("--out") for w in words):
        words.append("--out=results")
    if command in ("simulate", "sweep", "analyze", "export"):
        quick = ["--set=duration=0.01", "--set=write={plots: false, animation: false}"]
        words[1:1] = ["two_link_wall", *quick] if choice.random() < 0.7 else quick
    told, here = io.StringIO(), os.getcwd()
    with checked(f"drake-dae {' '.join(words)}"[:200]) as caught:
        os.chdir(folder)
        try:
            with contextlib.redirect_stdout(told), contextlib.redirect_stderr(told):
                code = main(words)
        except SystemExit as error:
            code = error.code
        finally:
            os.chdir(here)
        text = told.getvalue()
        if code in (1, 2) and ("error: " in text or "PROBLEM" in text):
            caught.kind, caught.text = REFUSED, text[-200:]
        elif code and not (code == 2 and "--check" in words):  # It may have missed its task.
            caught.kind, caught.text = RAW, f"exit code {code}: {text[-200:]}"
    return caught
