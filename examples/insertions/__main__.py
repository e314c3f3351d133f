"""Inserts a peg into holes that are 2 mm and 1 degree off in random directions.

First it predicts the largest contact force, as `drake-dae analyze peg_in_hole` does. Then it prints
for each run how its task ended, when, and the largest contact force, and last all runs together.
The exit code is 1 if a peg is not inserted, or a force is above the predicted one.

With --rollout the same contact is traced and compiled once: 2 s in place of 8 for a run.

    python examples/insertions [--rollout] [--runs N] [--first SEED] [--set KEY=VALUE] [scenario]
"""

import argparse
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from pydrake.systems.analysis import SimulatorConfig

import drake_dae as dd
from drake_dae.scenario.feasibility.feasibility import find_feasibility

OFF, TILT = 0.002, math.radians(1.0)
"""How far the hole is from its place, in m, and its axis from its direction, in rad."""

LONGEST = 20.0
"""The longest run, in s."""


def place(seed: int, point: np.ndarray, normal: np.ndarray) -> dict[str, Any]:
    """The place of the plate and the friction in one run."""
    random = np.random.default_rng(seed)
    axes = np.linalg.svd(normal[None])[2][1:]
    aside, about = (
        np.array([math.cos(angle), math.sin(angle)]) @ axes
        for angle in random.uniform(0.0, 2.0 * math.pi, 2)
    )
    moved = point + OFF * aside + random.uniform(-1e-3, 1e-3) * normal
    return {
        "position": moved.tolist(),
        "rpy": (TILT * about).tolist(),
        "friction": random.uniform(0.1, 0.4),
    }


def settings(seed: int, point: np.ndarray, normal: np.ndarray) -> list[str]:
    """The same as settings of the scenario."""
    found = place(seed, point, normal)
    return [
        f"plant_parameters.wall.position={found['position']}",
        f"plant_parameters.wall.rpy={found['rpy']}",
        f"plant.friction={found['friction']}",
    ]


def insert(scenario: str, changes: Sequence[str]) -> tuple[str, float, float]:
    """The last change of phase in words, its time in s, and the largest contact force in N."""
    loop, context = dd.build_scenario(dd.load_scenario(scenario, changes))
    outcome, time = "", 0.0
    try:
        while context.get_time() < LONGEST and not outcome.startswith(("done", "held")):
            config = SimulatorConfig(start_time=context.get_time())
            # Whether errors grow cannot be judged from the start of a part of a run.
            run = dd.simulate(loop.diagram, context, 0.5, config, may_diverge=True)
            if run.interrupted is not None:
                raise SystemExit(f"ended by {run.interrupted.name}")
            last = loop.changes(context)[-1]
            outcome, time = f"{last.phase}, {last.reason}", last.time
    except dd.DrakeDaeError as error:
        outcome, time = str(error), context.get_time()
    forces = loop.record(context)["contact_force"]
    return outcome, time, float(np.linalg.norm(forces, axis=1).max())


def insert_rolled(
    scenario: str, changes: Sequence[str], seeds: Sequence[int]
) -> Iterator[tuple[str, float, float]]:
    """The same as `insert` for each seed, by rollouts of one loop whose contact is traced."""
    chosen = dd.load_scenario(scenario, changes)
    *before, last = chosen.task.phases
    task = replace(chosen.task, phases=[*before, replace(last, on_success="stop")])
    material = chosen.plant.rolled
    loop, context = dd.build_scenario(replace(chosen, plant=material, task=task))
    plant = loop.plant
    at_plant, times = plant.GetMyMutableContextFromRoot(context), np.arange(0.0, LONGEST, 1e-3)
    surface = chosen.constraints[0].surface
    for seed in seeds:
        found = place(seed, np.array(surface.point), np.array(surface.normal))
        plant.set_parameter(at_plant, "wall.position", found["position"])
        plant.set_parameter(at_plant, "wall.rpy", found["rpy"])
        plant.set_contact(at_plant, replace(material, friction=found["friction"]))
        (run,) = dd.rollout(loop, *dd.start_values(loop, context), times, compiled=True)
        ended = str(run.failure or "not finished")
        if run.failure is None and run.context is not None:
            change = loop.changes(run.context)[-1]
            ended = f"{'done' if change.chosen == 'stop' else change.phase}, {change.reason}"
        force = np.linalg.norm(run.record["contact_force"], axis=1).max()
        yield ended, float(run.record.time[-1]), float(force)


def predicted(scenario: str, changes: Sequence[str]) -> dict[str, float]:
    """The largest force in N for each phase that touches, as `drake-dae analyze` prints it."""
    needs = find_feasibility(dd.load_scenario(scenario, changes)).task
    assert needs is not None
    peaks = {touch.phase: touch.peak for touch in needs.touches if touch.peak is not None}
    return peaks | {hole.phase: hole.peak for hole in needs.holes}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenario", nargs="?", default="peg_in_hole")
    parser.add_argument("--runs", type=int, default=20, help="their number (default: 20)")
    parser.add_argument("--first", type=int, default=0, help="the seed of the first (default: 0)")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--rollout", action="store_true", help="run the contact as it is traced")
    options = parser.parse_args(arguments)
    if options.runs < 1:
        parser.error(f"--runs is their number, 1 or more, got {options.runs}")
    peaks = predicted(options.scenario, options.set)
    print("predicted: " + ", ".join(f"{name} {peak:.3g} N" for name, peak in peaks.items()))
    (constraint,) = dd.load_scenario(options.scenario, options.set).constraints
    point, normal = (np.array(getattr(constraint.surface, name)) for name in ("point", "normal"))
    times, forces = [], []
    seeds = range(options.first, options.first + options.runs)
    if options.rollout:
        runs = insert_rolled(options.scenario, options.set, seeds)
    else:
        every = ([*options.set, *settings(seed, point, normal)] for seed in seeds)
        runs = (insert(options.scenario, changes) for changes in every)
    for seed, (outcome, time, force) in zip(seeds, runs, strict=True):
        print(f"{seed}: {outcome}; {time:.2f} s, {force:.3g} N", flush=True)
        if outcome.startswith("done"):
            times.append(time)
            forces.append(force)
    print(f"{len(times)} of {options.runs} inserted", end="")
    if times:
        print(f", in {max(times):.3g} s and with {max(forces):.3g} N at most", end="")
    print()
    return int(len(times) < options.runs or max(forces, default=0.0) > max(peaks.values()))


if __name__ == "__main__":
    sys.exit(main())
