"""The variations of a sweep: for each run, keys of the scenario and their values."""

import json
import re
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import product
from math import isfinite, prod
from typing import Any
from zlib import crc32

import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, brief, check_whole_number
from drake_dae.errors import ScenarioError
from drake_dae.scenario.form import load_yaml

MOST_RUNS = 1_000_000  # The largest number of runs of a sweep; more would take weeks.
Variation = dict[str, Any]  # Dotted key of a scenario -> its value in one run, as plain data.

_NUMBER = r"([-+]?[0-9]+(?:\.[0-9]+)?(?:[eE][-+]?[0-9]+)?)"
_INTERVAL = re.compile(rf"\s*{_NUMBER}\.\.{_NUMBER}(?::([0-9]{{1,18}}))?\s*")


@checked(lambda text: ScenarioError(("", text)))
def make_variations(
    values: Mapping[str, Any], count: int | None = None, seed: int = 0, together: bool = False
) -> list[Variation]:
    """Returns the variations of a sweep: a grid of values, values together, or random ones.

    The values of a dotted key are a list, or a text "LOW..HIGH:COUNT" for so many equally spaced
    ones. For `count` runs random values are drawn from a list, or evenly from "LOW..HIGH", which
    may stand within a value, as in [["0.69..0.71", 0.0, 0.0]]; those of a seed are whole numbers.
    They depend only on the seed and on the key, so that a sweep with more runs or keys contains the
    values of the smaller one. Without a count there is a run for every combination, in which the
    last key changes fastest, or with `together` for the i-th value of each key.
    """
    for what, number, least in (("count", 1 if count is None else count, 1), ("seed", seed, 0)):
        try:
            check_whole_number(what, number, least)
        except ValueError as error:
            raise ScenarioError(("", str(error))) from None
    _check_count(count or 1)
    if count is not None:
        columns = {key: _drawn(key, given, count, seed) for key, given in values.items()}
        return [{key: column[i] for key, column in columns.items()} for i in range(count)]
    columns = {key: _listed(key, given) for key, given in values.items()}
    if not together:
        _check_count(prod(map(len, columns.values())))
    elif len(set(map(len, columns.values()))) > 1:
        counted = ", ".join(f"{key} has {len(column)}" for key, column in columns.items())
        text = f"keys that vary together need as many values each; {counted}"
        raise ScenarioError(("", text))
    rows = zip(*columns.values(), strict=True) if together else product(*columns.values())
    return [dict(zip(columns, row, strict=True)) for row in rows]


def parse_variations(
    texts: Sequence[str], count: int | None, seed: int, together: bool
) -> list[Variation]:
    """The variations of options "KEY=VALUES" of the command line: VALUES is YAML or a range."""
    columns = dict[str, Any]()
    for text in texts:
        key, _, values = text.partition("=")
        if not (values.strip() and all(key.split("."))):
            wanted = "expected KEY=VALUES, for example start.errors.tool.z=0..0.05:6"
            raise ScenarioError((f"--vary {text}", wanted))
        if key in columns:
            raise ScenarioError((key, "the key varies twice; give all its values at once"))
        given = values if _INTERVAL.fullmatch(values) else load_yaml(values, key)
        columns[key] = given if isinstance(given, list) or given is values else [given]
    return make_variations(columns, count, seed, together)


def _listed(key: str, values: Any) -> list[Any]:
    """The values of a key in a grid, as plain data."""
    if (interval := _interval(key, values)) is not None:
        low, high, number = interval
        if number < 2:
            text = f"{values} needs the number of its values, {values}:11, or random values"
            raise ScenarioError((key, text if not number else f"at least 2 values, got {values}"))
        _check_count(number)
        found = np.linspace(low, high, number).tolist()
        is_whole = all(value.is_integer() for value in found)
        return [int(value) for value in found] if is_whole else found
    listed = plain(key, [*values[: MOST_RUNS + 1]] if isinstance(values, range) else values)
    if not isinstance(listed, list) or not listed:
        raise ScenarioError((key, f"expected a list of values, got {brief(values)}"))
    if len(listed) > MOST_RUNS:
        text = f"a sweep has at most {MOST_RUNS} runs, got {brief(values)}"
        raise ScenarioError((key, text))
    return listed


def _drawn(key: str, values: Any, count: int, seed: int) -> list[Any]:
    """Random values of a key for all runs."""

    @cache
    def fractions(path: str) -> FloatArray:
        # One random number for each value, so that the values of fewer runs are the first of more.
        return np.random.default_rng([seed, crc32(path.encode())]).random(count)

    def filled(value: Any, path: str, run: int) -> Any:
        """A value with random numbers in the place of its intervals."""
        if isinstance(value, list):
            return [filled(entry, f"{path}.{i}", run) for i, entry in enumerate(value)]
        if isinstance(value, dict):
            return {name: filled(entry, f"{path}.{name}", run) for name, entry in value.items()}
        interval = _interval(key, value)
        if interval is None or interval[2]:
            return value
        (low, high, _), share = interval, fractions(path)[run].item()
        if key.endswith("seed"):
            return int(low) + min(int((int(high) - int(low) + 1) * share), int(high) - int(low))
        return low * (1.0 - share) + high * share

    interval = _interval(key, values)
    if interval is not None and not interval[2]:
        return [filled(values, key, run) for run in range(count)]
    choices = _listed(key, values)  # Of so many values, some are drawn.
    shares = fractions(key) if len(choices) > 1 else np.zeros(count)
    places = [min(int(len(choices) * share), len(choices) - 1) for share in shares]
    return [filled(choices[place], key, run) for run, place in enumerate(places)]


def _interval(key: str, value: Any) -> tuple[float, float, int] | None:
    """The ends and the count, 0 if there is none, in a text "LOW..HIGH:COUNT"."""
    found = _INTERVAL.fullmatch(value) if isinstance(value, str) else None
    if found is None:
        return None
    low, high = float(found[1]), float(found[2])
    if not (low < high and isfinite(high - low)):
        raise ScenarioError((key, f"the range {value} is empty, or wider than any number"))
    return low, high, int(found[3] or 0)


def plain(key: str, value: Any) -> Any:
    """A value in JSON types."""
    try:
        return json.loads(json.dumps(value, default=lambda each: each.tolist()))
    except (TypeError, AttributeError, ValueError):
        text = f"expected plain data, as a scenario file has, got {brief(value)}"
        raise ScenarioError((key, text)) from None


def _check_count(count: int) -> None:
    if count > MOST_RUNS:
        raise ScenarioError(("", f"a sweep has at most {MOST_RUNS} runs, got {count}"))
