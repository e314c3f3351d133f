"""A small part of the campaign: a mistake ends as a message, a robot as numbers that are right."""

import random
import subprocess
import sys
from pathlib import Path

import pytest
from campaign import bad_files, bad_inputs, random_robots, random_tasks
from campaign.outcomes import BAD, REFUSED, RESULT
from runs import some

FEW, MANY = range(40), range(40, 110)
FEW_ROBOTS, MANY_ROBOTS = (8, 17), (16, 34, *range(40, 48))


def each(few, many):
    """Seeds; those of the second sequence are slow, and two of three of them thorough."""
    return [*few, *some((pytest.param(seed, marks=pytest.mark.slow) for seed in many), of=3)]


@pytest.mark.slow
@pytest.mark.parametrize("seed", each(FEW, MANY))
def test_a_bad_input_is_refused_or_runs_with_a_reason(seed: int, tmp_path: Path):
    outcome = bad_inputs.attempt(seed, tmp_path)
    assert outcome.kind not in BAD, outcome


@pytest.mark.parametrize("seed", each(range(30), range(30, 60)))
def test_a_bad_file_or_command_is_refused_or_read_with_a_reason(seed: int, tmp_path: Path):
    outcome = bad_files.attempt(seed, tmp_path)
    assert outcome.kind not in BAD, outcome


@pytest.mark.slow
@pytest.mark.parametrize("seed", each(FEW_ROBOTS, MANY_ROBOTS))
def test_a_random_robot_is_refused_or_moves_as_predicted(seed: int, tmp_path: Path):
    outcome = random_robots.attempt(seed, tmp_path)
    assert outcome.kind in (RESULT, REFUSED), outcome
    if seed in FEW_ROBOTS:
        assert outcome.kind == RESULT, outcome


# Task 154 releases a contact whose model error exceeds its contact_force.
@pytest.mark.slow
@pytest.mark.parametrize(
    "seed", [3, 5, 154, *(pytest.param(i, marks=pytest.mark.thorough) for i in range(20, 37))]
)
def test_a_random_task_ends_as_chosen_and_hits_no_harder_than_predicted(seed: int, tmp_path: Path):
    found = random_tasks.outcome(*random_tasks.random_task(random.Random(seed)), tmp_path)
    assert not found.startswith(random_tasks.BAD), found


@pytest.mark.slow
@pytest.mark.thorough
def test_the_command_prints_counts():
    command = [sys.executable, Path(__file__).with_name("run.py"), "--processes", "2"]
    done = subprocess.run(
        [
            *command,
            "--count=10",
            "--files=5",
            "--robots=2",
            "--measured=2",
            "--seed=100",
        ],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "10 attempts of kind 'input'" in done.stdout
    assert "2 attempts of kind 'robot'" in done.stdout
    assert "0  hang or crash" in done.stdout
