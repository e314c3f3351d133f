"""The scenario polish_unknown_part: a part off its place is felt, found and polished."""

from functools import partial

import numpy as np
import pytest
from found_places import found_off
from runs import scenario

from drake_dae import build_scenario, rollout
from drake_dae.running import start_values

DURATION = 12.1  # Until the part is polished.
PLACE = "part.position: [0.703, 0.003, 0.6026], part.rpy: [0.03, 0.06, -0.056]"  # As in the file.
BALL = f"plant=!CompliantContact {{friction: 0.3, radius: 0.01, parameters: {{{PLACE}}}}}"


def polished(*settings):
    """The scenario, its loop, and record and starts of phases of a rollout."""
    chosen = scenario("polish_unknown_part", *settings, f"duration={DURATION}")
    loop, context = build_scenario(chosen)
    times = np.linspace(0.0, DURATION, round(1000 * DURATION) + 1)
    (run,) = rollout(loop, *start_values(loop, context), times)
    assert run.failure is None, run.failure
    changes = {change.phase: change.time for change in loop.changes(run.record)}
    return chosen, loop, run.record, changes


@pytest.mark.slow
@pytest.mark.thorough
def test_a_part_5_mm_and_5_degrees_off_is_found_and_polished():
    """The place is that of the surface under the way of the tool, by the estimates at each time.

    At the first touch it is off by some mm; 0.1 mm is asked after the part is felt.
    """
    chosen, loop, record, changes = polished(BALL)
    assert list(changes)[:5] == ["Move", "Approach", "Press", "feel", "polish"]
    begin, end = changes["polish"], DURATION
    rows = np.flatnonzero((record.time > begin) & (record.time < end))[::50]
    off = partial(found_off, chosen, loop, record, rows)
    before = off(np.searchsorted(record.time, changes["Press"]))
    assert np.abs(before).max() > 5e-3  # Where the law has the part.
    every = np.array([off(at) for at in rows])
    assert np.sqrt(np.mean(every**2)) < 1e-4
    # The force, after the transition of a second, and the tool beside the normal, in rad.
    late = (record.time > begin + 1.0) & (record.time < end)
    errors = dict(
        zip(
            [signal.name for signal in record.signals["tracking_error"].signals],
            record["tracking_error"][late].T,
            strict=True,
        )
    )
    assert np.sqrt(np.mean(errors["part.force"] ** 2)) < 0.05
    assert np.sqrt(np.mean(errors["part.tilt_x"] ** 2 + errors["part.tilt_y"] ** 2)) < 3e-3
