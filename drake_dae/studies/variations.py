"""The variations of a study: for each run, keys of the scenario and their values."""

import re
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from itertools import product
from math import isfinite, prod
from typing import Any
from zlib import crc32

import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, brief, check_whole_number, vector
from drake_dae.errors import ScenarioError
from drake_dae.scenario.files import varied_data
from drake_dae.scenario.forms.typed_yaml import load_yaml
from drake_dae.scenario.scenario import Scenario, read_scenario, scenario_data

MOST_RUNS = 1_000_000
"""The largest number of runs of a study; more would take weeks."""

Variation = dict[str, Any]
"""Dotted key of a scenario -> its value in one run, as plain data."""


def _error(text: str) -> ScenarioError:
    return ScenarioError(("", text))


@checked(_error)
def grid_variations(values: Mapping[str, Any]) -> list[Variation]:
    """Returns every combination of the values of some keys; the last key changes fastest.

    Args:
        values: Dotted key -> values, for example {"start.errors.tool.z": [0.0, 0.05]}.

    Raises:
        ScenarioError: A key has no values, or there are more than a million combinations.
    """
    columns = _all_values(values)
    _check_count(prod(map(len, columns.values())))
    return [dict(zip(columns, chosen, strict=True)) for chosen in product(*columns.values())]


@checked(_error)
def random_variations(ranges: Mapping[str, Any], count: int, seed: int = 0) -> list[Variation]:
    """Returns random values of some keys; equal seeds give equal values.

    The values of a key depend only on the seed and on its name. Therefore a study with more runs or
    further keys contains the values of the smaller study.

    Args:
        ranges: Dotted key -> a tuple (low, high) for uniformly distributed numbers; a `range` for
            one of its whole numbers; or a list for one of its values. A text "low..high" within a
            value of a list, as in [["0.69..0.71", 0.0, 0.0]], is a uniformly distributed number.
        count: The number of runs.
        seed: The seed, 0 or more.

    Raises:
        ScenarioError: A range is empty, or count or seed is not valid.
    """
    _whole("count", count, 1)
    _whole("seed", seed, 0)
    _check_count(count)
    columns = {key: _drawn(key, choices, count, seed) for key, choices in ranges.items()}
    return [{key: column[i] for key, column in columns.items()} for i in range(count)]


@checked(_error)
def listed_variations(values: Mapping[str, Any]) -> list[Variation]:
    """Returns variations in which run i has the i-th value of each key.

    Args:
        values: Dotted key -> values, equally many for each key.

    Raises:
        ScenarioError: The keys have different numbers of values, or none.
    """
    columns = _all_values(values)
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
    """Returns the variations of the options "KEY=VALUES" of the command line.

    VALUES is a list in YAML, a single value, or LOW..HIGH:COUNT for equally spaced values. For
    random runs it may be LOW..HIGH, or contain LOW..HIGH within a value.

    Args:
        texts: The options.
        scenario: The scenario of the study.
        count: The number of random runs; None for a grid.
        seed: The seed of the random runs.
        together: Whether run i has the i-th value of each key, instead of a grid.

    Raises:
        ScenarioError: An option cannot be read, or its values are empty.
    """
    columns = parse_choices(texts, scenario, count is not None)
    if count is not None:
        return random_variations(columns, count, seed)
    return listed_variations(columns) if together else grid_variations(columns)


def parse_choices(
    texts: Sequence[str], scenario: Scenario, is_random: bool = True
) -> dict[str, Any]:
    """Returns the keys and the parsed values of options "KEY=VALUES", see `parse_variations`.

    Raises:
        ScenarioError: An option cannot be read.
    """
    data, columns = scenario_data(scenario), dict[str, Any]()
    for text in texts:
        key, separator, values = text.partition("=")
        if not (separator and values.strip() and all(key.split("."))):
            raise _wrong(text, "expected KEY=VALUES, for example start.errors.tool.z=0..0.05:6")
        if key in columns:
            raise _wrong(key, "the key varies twice; give all its values at once")
        columns[key] = _parse(key, values, data, is_random)
    return columns


_NUMBER = r"([-+]?[0-9]+(?:\.[0-9]+)?(?:[eE][-+]?[0-9]+)?)"
_INTERVAL = re.compile(rf"\s*{_NUMBER}\.\.{_NUMBER}(?::([0-9]{{1,9}}))?\s*")


def _parse(key: str, text: str, data: Mapping[str, Any], is_random: bool) -> Any:
    interval = _INTERVAL.fullmatch(text)
    if not interval:
        value = load_yaml(text, key)
        return value if isinstance(value, list) else [value]
    low, high = _ends(key, interval)
    if interval[3]:
        number = int(interval[3])
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


def _ends(key: str, interval: re.Match[str]) -> tuple[float, float]:
    """The ends of an interval."""
    low, high = (float(interval[1]), float(interval[2]))
    if not (np.isfinite([low, high]).all() and low < high):
        text = interval[0].strip()
        raise _wrong(key, f"{text} is an empty range; the first number is the lower one")
    _check_width(key, low, high)
    return low, high


def _check_width(key: str, low: float, high: float) -> None:
    if not isfinite(float(high) - float(low)):
        raise _wrong(key, f"the range from {low:g} to {high:g} is wider than the largest number")


def _is_whole_number(key: str, low: float, high: float, data: Mapping[str, Any]) -> bool:
    """Whether a key of the scenario accepts only whole numbers."""

    def accepts(value: float) -> bool:
        try:
            read_scenario(varied_data(data, {key: value}))
        except ScenarioError:
            return False
        return True

    return accepts(int(low)) and not accepts(low + (high - low) / 2**0.5)


def _all_values(values: Mapping[str, Any]) -> dict[str, list[Any]]:
    return {key: _values(key, column) for key, column in values.items()}


def _values(key: str, values: Any) -> list[Any]:
    """Checks the values of a key, and returns them as plain data."""
    if isinstance(values, np.ndarray) and values.ndim:
        values = list(values)
    if not isinstance(values, (list, tuple, range)):
        raise _wrong(key, f"expected a list of values, got {brief(values)}")
    if not values:
        raise _wrong(key, "expected at least one value")
    try:
        _check_count(len(values))
    except OverflowError:  # Of a range.
        raise _wrong(key, f"{brief(values)} has more values than a study has runs") from None
    return [plain(key, value) for value in values]


def _drawn(key: str, choices: Any, count: int, seed: int) -> list[Any]:
    """Draws the values of a key for all runs, see `random_variations`."""
    values = _checked_choices(key, choices)

    @cache
    def fractions_at(path: str) -> FloatArray:
        # One random number for each value, so that the values of fewer runs are the first of more.
        name = f"{key}.{path}" if path else key
        return np.random.default_rng([seed, crc32(name.encode())]).random(count)

    def drawn(run: int) -> Any:
        return _at(key, values, lambda path: fractions_at(path)[run].item())

    return [drawn(run) for run in range(count)]


def _checked_choices(key: str, choices: Any) -> Any:
    """Checks the choices of a key, see `random_variations`."""
    if isinstance(choices, tuple):
        low, high = vector(f"the range of {key}", choices, 2)
        if not low < high:
            raise _wrong(key, f"the range {brief(choices)} is empty; the first is the lower one")
        _check_width(key, low, high)
        return float(low), float(high)
    if isinstance(choices, range) and choices:
        if choices[-1] - choices[0] > 2**53:
            raise _wrong(key, f"{brief(choices)} has more whole numbers than can be drawn from")
        return choices
    return _values(key, choices)


def _at(key: str, choices: Any, fraction: Callable[[str], float]) -> Any:
    """Returns the value of a key at fractions of its ranges.

    Args:
        key: The key.
        choices: Its choices, as `_checked_choices` returns them.
        fraction: Path -> the fraction, from 0 to 1: "" of the choices themselves, ".0.force.1" of
            an interval within a value.
    """
    if isinstance(choices, tuple):
        share = fraction("")
        return choices[0] * (1.0 - share) + choices[1] * share
    chosen = choices[0]
    if len(choices) > 1:
        chosen = choices[min(int(len(choices) * fraction("")), len(choices) - 1)]

    def filled(value: Any, path: str) -> Any:
        if isinstance(value, list):
            return [filled(entry, f"{path}.{i}") for i, entry in enumerate(value)]
        if isinstance(value, dict):
            return {name: filled(entry, f"{path}.{name}") for name, entry in value.items()}
        interval = _INTERVAL.fullmatch(value) if path and isinstance(value, str) else None
        if not interval or interval[3]:
            return value
        low, high = _ends(key, interval)
        share = fraction(path)
        return low * (1.0 - share) + high * share

    return filled(chosen, "")


def numbers_that_vary(ranges: Mapping[str, Any]) -> list[str]:
    """Returns the names of the numbers that vary in ranges, and of keys with several values.

    Args:
        ranges: As for `random_variations`.
    """
    names = dict[str, None]()
    for key, choices in ranges.items():
        count = 2 if isinstance(choices, tuple) else len(choices)
        for i in range(1 if isinstance(choices, (tuple, range)) else count):

            def fraction(path: str, key: str = key, share: float = (i + 0.5) / count) -> float:
                names.setdefault(key + path)
                return share

            _at(key, _checked_choices(key, choices), fraction)
    return list(names)


def variation_at(ranges: Mapping[str, Any], fractions: Mapping[str, float]) -> Variation:
    """Returns the values of keys at given fractions of their ranges.

    Args:
        ranges: As for `random_variations`.
        fractions: A name of `numbers_that_vary` -> 0 for the lowest value, 1 for the highest.
    """

    def value(key: str, choices: Any) -> Any:
        return _at(key, _checked_choices(key, choices), lambda path: fractions[key + path])

    return {key: value(key, choices) for key, choices in ranges.items()}


def plain(key: str, value: Any) -> Any:
    """Returns a value in JSON types.

    Raises:
        ScenarioError: The value has no JSON type, for example a function.
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
