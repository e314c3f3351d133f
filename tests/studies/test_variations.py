"""Grids, random and listed variations, and how the command line writes them."""

import itertools

import numpy as np
import pytest

from drake_dae.errors import ScenarioError
from drake_dae.studies import grid_variations, listed_variations, random_variations
from drake_dae.studies.variations import parse_variations


def test_a_grid_has_every_combination_the_last_key_first():
    values = {"a.b": [1, 2, 3], "c": ["x", "y"], "d": np.array([0.5])}
    found = grid_variations(values)
    assert found == [
        {"a.b": a, "c": c, "d": d} for a, c, d in itertools.product([1, 2, 3], "xy", [0.5])
    ]
    assert type(found[0]["d"]) is float


def test_listed_values_go_together():
    assert listed_variations({"a": [1, 2], "b": [[3.0], [4.0]]}) == [
        {"a": 1, "b": [3.0]},
        {"a": 2, "b": [4.0]},
    ]


def test_a_seed_determines_random_values():
    ranges = {"a": (-1.0, 3.0), "b": range(5), "c": ["x", "y"]}
    first = random_variations(ranges, 50, seed=3)
    assert first == random_variations(ranges, 50, seed=3)
    assert first != random_variations(ranges, 50, seed=4)
    # More runs, or other keys beside, change none that were there.
    assert random_variations(ranges, 80, seed=3)[:50] == first
    alone = random_variations({"b": range(5)}, 50, seed=3)
    assert [changes["b"] for changes in alone] == [changes["b"] for changes in first]


def test_random_values_are_even():
    """By mean and variance of the uniform distributions, within five of their standard errors."""
    count = 4000
    found = random_variations({"a": (-1.0, 3.0), "b": range(2, 7), "c": [[1], [2]]}, count)
    for values, mean, variance in (
        ([v["a"] for v in found], 1.0, 16.0 / 12.0),
        ([v["b"] for v in found], 4.0, 24.0 / 12.0),
        ([v["c"][0] for v in found], 1.5, 1.0 / 4.0),
    ):
        assert abs(np.mean(values) - mean) < 5.0 * np.sqrt(variance / count)
        # The variance of a square is at most that of the uniform distribution's, variance^2 * 0.8.
        assert abs(np.var(values) - variance) < 5.0 * variance / np.sqrt(count)
    assert min(v["a"] for v in found) >= -1.0
    assert max(v["a"] for v in found) <= 3.0
    assert {v["b"] for v in found} == {2, 3, 4, 5, 6}
    assert all(type(v["b"]) is int for v in found)


@pytest.mark.parametrize("low", [-1e308, -9e307])
def test_a_range_that_no_number_measures_is_refused(low):
    for text, count in ((f"start.errors.tool.z={low}..{-low}:3", None), (f"a={low}..{-low}", 5)):
        with pytest.raises(ScenarioError, match=r"\ba\b|tool\.z"):
            parse_variations([text], count, 0, False)
    with pytest.raises(ScenarioError, match=r"\ba\b"):
        random_variations({"a": (low, -low)}, 5)


def test_ranges_of_more_whole_numbers_than_there_are_runs_are_refused():
    for values in (range(10**7), range(10**300)):
        with pytest.raises(ScenarioError, match="1000000"):
            grid_variations({"a": values})
    with pytest.raises(ScenarioError, match=r"\ba\b"):
        random_variations({"a": range(10**300)}, 5)


def parsed(*texts, count=None, seed=0, together=False):
    return parse_variations(texts, count, seed, together)


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("duration=1..2:3", [1, 1.5, 2]),
        ("duration=[1, 2.5]", [1, 2.5]),
        ("duration=1.5", [1.5]),
        ("sensors.force.seed=1..3:3", [1, 2, 3]),
        ("start.errors.tool.z=-1e-2..1e-2:2", [-0.01, 0.01]),
        ("law.gains.all=[[-4], [-8]]", [[-4], [-8]]),
        ("law.gains=[!Poles {all: [-4]}]", [{"_tag": "!Poles", "all": [-4]}]),
    ],
)
def test_values_of_an_option(text, values):
    key = text.partition("=")[0]
    assert parsed(text) == [{key: value} for value in values]


def test_options_make_a_grid_or_go_together():
    options = ("duration=[1, 2]", "sensors.force.seed=5..6:2")
    assert len(parsed(*options)) == 4
    assert parsed(*options, together=True) == [
        {"duration": 1, "sensors.force.seed": 5},
        {"duration": 2, "sensors.force.seed": 6},
    ]


def test_a_random_range_is_whole_where_the_key_is():
    found = parsed(
        "sensors.force.seed=1..9", "duration=1..9", "start.errors.tool.z=[0, 1]", count=30
    )
    assert {type(v["sensors.force.seed"]) for v in found} == {int}
    assert {type(v["duration"]) for v in found} == {float}
    assert {v["start.errors.tool.z"] for v in found} == {0, 1}
    assert max(v["sensors.force.seed"] for v in found) <= 9


def test_ranges_within_a_value_are_drawn_each_on_its_own():
    option = "plant.parameters.wall.position=[[1.19..1.21, 0, 0.5..0.6], [1.3, 0, 0]]"
    found = [v["plant.parameters.wall.position"] for v in parsed(option, count=200, seed=3)]
    drawn = np.array([value for value in found if value != [1.3, 0, 0]])
    assert 60 < len(drawn) < 140
    assert np.all(np.abs(drawn[:, 0] - 1.2) < 0.01)
    assert np.all(np.abs(drawn[:, 2] - 0.55) < 0.05)
    assert abs(np.corrcoef(drawn[:, 0], drawn[:, 2])[0, 1]) < 0.5
    assert found[:50] == [
        v["plant.parameters.wall.position"] for v in parsed(option, count=50, seed=3)
    ]


@pytest.mark.parametrize(
    ("texts", "options", "words"),
    [
        (["duration"], {}, "duration"),
        (["duration="], {}, "duration"),
        ([".a=1"], {}, ".a=1"),
        (["duration=[]"], {}, "duration"),
        (["duration=2..1:3"], {}, r"duration: .*2.*1"),
        (["duration=1..1"], {"count": 3}, r"duration: .*1.*1"),
        (["duration=1..2:1"], {}, "duration"),
        (["duration=1..2"], {}, "1..2:11"),
        (["start.errors=[{tool.z: 2..1}]"], {"count": 3}, r"start.errors: .*2.*1"),
        (["duration=[1"], {}, "duration: line 1"),
        (["duration=1", "duration=2"], {}, "duration"),
        (
            ["duration=[1, 2]", "sensors.force.seed=1"],
            {"together": True},
            r"duration.*2.*sensors.force.seed",
        ),
        (["duration=1..2"], {"count": 0}, r"count.*0"),
        (["duration=1..2"], {"count": 1, "seed": -1}, r"seed.*-1"),
        (
            ["duration=1..2:900000", "sensors.force.seed=1..9:9"],
            {},
            r"1000000.*8100000",
        ),
    ],
)
def test_what_cannot_be_read_is_reported(texts, options, words):
    with pytest.raises(ScenarioError, match=words):
        parsed(*texts, **options)


@pytest.mark.parametrize(
    ("ranges", "words"),
    [
        ({"a": (1.0, 1.0)}, r"\ba: .*1.*1"),
        ({"a": (1.0, float("inf"))}, r"\ba\b"),
        ({"a": range(0)}, r"\ba\b"),
        ({"a": "text"}, r"\ba\b"),
        ({"a": [object()]}, r"\ba\b"),
    ],
)
def test_ranges_that_make_no_sense_are_refused(ranges, words):
    with pytest.raises(ValueError, match=words):
        random_variations(ranges, 2)
