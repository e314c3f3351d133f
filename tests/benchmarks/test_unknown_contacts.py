"""A study of contact whose numbers nobody knows, by rollouts, and some of it by Drake's plant."""

import time

import numpy as np
import pytest
from runs import scenario
from timing import has_compiler

from drake_dae import random_variations
from drake_dae.scenario.scenario import scenario_data
from drake_dae.studies.runs import Runner

RUNS, COMPARED = 1000, 50
UNKNOWN = {
    "plant.friction": (0.0, 0.6),
    "plant.stiffness": (5e4, 2e5),
    "plant_parameters.wall.position": [["0.699..0.701", 0.0, 0.0]],
    "plant_parameters.tool.mass": (0.3, 0.8),
    "plant_parameters.link4.mass": (2.0, 3.0),
}

pytestmark = pytest.mark.skipif(not has_compiler(), reason="there is no C compiler")


def test_a_thousand_unknown_contacts(report):
    """2 s each of the 7-joint arm, compared from 1 s on, where the law has forgotten the start.

    Drake's solver stops at a relative residual of 1e-6, so that both are some 1e-8 m apart while
    friction turns at the start.
    """
    base = scenario_data(scenario("wall_point_contact", "duration=2", "compiled=true"))
    batch = list(enumerate(random_variations(UNKNOWN, RUNS)))
    runner = Runner(base, 2.0 * RUNS)
    list(runner.run_all(batch[:8]))  # The time of compiling is another figure.
    began = time.process_time()
    results = list(runner.run_all(batch))
    took = time.process_time() - began
    assert [result.reason for result in results] == [""] * RUNS
    wanted = Runner(base).records(batch[:COMPARED])
    apart, together = 0.0, runner.records(batch[:COMPARED])
    for (record, reason), (other, failure) in zip(together, wanted, strict=True):
        assert (reason, failure) == ("", "")
        outputs = (each["controlled_output"][each.time >= 1.0, :2] for each in (record, other))
        apart = max(apart, np.abs(np.subtract(*outputs)).max())
    assert apart < 1e-8
    report(
        f"wall_point_contact: {RUNS:,} unknown contacts by rollouts",
        {
            "processor [s]": f"{took:.1f} (<60)",
            f"{COMPARED} of them off Drake's plant [m]": f"{apart:.1e}",
        },
    )
