"""Many rollouts: side by side against one after the other, and their fixed cost.

By what they take of all cores together, in turn, since how fast a core is changes.
"""

import time

import numpy as np
import pytest
from runs import scenario
from timing import has_compiler

from drake_dae import build_scenario, rollout
from drake_dae.running import start_values
from drake_dae.running.rollout import rollout as module
from drake_dae.scenario.rolled import for_rollout
from drake_dae.scenario.scenario import scenario_data
from drake_dae.studies import make_variations
from drake_dae.studies.runs import Runner

FIXED = [
    "integrator.integration_scheme=runge_kutta3",
    "integrator.use_error_control=false",
    "integrator.max_step_size=1e-3",
]
ONE_AFTER_THE_OTHER = 10**9

pytestmark = pytest.mark.skipif(not has_compiler(), reason="there is no C compiler")


def in_turn(calls, rounds=15):
    """The least time of each on the processor, in s."""
    best = dict.fromkeys(calls, np.inf)
    for _ in range(rounds):
        for name, call in calls.items():
            began = time.process_time()
            call()
            best[name] = min(best[name], time.process_time() - began)
    return best


def problem(name, *settings, rolled=False):
    chosen = scenario(name, *settings)
    if rolled:
        chosen, _ = for_rollout(chosen)
    loop, context = build_scenario(chosen)
    return (loop, *start_values(loop, context)), chosen.integrator


@pytest.mark.parametrize(
    ("options", "wanted"), [("-march=native", 5e6), ("-march=native -mno-avx512f", 2.5e6)]
)
@pytest.mark.parametrize("robot", ["two_link_wall", "seven_joint_wall"])
def test_steps_side_by_side(robot, options, wanted, monkeypatch, report):
    """Of 1 ms and third order, without rows in between."""
    monkeypatch.setenv("CC", f"cc {options}")
    (loop, start, parameters), config = problem(robot, *FIXED)
    starts, times = np.tile(start, (16, 1)), [0.0, 5.0]

    def run(several, count):
        monkeypatch.setattr(module, "SEVERAL", several)
        rollout(loop, starts[:count], parameters, times, config=config, compiled=True)

    calls = {"lanes": lambda: run(8, 16), "scalar": lambda: run(ONE_AFTER_THE_OTHER, 4)}
    for call in calls.values():
        call()
    seconds = in_turn(calls)
    lanes, scalar = 16 * 5000 / seconds["lanes"], 4 * 5000 / seconds["scalar"]
    what = "without AVX-512" if "no-" in options else "as the processor can"
    goal = f" (>{wanted / 1e6:g})" if robot == "seven_joint_wall" else ""
    ratio = f"{lanes / 1e6:.2f}, x {lanes / scalar:.1f}{goal}"
    report(f"{robot}: million 1 ms steps a second of a core, {what}", {"side by side": ratio})


@pytest.mark.parametrize("name", ["wall_point_contact", "wall_flexible_contact"])
def test_contact_beside_real_time(name, report):
    """2 s each of an arm on Drake's contact, traced, with law and observer at 1 kHz."""
    (loop, start, parameters), config = problem(name, "duration=2", rolled=True)
    times = np.linspace(0.0, 2.0, 2001)

    def run(count):
        starts = np.tile(start, (count, 1))
        found = rollout(loop, starts, parameters, times, config=config, compiled=True)
        assert all(each.failure is None for each in found)

    calls = {"lanes": lambda: run(16), "scalar": lambda: run(2)}
    for call in calls.values():
        call()
    seconds = in_turn(calls, 4)
    report(
        f"{name}: times real time a core, all rows recorded",
        {
            "16 side by side": f"{16 * 2.0 / seconds['lanes']:.0f} (>500)",
            "alone": f"{2 * 2.0 / seconds['scalar']:.0f}",
        },
    )


def test_ten_thousand_short_runs(report):
    """1 s each at 1e-6, with other starts and parameters."""
    (loop, start, parameters), config = problem("two_link_wall", "integrator.accuracy=1e-6")
    manifold, random = loop.plant.structure.manifold, np.random.default_rng(0)
    starts = [manifold.settle(start + 0.05 * random.normal(size=4)) for _ in range(500)] * 20
    rows = np.tile(parameters, (10_000, 1))

    def run():
        found = rollout(loop, starts, rows, [0.0, 1.0], config=config, compiled=True)
        assert all(each.failure is None for each in found)

    run()
    took = in_turn({"lanes": run}, 4)["lanes"]
    report("two_link_wall: 10,000 rollouts of 1 s", {"processor time [s]": f"{took:.2f} (<0.5)"})


def test_a_run_of_a_sweep(report):
    """10 s of the 2-link wall at 1e-8 with 1,001 rows, from its keys to its figures."""
    runner = Runner(scenario_data(scenario("two_link_wall", "compiled=true")), 1e6)
    variations = make_variations({"start.errors.tool.z": np.linspace(-0.05, 0.05, 64)})

    def run():
        assert all(runner.run(each).reason == "" for each in variations)

    run()
    took = in_turn({"sweep": run}, 10)["sweep"] / len(variations)
    report(
        "two_link_wall: a run of a sweep by rollouts", {"processor [ms]": f"{1e3 * took:.2f} (<10)"}
    )
