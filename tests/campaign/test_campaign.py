"""A small part of the campaign: a mistake ends as a message, a robot as numbers that are right."""

from pathlib import Path

import pytest
from campaign import bad_files, bad_inputs, random_robots, random_tasks
from campaign.outcomes import BAD, REFUSED, RESULT


def each(few, many):
    """Seeds; those of the second sequence are thorough."""
    return [*few, *(pytest.param(seed, marks=pytest.mark.thorough) for seed in many)]


@pytest.mark.slow
@pytest.mark.parametrize("seed", each(range(40), range(40, 110)))
def test_a_bad_input_is_refused_or_runs_with_a_reason(seed: int, tmp_path: Path):
    outcome = bad_inputs.attempt(seed, tmp_path)
    assert outcome.kind not in BAD, outcome


@pytest.mark.parametrize("seed", each(range(30), range(30, 60)))
def test_a_bad_file_or_command_is_refused_or_read_with_a_reason(seed: int, tmp_path: Path):
    outcome = bad_files.attempt(seed, tmp_path)
    assert outcome.kind not in BAD, outcome


@pytest.mark.slow
@pytest.mark.parametrize("seed", each((8, 17), (16, 34, *range(40, 48))))
def test_a_random_robot_is_refused_or_moves_as_predicted(seed: int, tmp_path: Path):
    outcome = random_robots.attempt(seed, tmp_path)
    assert outcome.kind in (RESULT, REFUSED), outcome
    if seed in (8, 17):
        assert outcome.kind == RESULT, outcome


# Task 0 fails in a rollout, 154 releases a contact whose model error exceeds its contact_force.
@pytest.mark.slow
@pytest.mark.parametrize("seed", each((0, 5, 154), range(20, 37)))
def test_a_random_task_ends_as_chosen_and_hits_no_harder_than_predicted(seed: int, tmp_path: Path):
    outcome = random_tasks.attempt(seed, tmp_path)
    assert outcome.kind not in BAD, outcome
