"""What the runs of a study have different from each other: scenario keys with their values."""

import re
import shlex
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import product
from math import isfinite, prod
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, brief, check_whole_number, vector
from drake_dae.errors import ScenarioError
from drake_dae.scenario.files import varied_data
from drake_dae.scenario.forms.typed_yaml import dump_yaml, load_yaml
from drake_dae.scenario.scenario import Scenario, read_scenario, scenario_data

MOST_RUNS = 1_000_000
"""A study has no more runs than these: they would take weeks."""

Variation = dict[str, Any]
"""Dotted key of a scenario -> its value in one run, as plain data."""


def _error(text: str) -> ScenarioError:
    return ScenarioError(("", text))


@checked(_error)
def grid_variations(values: Mapping[str, Any]) -> list[Variation]:
    """Every combination of some values of some keys; those of the last key change first.

    Args:
        values: Dotted key -> its values, for example {"start.errors.tool.z": [0.0, 0.05]}.

    Raises:
        ScenarioError: A key has no values, or there are more than a million combinations.
    """
    columns = {key: _values(key, given) for key, given in values.items()}
    _check_count(prod(map(len, columns.values())))
    return [dict(zip(columns, chosen, strict=True)) for chosen in product(*columns.values())]


@checked(_error)
def random_variations(ranges: Mapping[str, Any], count: int, seed: int = 0) -> list[Variation]:
    """Random values of some keys, the same for the same seed.

    What a key draws depends on the seed and its own name alone: a study with more runs, or with
    another key, has the runs of the first one.

    Args:
        ranges: Dotted key -> a tuple (low, high) for numbers in between, all equally likely; a
            `range` for its whole numbers; any list for one of its values. A text "low..high" within
            such a value, as in [["0.69..0.71", 0.0, 0.0]], is a number in between.
        count: How many runs.
        seed: The seed, from 0.

    Raises:
        ScenarioError: A range is empty, or count or seed makes no sense.
    """
    _whole("count", count, 1)
    _whole("seed", seed, 0)
    _check_count(count)
    columns = {key: _drawn(key, given, count, seed) for key, given in ranges.items()}
    return [{key: column[i] for key, column in columns.items()} for i in range(count)]


@checked(_error)
def listed_variations(values: Mapping[str, Any]) -> list[Variation]:
    """The first values of all keys together, then the second ones, and so on.

    Args:
        values: Dotted key -> its values, as many for each key.

    Raises:
        ScenarioError: The keys have different numbers of values, or none.
    """
    columns = {key: _values(key, given) for key, given in values.items()}
    counts = {key: len(column) for key, column in columns.items()}
    if len(set(counts.values())) > 1:
        counted = ", ".join(f"{key} has {count}" for key, count in counts.items())
        raise _error(f"keys that vary together need as many values each; {counted}")
    return [
        dict(zip(columns, chosen, strict=True)) for chosen in zip(*columns.values(), strict=True)
    ]


def parse_variations(
    texts: Sequence[str], scenario: Scenario, count: int | None, seed: int, together: bool
) -> list[Variation]:
    """The runs that options "KEY=VALUES" of the command line ask for.

    VALUES is a list in YAML, one value, LOW..HIGH:COUNT for as many even values, or, where runs are
    random, LOW..HIGH, which may then stand within a value, too.

    Args:
        texts: The options.
        scenario: What varies.
        count: How many random runs; None for a grid.
        seed: The seed of the random runs.
        together: Whether the values of all keys change together, instead of a grid.

    Raises:
        ScenarioError: An option cannot be read, or its values are empty.
    """
    columns = _columns(texts, scenario, count is not None)
    if count is not None:
        return random_variations(columns, count, seed)
    return listed_variations(columns) if together else grid_variations(columns)


def parse_ranges(texts: Sequence[str], scenario: Scenario) -> dict[str, tuple[float, float]]:
    """The ranges that options "KEY=LOW..HIGH" of the command line name.

    Raises:
        ScenarioError: An option cannot be read, or is no range of numbers.
    """
    columns = _columns(texts, scenario, True)
    for key, given in columns.items():
        if not isinstance(given, tuple):
            raise _wrong(key, "expected LOW..HIGH, of a key that takes any number in between")
    return columns


def _columns(texts: Sequence[str], scenario: Scenario, is_random: bool) -> dict[str, Any]:
    """What options "KEY=VALUES" name."""
    data, columns = scenario_data(scenario), dict[str, Any]()
    for text in texts:
        key, separator, given = text.partition("=")
        if not (separator and given.strip() and all(key.split("."))):
            raise _wrong(text, "expected KEY=VALUES, for example start.errors.tool.z=0..0.05:6")
        if key in columns:
            raise _wrong(key, "the key varies twice; give all its values at once")
        columns[key] = _parse(key, given, data, is_random)
    return columns


_NUMBER = r"([-+]?[0-9]+(?:\.[0-9]+)?(?:[eE][-+]?[0-9]+)?)"
_INTERVAL = re.compile(rf"\s*{_NUMBER}\.\.{_NUMBER}(?::([0-9]{{1,9}}))?\s*")


def _parse(key: str, text: str, data: Mapping[str, Any], is_random: bool) -> Any:
    found = _INTERVAL.fullmatch(text)
    if not found:
        value = load_yaml(text, key)
        return value if isinstance(value, list) else [value]
    low, high = _ends(key, found)
    if found[3]:
        number = int(found[3])
        if number < 2:
            raise _wrong(key, f"a range has at least 2 values, got {text.strip()}")
        _check_count(number)
        values = np.linspace(low, high, number).tolist()
        is_whole = all(value.is_integer() for value in values)
        return [int(value) for value in values] if is_whole else values
    if not is_random:
        raise _wrong(
            key,
            f"{text.strip()} needs the number of its values, {text.strip()}:11, or --random COUNT",
        )
    if low.is_integer() and high.is_integer() and _is_whole_number(key, low, high, data):
        return range(int(low), int(high) + 1)
    return low, high


def _ends(key: str, found: re.Match[str]) -> tuple[float, float]:
    """The ends of an interval."""
    low, high = (float(found[1]), float(found[2]))
    if not (np.isfinite([low, high]).all() and low < high):
        text = found[0].strip()
        raise _wrong(key, f"{text} is an empty range; the first number is the lower one")
    _check_width(key, low, high)
    return low, high


def _check_width(key: str, low: float, high: float) -> None:
    if not isfinite(float(high) - float(low)):
        raise _wrong(key, f"the range from {low:g} to {high:g} is wider than the largest number")


def _is_whole_number(key: str, low: float, high: float, data: Mapping[str, Any]) -> bool:
    """Whether a scenario takes whole numbers only."""

    def takes(value: float) -> bool:
        try:
            read_scenario(varied_data(data, {key: value}))
        except ScenarioError:
            return False
        return True

    return takes(int(low)) and not takes(low + (high - low) / 2**0.5)


def _values(key: str, given: Any) -> list[Any]:
    """Values as plain data."""
    if isinstance(given, np.ndarray) and given.ndim:
        given = list(given)
    if not isinstance(given, (list, tuple, range)):
        raise _wrong(key, f"expected a list of values, got {brief(given)}")
    if not given:
        raise _wrong(key, "expected at least one value")
    try:
        _check_count(len(given))
    except OverflowError:  # Of a range.
        raise _wrong(key, f"{brief(given)} has more values than a study has runs") from None
    return [plain(key, value) for value in given]


def _drawn(key: str, given: Any, count: int, seed: int) -> list[Any]:
    random = np.random.default_rng([seed, crc32(key.encode())])
    if isinstance(given, tuple):
        low, high = vector(f"the range of {key}", given, 2)
        if not low < high:
            raise _wrong(key, f"the range {brief(given)} is empty; the first is the lower one")
        _check_width(key, low, high)
        share = random.random(count)
        return (low * (1.0 - share) + high * share).tolist()
    # One number of the generator for each value, so that more runs begin with the same ones.
    if isinstance(given, range) and given:
        if given[-1] - given[0] > 2**53:
            raise _wrong(key, f"{brief(given)} has more whole numbers than can be drawn from")
        return [given[int(len(given) * share)] for share in random.random(count)]
    values = _values(key, given)
    chosen = [values[int(len(values) * share)] for share in random.random(count)]

    @cache
    def shares(path: str) -> FloatArray:
        return np.random.default_rng([seed, crc32(f"{key}.{path}".encode())]).random(count)

    def filled(value: Any, path: str, run: int) -> Any:
        if isinstance(value, list):
            return [filled(entry, f"{path}.{i}", run) for i, entry in enumerate(value)]
        if isinstance(value, dict):
            return {name: filled(entry, f"{path}.{name}", run) for name, entry in value.items()}
        found = _INTERVAL.fullmatch(value) if path and isinstance(value, str) else None
        if not found or found[3]:
            return value
        low, high = _ends(key, found)
        share = shares(path)[run]
        return low * (1.0 - share) + high * share

    return [filled(value, "", run) for run, value in enumerate(chosen)]


def run_name(changes: Variation) -> str:
    """What is special about a run: "link1.mass=9.6, tool.z=0.05".

    A key is shortened to its last parts as long as it differs from the others.
    """
    parts = {key: key.split(".") for key in changes}

    def short(key: str) -> str:
        for count in range(2, len(parts[key]) + 1):
            tail = parts[key][-count:]
            if not any(other[-count:] == tail for name, other in parts.items() if name != key):
                return ".".join(tail)
        return key

    return ", ".join(f"{short(key)}={_in_brief(value)}" for key, value in changes.items())


def _in_brief(value: Any) -> str:
    return f"{value:.5g}" if isinstance(value, float) else setting("", value)[1:]


def setting(key: str, value: Any) -> str:
    """The change "key=value" of a command line, which `load_scenario` reads back."""
    return f"{key}={dump_yaml({'v': value}, on_one_line=True).strip()[4:-1]}"


def rerun_commands(made: Sequence[str], variations: Sequence[Variation], folder: Path) -> list[str]:
    """For each run of a study the command that makes its record, plots and animation.

    Args:
        made: The words of the command that runs the scenario, without what varies.
        variations: What varies in each run.
        folder: The folder of the study, in which that of a run is made.
    """
    return [
        shlex.join(
            [
                *made,
                *(part for item in changes.items() for part in ("--set", setting(*item))),
                *("--out", str(folder / f"run{number}")),
            ]
        )
        for number, changes in enumerate(variations)
    ]


def plain(key: str, value: Any) -> Any:
    """A value as JSON has it.

    Raises:
        ScenarioError: It is no plain data.
    """
    if isinstance(value, (np.generic, np.ndarray)):
        value = value.tolist()
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, (list, tuple)):
        return [plain(key, entry) for entry in value]
    if isinstance(value, Mapping) and all(isinstance(name, str) for name in value):
        return {name: plain(key, entry) for name, entry in value.items()}
    raise _wrong(key, f"expected plain data, as a scenario file has, got {brief(value)}")


def _check_count(count: int) -> None:
    if count > MOST_RUNS:
        raise _error(f"a study has at most {MOST_RUNS} runs, got {count}")


def _whole(what: str, value: int, least: int) -> None:
    try:
        check_whole_number(what, value, least)
    except ValueError as error:
        raise _error(str(error)) from None


def _wrong(key: str, text: str) -> ScenarioError:
    return ScenarioError((f"--vary {key}" if "=" in key else key, text))
