"""Grids, random and listed variations, and how the command line writes them."""

import itertools

import numpy as np
import pytest

from drake_dae.errors import ScenarioError
from drake_dae.studies import make_variations
from drake_dae.studies.variations import parse_variations


def test_a_grid_has_every_combination_the_last_key_first():
    values = {"a.b": [1, 2, 3], "c": ["x", "y"], "d": np.array([0.5])}
    found = make_variations(values)
    assert found == [
        {"a.b": a, "c": c, "d": d} for a, c, d in itertools.product([1, 2, 3], "xy", [0.5])
    ]
    assert type(found[0]["d"]) is float


def test_a_seed_determines_random_values():
    ranges = {"a": "-1..3", "b.seed": "0..4", "c": ["x", "y"]}
    first = make_variations(ranges, 50, seed=3)
    assert first == make_variations(ranges, 50, seed=3)
    assert first != make_variations(ranges, 50, seed=4)
    # More runs, or other keys beside, change none that were there.
    assert make_variations(ranges, 80, seed=3)[:50] == first
    alone = make_variations({"b.seed": "0..4"}, 50, seed=3)
    assert [changes["b.seed"] for changes in alone] == [changes["b.seed"] for changes in first]


def test_random_values_are_even():
    """By mean and variance of the uniform distributions, within five of their standard errors."""
    count = 4000
    found = make_variations({"a": "-1..3", "seed": "2..6", "c": [[1], [2]]}, count)
    for values, mean, variance in (
        ([v["a"] for v in found], 1.0, 16.0 / 12.0),
        ([v["seed"] for v in found], 4.0, 24.0 / 12.0),
        ([v["c"][0] for v in found], 1.5, 1.0 / 4.0),
    ):
        assert abs(np.mean(values) - mean) < 5.0 * np.sqrt(variance / count)
        # The variance of a square is at most that of the uniform distribution's, variance^2 * 0.8.
        assert abs(np.var(values) - variance) < 5.0 * variance / np.sqrt(count)
    assert min(v["a"] for v in found) >= -1.0
    assert max(v["a"] for v in found) <= 3.0
    assert {v["seed"] for v in found} == {2, 3, 4, 5, 6}


def parsed(*texts, count=None, seed=0, together=False):
    return parse_variations(texts, count, seed, together)


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("duration=1..2:3", [1, 1.5, 2]),
        ("sampling.seed=1..1000000:1000000", range(1, 1_000_001)),
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
        (["duration=0..1:1000001"], {}, r"1000000.*1000001"),
        (["duration=0..1:9999999999"], {}, r"1000000.*9999999999"),
        (["duration=1..2:900000", "sensors.force.seed=1..9:9"], {}, r"1000000.*8100000"),
    ],
)
def test_what_cannot_be_read_is_reported(texts, options, words):
    with pytest.raises(ScenarioError, match=words):
        parsed(*texts, **options)


@pytest.mark.parametrize(
    ("values", "count", "words"),
    [
        ({"a": "1..1"}, 2, r"\ba: .*1.*1"),
        ({"a": "-1e308..1e308"}, 5, r"\ba\b"),
        ({"a": "-1e308..1e308:3"}, None, r"\ba\b"),
        ({"a": range(0)}, 2, r"\ba\b"),
        ({"a": "text"}, 2, r"\ba\b"),
        ({"a": [object()]}, 2, r"\ba\b"),
        ({"a": range(10**300)}, None, "1000000"),
        ({"a": range(10**9)}, 2, "1000000"),
    ],
)
def test_ranges_that_make_no_sense_are_refused(values, count, words):
    with pytest.raises(ScenarioError, match=words):
        make_variations(values, count)
