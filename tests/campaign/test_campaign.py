"""A small part of the campaign: a mistake ends as a message, a robot as numbers that are right."""

from pathlib import Path

import pytest
from campaign import bad_inputs, random_robots
from campaign.outcomes import BAD, REFUSED, RESULT


def each(few, many, size=1):
    """Seeds, some at a time; those of the second sequence are thorough."""
    ranges = [[seeds[i : i + size] for i in range(0, len(seeds), size)] for seeds in (few, many)]
    return [*ranges[0], *(pytest.param(seeds, marks=pytest.mark.thorough) for seeds in ranges[1])]


@pytest.mark.slow
@pytest.mark.parametrize("seeds", each(range(40), range(40, 110), 5))
def test_a_bad_scenario_is_refused_or_runs_as_predicted(seeds, tmp_path: Path):
    for seed in seeds:
        outcome = bad_inputs.scenario_attempt(seed, tmp_path)
        assert outcome.kind not in BAD, f"{seed}: {outcome}"


@pytest.mark.parametrize("seeds", each(range(30), range(30, 60), 10))
def test_a_bad_file_or_command_is_refused_or_read(seeds, tmp_path: Path):
    for seed in seeds:
        folder = tmp_path / str(seed)
        folder.mkdir()
        outcome = bad_inputs.file_attempt(seed, folder)
        assert outcome.kind not in BAD, f"{seed}: {outcome}"


@pytest.mark.slow
@pytest.mark.parametrize("seeds", each((10, 18), (16, 34, *range(40, 48))))
def test_a_random_robot_is_refused_or_moves_as_predicted(seeds, tmp_path: Path):
    (seed,) = seeds
    outcome = random_robots.attempt(seed, tmp_path)
    assert outcome.kind == RESULT or (seed not in (10, 18) and outcome.kind == REFUSED), outcome
