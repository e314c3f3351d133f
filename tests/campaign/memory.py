"""Memory of many closed loops: python tests/campaign/memory.py --loops 1000."""

import argparse
import ctypes
import gc
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

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
    return int(bad)


if __name__ == "__main__":
    sys.exit(main())
