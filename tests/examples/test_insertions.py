"""The insertions of `examples/insertions`, and holes into which the peg does not go."""

import numpy as np
import pytest
from programs import loaded

pytestmark = [pytest.mark.slow, pytest.mark.thorough]


@pytest.fixture(scope="module")
def example():
    with loaded("insertions") as module:
        yield module


@pytest.fixture(scope="module")
def place(example):
    """The place of the hole in one run."""
    return example.settings(3, np.array([0.7, 0.0, 0.6]), np.array([-1.0, 0.0, 0.0]))


def test_a_peg_is_inserted_with_no_more_force_than_predicted(example, place):
    outcome, time, force = example.insert("peg_in_hole", place)
    assert outcome == "done, after a depth of 0.015 m"
    assert time < 20.0
    peaks = example.predicted("peg_in_hole", [])
    assert 1.0 < force < max(peaks.values())
    assert force < 15.0
    assert max(peaks["Approach"], peaks["Search"]) < 15.0


def test_a_peg_that_is_too_thick_jams_and_is_not_pushed_harder(example, place):
    """By 0.2 mm in diameter. It sits in the chamfer, and the law lags until it gives up."""
    thick = "plant.pegs.0.radius=0.0051"
    outcome, _, force = example.insert("peg_in_hole", [*place, thick])
    assert "Insert lags 0.005" in outcome
    # Beside what the hits exert, m (p^2 lag + 2 p v) with 32.5 kg along the hole.
    push = 32.5 * (64 * 0.005 + 16 * 0.005)
    assert 0.5 * push < force < max(example.predicted("peg_in_hole", place).values())


def test_a_plate_without_hole_is_searched_in_vain(example, place):
    found = example.insert("peg_in_hole", [*place, "constraints.0.surface.hole=null"])
    assert "Search has come to 0.003 m without a fall of 0.0003 m" in found[0]
