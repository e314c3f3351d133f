"""Inserts a peg into holes that are 2 mm and 1 degree off in random directions.

First it predicts the largest contact force. Then it prints for each run how its task ended, when,
and the largest contact force, and last all runs together.

    python examples/insertions [--runs COUNT] [--first SEED] [--set KEY=VALUE] [scenario]
"""

import argparse
import math
from collections.abc import Sequence

import casadi as ca
import numpy as np
from pydrake.systems.analysis import SimulatorConfig

import drake_dae as dd

OFF, TILT = 0.002, math.radians(1.0)
"""How far the hole is from its place, in m, and its axis from its direction, in rad."""

LONGEST = 20.0
"""The longest run, in s."""


def settings(seed: int, point: np.ndarray, normal: np.ndarray) -> list[str]:
    """The place of the plate and its friction in one run, as settings of the scenario."""
    random = np.random.default_rng(seed)
    axes = np.linalg.svd(normal[None])[2][1:]
    aside, about = (
        np.array([math.cos(angle), math.sin(angle)]) @ axes
        for angle in random.uniform(0.0, 2.0 * math.pi, 2)
    )
    place = point + OFF * aside + random.uniform(-1e-3, 1e-3) * normal
    return [
        f"plant_parameters.wall.position={place.tolist()}",
        f"plant_parameters.wall.rpy={(TILT * about).tolist()}",
        f"plant.friction={random.uniform(0.1, 0.4)}",
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


def predicted(scenario: str, changes: Sequence[str]) -> dict[str, float]:
    """The largest force in N for each phase that may hit: F + v sqrt(K m) + v K t.

    F is the force of a Press before, and v the speed. A touch hits with all balls of the end of the
    peg, K = count k, in a hole with two of them. The mass m at the tool is 1 / (P M^-1 P^T) along
    the motion, and in the time t until the law reacts the tool moves on by v t.
    """
    chosen = dd.load_scenario(scenario, changes)
    loop, context = dd.build_scenario(chosen)
    model, plant = loop.plant.robot("masses"), chosen.plant
    size = model.links.q.numel()
    moves = ca.jacobian(ca.vertcat(model.dae.k, model.dae.l[:2]), model.dae.state)[:, :size]
    mass = model.dae.mass_matrix[size : 2 * size, size : 2 * size]
    function = model.dae.trace("moves", {"value": ca.mtimes(moves, ca.solve(mass, moves.T))})
    state = loop.plant.state(loop.plant.GetMyContextFromRoot(context))
    masses = 1.0 / np.diag(function(state, model.dae.parameter_values)[0].reshape(3, 3))
    late, peaks, force = chosen.sampling.period + chosen.sampling.delay, {}, 0.0
    for phase in chosen.task.phases:
        if isinstance(phase, dd.Press):
            force = phase.force
            continue
        if isinstance(phase, dd.Approach):
            count, m, speed, pressed = plant.pegs[0].balls, masses[0], phase.speed, 0.5
        elif isinstance(phase, dd.Search):
            count, m, speed, pressed = 2, masses[1:].max(), phase.speed, force
        elif isinstance(phase, dd.Insert):
            count, m, speed, pressed = 2, masses[0], phase.speed, 0.0
        else:
            continue
        stiffness = count * plant.stiffness
        hit = speed * (math.sqrt(stiffness * m) + stiffness * late)
        peaks[phase.name] = pressed + hit
    return peaks


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenario", nargs="?", default="peg_in_hole")
    parser.add_argument("--runs", type=int, default=20, help="their number (default: 20)")
    parser.add_argument("--first", type=int, default=0, help="the seed of the first (default: 0)")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    options = parser.parse_args()
    peaks = predicted(options.scenario, options.set)
    print("predicted: " + ", ".join(f"{name} {peak:.3g} N" for name, peak in peaks.items()))
    (constraint,) = dd.load_scenario(options.scenario, options.set).constraints
    point, normal = (np.array(getattr(constraint.surface, name)) for name in ("point", "normal"))
    times, forces = [], []
    for seed in range(options.first, options.first + options.runs):
        changes = [*options.set, *settings(seed, point, normal)]
        outcome, time, force = insert(options.scenario, changes)
        print(f"{seed}: {outcome}; {time:.2f} s, {force:.3g} N", flush=True)
        if outcome.startswith("done"):
            times.append(time)
            forces.append(force)
    print(f"{len(times)} of {options.runs} inserted", end="")
    if times:
        print(f", in {max(times):.3g} s and with {max(forces):.3g} N at most", end="")
    print()


if __name__ == "__main__":
    main()
