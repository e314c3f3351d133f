"""The comparison of a run with a declared bound of its errors."""

import numpy as np
import pytest

from drake_dae import ErrorBound, Record
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError
from drake_dae.simulation.error_bound import USED, bound_words, exceeds
from drake_dae.simulation.records.record import Recorded

TIME = np.linspace(0.0, 2.0, 201)


def record(force):
    """A record with two errors: 0.001 m, and a force."""
    signals = (Signal("tool.x", "m"), Signal("wall.force", "N"))
    errors = np.stack([np.full(TIME.size, 0.001), force], axis=1)
    return Record(TIME, {"tracking_error": Recorded(errors, signals)})


def test_a_run_within_its_bound_is_told_with_the_output_that_uses_most_of_it():
    bound = ErrorBound({"wall.force": 4.0, "tool.x": 0.01}, after=1.0)
    run = record(np.where(TIME < 0.995, 50.0, -3.0))  # Before `after` nothing is bounded.
    assert bound_words(bound.check(run)) == [
        "The error bound held. Closest: wall.force reaches 75% of its bound of 4 N."
    ]
    assert not exceeds(bound.check(run))
    figures = bound.figures(run)
    assert figures == pytest.approx(
        {USED: 0.75, f"{USED}, wall.force": 0.75, f"{USED}, tool.x": 0.1}
    )


def test_a_run_beyond_its_bound_is_told_from_when_and_by_how_much():
    bound = ErrorBound({"wall.force": 4.0, "tool.x": 0.01}, after=0.5)
    run = record(4.0 * TIME)  # It exceeds 4 N after 1 s, and reaches 8 N.
    assert bound_words(bound.check(run)) == [
        "The error bound did not hold:",
        "  the error of wall.force exceeds its bound of 4 N from 1.01 s on, by up to 4 N at 2 s",
    ]
    assert exceeds(bound.check(run))


def test_an_error_that_is_no_number_does_not_keep_a_bound():
    assert exceeds(ErrorBound({"wall.force": 4.0}).check(record(np.where(TIME > 1.0, np.nan, 0.0))))


def test_a_run_that_ends_before_its_bound_applies_says_so():
    found = ErrorBound({"tool.x": 0.01}, after=3.0).check(record(TIME))
    assert bound_words(found) == ["The run ended before its error bound applies."]
    assert ErrorBound({"tool.x": 0.01}, after=3.0).figures(record(TIME)) == {}


@pytest.mark.parametrize(
    ("outputs", "text"),
    [({}, "needs an output"), ({"tool.x": -1.0}, "tool.x must be positive")],
)
def test_a_bound_checks_its_numbers(outputs, text):
    with pytest.raises(ModelError, match=text):
        ErrorBound(outputs)


def test_a_bound_of_an_unknown_output_is_refused():
    with pytest.raises(ModelError, match=r"no output 'tool\.q'"):
        ErrorBound({"tool.q": 1.0}).check(record(TIME))
