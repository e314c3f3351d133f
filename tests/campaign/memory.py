"""Memory of many closed loops and of a long run: python tests/campaign/memory.py --loops 1000."""

import argparse
import ctypes
import gc
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

from pydrake.systems.analysis import SimulatorConfig

from drake_dae import RobotPlant, build_scenario, load_scenario, make_closed_loop, simulate
from drake_dae.scenario.shipped import find_scenario

BOUND = 100.0
"""kB per closed loop."""


def resident() -> float:
    """Memory of this process in kB, after everything that can be freed was."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4.096


def growth(make: Callable[[], object], count: int) -> float:
    """kB that stay per call, after as many calls as it takes for caches to fill."""
    for _ in range(max(5, count // 10)):
        make()
    before = resident()
    for _ in range(count):
        make()
    return (resident() - before) / count


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--loops", type=int, default=1000)
    parser.add_argument("--steps", type=int, default=50_000)
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    scenario = load_scenario(find_scenario("two_link_wall"))
    first, _ = build_scenario(scenario)
    model, law, structure = first.plant.model, first.controller.law, first.plant.structure

    def again() -> None:
        plant = RobotPlant(model, structure=structure)
        loop = make_closed_loop(plant, law, scenario.references)
        context = loop.diagram.CreateDefaultContext()
        simulate(loop.diagram, context, 0.01, scenario.integrator)
        loop.record(context)

    loops = {"of the same model, run": again, "from its scenario": lambda: build_scenario(scenario)}
    bad = False
    for name, make in loops.items():
        kept = growth(make, given.loops)
        bad |= kept > BOUND
        print(f"{kept:8.2f} kB stay per closed loop {name} ({given.loops} of them)", flush=True)

    # One sample of all logged signals and of the time, in each step.
    loop, context = build_scenario(scenario)
    config = SimulatorConfig(
        integration_scheme="runge_kutta5", max_step_size=1e-5, use_error_control=False
    )
    size = sum(map(len, loop.signals.values())) + 1
    before = resident()
    done = simulate(loop.diagram, context, given.steps * 1e-5, config)
    per_step = (resident() - before) * 1e3 / done.steps
    print(
        f"{per_step:8.0f} bytes per step in {done.steps} steps; {8 * size} are logged, so "
        f"2 million steps take {2e6 * 8 * size / 1e9:.2f} to "
        f"{2e6 * 16 * size / 1e9:.2f} GB (a full log doubles)"
    )
    return int(bad)


if __name__ == "__main__":
    sys.exit(main())
