"""The variations of a sweep: for each run, keys of the scenario and their values."""

import re
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import product
from math import isfinite, prod
from typing import Any
from zlib import crc32

import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, brief, check_whole_number, vector
from drake_dae.errors import ScenarioError
from drake_dae.scenario.typed_yaml import load_yaml

MOST_RUNS = 1_000_000
"""The largest number of runs of a sweep; more would take weeks."""

Variation = dict[str, Any]
"""Dotted key of a scenario -> its value in one run, as plain data."""

_NUMBER = r"([-+]?[0-9]+(?:\.[0-9]+)?(?:[eE][-+]?[0-9]+)?)"
_INTERVAL = re.compile(rf"\s*{_NUMBER}\.\.{_NUMBER}(?::([0-9]{{1,9}}))?\s*")


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
    columns = {key: _values(key, column) for key, column in values.items()}
    _check_count(prod(map(len, columns.values())))
    return [dict(zip(columns, chosen, strict=True)) for chosen in product(*columns.values())]


@checked(_error)
def listed_variations(values: Mapping[str, Any]) -> list[Variation]:
    """Returns variations in which run i has the i-th value of each key.

    Args:
        values: Dotted key -> values, equally many for each key.

    Raises:
        ScenarioError: The keys have different numbers of values, or none.
    """
    columns = {key: _values(key, column) for key, column in values.items()}
    if len({len(column) for column in columns.values()}) > 1:
        counted = ", ".join(f"{key} has {len(column)}" for key, column in columns.items())
        raise _error(f"keys that vary together need as many values each; {counted}")
    rows = zip(*columns.values(), strict=True)
    return [dict(zip(columns, chosen, strict=True)) for chosen in rows]


@checked(_error)
def random_variations(ranges: Mapping[str, Any], count: int, seed: int = 0) -> list[Variation]:
    """Returns random values of some keys; equal seeds give equal values.

    The values of a key depend only on the seed and on its name. Therefore a sweep with more runs or
    further keys contains the values of the smaller one.

    Args:
        ranges: Dotted key -> a tuple (low, high) for uniformly distributed numbers; a `range` for
            one of its whole numbers; or a list for one of its values. A text "low..high" within a
            value of a list, as in [["0.69..0.71", 0.0, 0.0]], is a uniformly distributed number.
        count: The number of runs.
        seed: The seed, 0 or more.

    Raises:
        ScenarioError: A range is empty, or count or seed is not valid.
    """
    for what, value, least in (("count", count, 1), ("seed", seed, 0)):
        try:
            check_whole_number(what, value, least)
        except ValueError as error:
            raise _error(str(error)) from None
    _check_count(count)
    columns = {key: _drawn(key, choices, count, seed) for key, choices in ranges.items()}
    return [{key: column[i] for key, column in columns.items()} for i in range(count)]


def parse_variations(
    texts: Sequence[str], count: int | None, seed: int, together: bool
) -> list[Variation]:
    """Returns the variations of the options "KEY=VALUES" of the command line.

    VALUES is a list in YAML, a single value, or LOW..HIGH:COUNT for equally spaced values. For
    random runs it may be LOW..HIGH, of whole numbers for a seed, or contain LOW..HIGH within a
    value.

    Args:
        texts: The options.
        count: The number of random runs; None for a grid.
        seed: The seed of the random runs.
        together: Whether run i has the i-th value of each key, instead of a grid.

    Raises:
        ScenarioError: An option cannot be read, or its values are empty.
    """
    columns = dict[str, Any]()
    for text in texts:
        key, separator, values = text.partition("=")
        if not (separator and values.strip() and all(key.split("."))):
            raise _wrong(
                f"--vary {text}", "expected KEY=VALUES, for example start.errors.tool.z=0..0.05:6"
            )
        if key in columns:
            raise _wrong(key, "the key varies twice; give all its values at once")
        columns[key] = _parsed(key, values.strip(), count is not None)
    if count is not None:
        return random_variations(columns, count, seed)
    return listed_variations(columns) if together else grid_variations(columns)


def _parsed(key: str, text: str, is_random: bool) -> Any:
    """The values of an option."""
    interval = _INTERVAL.fullmatch(text)
    if not interval:
        value = load_yaml(text, key)
        return value if isinstance(value, list) else [value]
    low, high = _ends(key, float(interval[1]), float(interval[2]))
    if interval[3]:
        number = int(interval[3])
        if number < 2:
            raise _wrong(key, f"a range has at least 2 values, got {text}")
        _check_count(number)
        values = np.linspace(low, high, number).tolist()
        is_whole = all(value.is_integer() for value in values)
        return [int(value) for value in values] if is_whole else values
    if not is_random:
        raise _wrong(key, f"{text} needs the number of its values, {text}:11, or --random COUNT")
    return range(int(low), int(high) + 1) if key.endswith("seed") else (low, high)


def _drawn(key: str, choices: Any, count: int, seed: int) -> list[Any]:
    """Draws the values of a key for all runs, see `random_variations`."""

    @cache
    def fractions(path: str) -> FloatArray:
        # One random number for each value, so that the values of fewer runs are the first of more.
        return np.random.default_rng([seed, crc32(path.encode())]).random(count)

    def between(low: float, high: float, path: str, run: int) -> float:
        share = fractions(path)[run].item()
        return low * (1.0 - share) + high * share

    def filled(value: Any, path: str, run: int) -> Any:
        """A value with random numbers in the place of its intervals."""
        if isinstance(value, list):
            return [filled(entry, f"{path}.{i}", run) for i, entry in enumerate(value)]
        if isinstance(value, dict):
            return {name: filled(entry, f"{path}.{name}", run) for name, entry in value.items()}
        interval = _INTERVAL.fullmatch(value) if isinstance(value, str) and path != key else None
        if not interval or interval[3]:
            return value
        return between(*_ends(key, float(interval[1]), float(interval[2])), path, run)

    if isinstance(choices, tuple):
        low, high = _ends(key, *vector(f"the range of {key}", choices, 2).tolist())
        return [between(low, high, key, run) for run in range(count)]
    if isinstance(choices, range) and choices:
        if abs(choices[-1] - choices[0]) > 2**53:
            raise _wrong(key, f"{brief(choices)} has more whole numbers than can be drawn from")
        values: Sequence[Any] = choices
    else:
        values = _values(key, choices)
    places = [0] * count
    if len(values) > 1:
        places = [min(int(len(values) * share), len(values) - 1) for share in fractions(key)]
    return [filled(values[place], key, run) for run, place in enumerate(places)]


def _values(key: str, values: Any) -> list[Any]:
    """Checks the values of a key, and returns them as plain data."""
    if isinstance(values, np.ndarray) and values.ndim:
        values = list(values)
    if not isinstance(values, (list, tuple, range)):
        raise _wrong(key, f"expected a list of values, got {brief(values)}")
    if not values:
        raise _wrong(key, "expected at least one value")
    if values[MOST_RUNS:]:
        raise _wrong(key, f"a sweep has at most {MOST_RUNS} runs, got {brief(values)}")
    return [plain(key, value) for value in values]


def _ends(key: str, low: float, high: float) -> tuple[float, float]:
    """The ends of an interval, checked."""
    if not (low < high and isfinite(high - low)):
        text = "is empty" if low >= high else "is wider than the largest number"
        raise _wrong(key, f"the range from {low:g} to {high:g} {text}")
    return low, high


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
        raise _error(f"a sweep has at most {MOST_RUNS} runs, got {count}")


def _wrong(key: str, text: str) -> ScenarioError:
    return ScenarioError((key, text))
