"""Tasks whose measurements are late or lost on their way to the law."""

import re

import numpy as np
import pytest
from test_guarded_task import SHORT, rolled

from drake_dae import Packets, Sampling, load_scenario
from drake_dae.errors import ScenarioError
from drake_dae.scenario.advice.touch import reaction_time
from drake_dae.scenario.build import build_completed

LOST = "measurements: {loss: 0.04, burst: 3, late: 0.2, most_lost: 20}"


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "short.yaml"
    path.write_text(SHORT)
    return path


@pytest.mark.slow
def test_a_task_goes_on_while_measurements_are_late_and_lost(file):
    """Every fourth sample has an old measurement, up to four in a row: the task is done."""
    change = [f"sampling={{period: 0.002, delay: 0.001, {LOST}}}", "duration=2"]
    found, changes = rolled(load_scenario(file, [*change, "task.phases.1.tolerance=3"]))
    assert found.failure is None
    assert changes[-1].phase == "done"
    missed = found.record["lost_measurements"][:, 0]
    assert 3.0 <= missed.max() < 20.0
    assert 0.15 < np.mean(missed > 0.0) < 0.4


def test_a_touch_is_felt_when_its_packet_comes(file):
    """A phase ends by a new measurement, as long as packets are lost and never late."""
    lost = "sampling={period: 0.002, delay: 0.001, measurements: {loss: 0.1, burst: 4}}"
    found, changes = rolled(load_scenario(file, [lost, "task.phases.1.tolerance=3"]))
    record, felt = found.record, changes[1].time
    assert changes[0].phase == "feel"
    row = np.searchsorted(record.time, felt - 1e-9)
    assert record["lost_measurements"][row, 0] == 0.0
    assert record["lost_measurements"][: row + 1, 0].max() >= 4.0


@pytest.mark.slow
def test_a_task_ends_where_the_law_stops_the_robot(file):
    """After twenty samples without a measurement, with the reason and the record up to there."""
    lost = "measurements: {loss: 0.01, burst: 20, most_lost: 20}"
    change = f"sampling={{period: 0.002, delay: 0.001, {lost}}}"
    found, changes = rolled(load_scenario(file, [change]))
    text = str(found.failure)
    assert "no measurement has arrived for 20 samples (sampling.measurements.most_lost)" in text
    assert found.record.time[-1] <= found.failure.time
    assert changes[-1].phase not in ("done", "held")


def test_the_expected_peak_of_a_touch_counts_the_missing_measurements(file):
    """T (1 + delay + gap): in each sample the tool goes on by v T, and its force by k v T."""
    sampling = Sampling(0.001, 0.001, measurements=Packets(late=0.1, loss=0.01, burst=3))
    assert reaction_time(sampling, 0.0) == pytest.approx(0.001 * (1 + 1 + 4))
    contact = ["constraint_damping=", "gains="]
    peaks = []
    for more in ("", f", {LOST}"):
        change = [*contact, f"sampling={{period: 0.001, delay: 0.001{more}}}", "task.gains="]
        notes = " ".join(build_completed(load_scenario(file, change))[0].notes)
        peaks.append(float(re.search(r"stay below ([0-9.e+]+) N", notes)[1]))
    assert peaks[1] - peaks[0] == pytest.approx(1e5 * 0.05 * 4 * 0.001, rel=0.02)


def test_a_scenario_names_the_key_of_a_number_that_makes_no_sense(file):
    lost = "sampling={period: 0.002, measurements: {loss: 2}}"
    with pytest.raises(ScenarioError, match=r"sampling.measurements: the loss of measurements"):
        load_scenario(file, [lost])
