"""Scenarios and robots with one mistake each: mutations of what the package ships."""

import random
import re
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any

import yaml
from campaign.outcomes import Outcome, checked

from drake_dae import build_scenario, load_scenario, simulate
from drake_dae.scenario.scenario import Scenario
from drake_dae.scenario.shipped import FOLDER, shipped_scenarios
from drake_dae.scenario.typed_yaml import dump_yaml, load_yaml
from drake_dae.systems.plants.dae_plant import DaePlant

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

SIGNED = re.compile(
    r"values|offset|amplitudes|frequencies|phases|goal|start_time|positions|errors|point|normal|"
    r"start\.\d|end\.\d|center|axis|translation|rpy_deg|bias|gain$|plant\.parameters|seed|torque_constant|gear_ratio|geometry"
)
"""Keys where zero or a negative number is as good as any other."""

_NUMBERS_EACH = re.compile(r"actuation.*(stiffness|inertia|resistance|constant|ratio|damping|geom)")
"""Keys of one number for all joints, or one for each."""

LOST = "so large that what stands beside it is lost"

NUMBERS = ("nan", "inf", "-1", "0", "1e300", "1e-300", "abc", "", "1 2", "0 0 0", "1,5", "1e3000")

YAML_PIECES = (":", "- ", "[", "]", "{", "}", "&a ", "*a", "!X ", '"', "'", "#", "\t", "\n", "\0")
URDF_PIECES = ("<", ">", "/", '"', "&", "<robot>", "</link>", "<!--", "\0", "<joint/>", "<axis/>")


@dataclass(frozen=True)
class BadInput:
    """A scenario file with a mistake.

    Attributes:
        what: The mistake in words.
        path: The file.
        excuse: Why it may run all the same; empty if it must be refused.
    """

    what: str
    path: Path
    excuse: str


def bad_input(seed: int, folder: Path) -> BadInput:
    """Writes a scenario, and its robot if the mistake is there, into a folder."""
    choice = random.Random(seed)
    kinds = _bad_value, _bad_structure, _bad_text, _bad_robot, _bad_values
    kind = choice.choices(kinds, (5, 3, 2, 4, 3))[0]
    return kind(choice, folder)


def attempt(seed: int, folder: Path) -> Outcome:
    """Loads, builds and runs a bad input for some steps."""
    bad = bad_input(seed, folder)
    with checked(bad.what) as outcome:
        scenario = load_scenario(bad.path)
        loop, context = build_scenario(scenario)
        # What is slow by request shall not be slow here.
        scenario.integrator.target_realtime_rate = 0.0
        duration = min(scenario.duration, 0.01, 100 * scenario.integrator.max_step_size)
        simulate(loop.diagram, context, duration, scenario.integrator)
        record = loop.record(context)
        exact = _is_exact(scenario) and bad.excuse != LOST
        is_ideal = isinstance(loop.plant, DaePlant)
        predicted = loop.predicted_error(record) if exact and is_ideal else None
        outcome.figures(record, predicted, is_ideal)
        outcome.accepted(bad.excuse)
    return outcome


def _is_exact(scenario: Scenario) -> bool:
    """Whether the plant is what the law's model says, at all times, so that (30) and (31) hold."""
    measured = scenario.sensors.force is not None or scenario.sampling is not None
    return not (scenario.plant.parameters or measured)


# One mistake each, and why what it makes may run.


def _bad_value(choice: random.Random, folder: Path) -> BadInput:
    """Another value at a random place."""
    data = _shipped(choice)
    place, key = choice.choice(list(_places(data)))
    name = choice.choice(list(VALUES))
    before, after = place[key], VALUES[name]
    place[key] = deepcopy(after)
    path = _path_of(data, place, key)
    return BadInput(
        f"{path}: {name}", _written(data, folder), _excuse_of_value(path, before, after)
    )


def _bad_values(choice: random.Random, folder: Path) -> BadInput:
    """Other values at two or three random places: what is wrong with one hides another."""
    data, told = _shipped(choice), []
    for _ in range(choice.randint(2, 3)):
        place, key = choice.choice(list(_places(data)))
        name = choice.choice(list(VALUES))
        told.append(f"{_path_of(data, place, key)}: {name}")
        place[key] = deepcopy(VALUES[name])
    return BadInput("; ".join(told), _written(data, folder), LOST)


def _excuse_of_value(path: str, before: Any, after: Any) -> str:
    if before == after and type(before) is type(after):
        return "it is what it was"
    if path.startswith(("references.", "exogenous.")) and _is_constant(after):
        return "a number is a constant reference" if abs(after) <= 1e15 else LOST
    if path.startswith("law.gains.") and before == after:
        return "it is what it was"
    if path.startswith("law.gains.") and isinstance(before, float) and after == -1.0:
        return "another pole, or a gain that is refused where it makes errors grow"
    if after is None and path.split(".")[-1] in _OR_NOTHING:
        return "nothing is its default"
    if path == "description" or path.endswith(".name"):
        return "any text is a name" if isinstance(after, str) else ""
    if isinstance(after, (list, dict)):
        fits = type(before) is type(after) or _NUMBERS_EACH.search(path)
        return "a list or mapping that fits there" if fits else ""
    if isinstance(before, bool) and isinstance(after, bool):
        return "a switch has two positions"
    if isinstance(after, bool) or not isinstance(after, (int, float)) or not isfinite(after):
        return ""
    if path.startswith(("references", "actuation")) and abs(after) > 1e15:
        return LOST
    if isinstance(before, (int, float)) and (SIGNED.search(path) or after > 0):
        return "another finite number with a meaning"
    return ""


_OR_NOTHING = ("gains", "integral", "estimator", "task", "forces", "effort_limit", "friction")
"""Keys that may hold nothing."""


def _is_constant(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and isfinite(value)


def _bad_structure(choice: random.Random, folder: Path) -> BadInput:
    """A key or an entry that is missing, has another name, is there twice, or changed places."""
    data = _shipped(choice)
    place, key = choice.choice(list(_places(data)))
    path = _path_of(data, place, key)
    how = choice.choice(("delete", "rename", "swap", "repeat", "move up"))
    excuse = ""
    if how == "rename" and isinstance(place, dict):
        new = choice.choice((f"{key}x", key[:-1] or "x", key.upper(), f" {key}", f"_{key}"))
        place[new] = place.pop(key)
        how = f"rename to '{new}'"
        if place is data and new.startswith("_"):
            excuse = "a place for anchors; the key has a default"
        if place is data.get("references") and new.startswith(" "):
            excuse = "names of outputs stand in a list, with spaces between them"
    elif how == "swap":
        other = choice.choice(list(place) if isinstance(place, dict) else range(len(place)))
        place[key], place[other] = place[other], place[key]
        how, excuse = f"swap with {other}", "both are as good there"
    elif how == "repeat" and isinstance(place, list):
        place.insert(key, deepcopy(place[key]))
        excuse = "a list may be longer, with another meaning"
    elif how == "move up" and place is not data and str(key) not in data:
        data[str(key)] = place[key]
        del place[key]
    else:
        how, excuse = "delete", "it has a default"
        del place[key]
    return BadInput(f"{path}: {how}", _written(data, folder), excuse)


def _bad_text(choice: random.Random, folder: Path) -> BadInput:
    """Broken YAML."""
    path = choice.choice(list(shipped_scenarios().values()))
    text, how = _spoiled(path.read_text(), YAML_PIECES, choice)
    target = folder / "scenario.yaml"
    target.write_text(text)
    return BadInput(f"{path.stem}: {how}", target, "what is left is a scenario")


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
        element = re.findall(r"<([?\w:]+)", text[: found.start()])[-1]
        how = f'{element} {found[0]} becomes "{new}"'
        excuse = _excuse_of_attribute(element, found[1], new)
        if new == found[2]:
            excuse = "it is what it was"
    elif choice.random() < 0.5:
        lines = text.splitlines(keepends=True)
        index = choice.randrange(len(lines))
        how = f"without line {index + 1}, {lines[index].strip()}"
        excuse = "what is left is a robot"
        text = "".join(lines[:index] + lines[index + 1 :])
    else:
        text, how = _spoiled(text, URDF_PIECES, choice)
        excuse = "what is left is a robot"
    (folder / "robot.urdf").write_text(text)
    data = load_yaml(shipped_scenarios()[URDFS[model]].read_text(), model)
    data["robot"] = {"file": "robot.urdf"}
    return BadInput(f"{model}: {how}", _written(data, folder), excuse)


def _excuse_of_attribute(element: str, name: str, new: str) -> str:
    if element in ("?xml", "transmission"):
        return "Drake does not read it"
    if element in ("color", "material", "cylinder", "box", "sphere", "limit", "robot", "dynamics"):
        return "a drawing, a limit or friction: Drake takes it, or leaves it out"
    if (element, name) in (("link", "name"), ("joint", "name"), ("actuator", "name")):
        return "any text is a name"
    try:
        numbers = [float(word) for word in new.split()]
    except ValueError:
        return ""
    if element in ("mass", "inertia"):
        return "another inertia" if all(0 < x < 1e299 for x in numbers) else ""
    return "another finite number" if all(isfinite(x) for x in numbers) else ""


def _spoiled(text: str, pieces: tuple[str, ...], choice: random.Random) -> tuple[str, str]:
    """A text that ends too early, or lacks or has something in the middle."""
    place = choice.randrange(len(text))
    how = choice.choice(("cut", "gap", "insert"))
    if how == "cut":
        return text[:place], f"cut at {place}"
    if how == "gap":
        end = place + choice.randrange(1, 40)
        return text[:place] + text[end:], f"without {text[place:end]!r} at {place}"
    piece = choice.choice(pieces)
    return text[:place] + piece + text[place:], f"{piece!r} at {place}"


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
