"""Runs the campaign: python tests/campaign/run.py --inputs 1600 --files 2000 --seed 0."""

import argparse
import logging
import multiprocessing
import os
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from pebble import ProcessExpired, ProcessPool

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))

from campaign import bad_inputs, random_robots
from campaign.outcomes import BAD, CLASSES, HANG, Outcome

ATTEMPTS = {
    "inputs": (bad_inputs.scenario_attempt, 1500, 30.0),
    "files": (bad_inputs.file_attempt, 1000, 30.0),
    "robots": (random_robots.attempt, 500, 30.0),
}
"""Kind -> its function of a seed and a folder, how many there are, and the time limit of one, s."""


def attempt(kind: str, seed: int) -> Outcome:
    # Not its level: what Drake only warns of may be refused.
    log = logging.getLogger("drake")
    log.handlers, log.propagate = [logging.NullHandler()], False
    with tempfile.TemporaryDirectory() as folder:
        return ATTEMPTS[kind][0](seed, Path(folder))


def report(kind: str, outcomes: dict[int, Outcome]) -> None:
    """Prints counts per class, and every attempt that ended as it must not."""
    counts = Counter(outcome.kind for outcome in outcomes.values())
    print(
        f"\n{len(outcomes)} {kind}", *(f"  {counts[each]:5d}  {each}" for each in CLASSES), sep="\n"
    )
    for seed, outcome in sorted(outcomes.items()):
        if outcome.kind in BAD:
            print(f"  seed {seed}: {outcome.kind}: {outcome.what}\n      {outcome.text[:300]}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    for kind, (_, count, _) in ATTEMPTS.items():
        parser.add_argument(f"--{kind}", type=int, default=count)
    parser.add_argument("--seed", type=int, default=0, help="of the first of each")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    given, began, is_bad = parser.parse_args(), time.monotonic(), False
    context = multiprocessing.get_context("fork")
    for kind, (_, _, limit) in ATTEMPTS.items():
        seeds, outcomes = range(given.seed, given.seed + getattr(given, kind)), {}
        with ProcessPool(given.processes, context=context) as pool:
            futures = {s: pool.schedule(attempt, (kind, s), timeout=limit) for s in seeds}
            for seed, future in futures.items():
                try:
                    outcomes[seed] = future.result()
                except (TimeoutError, ProcessExpired) as error:
                    outcomes[seed] = Outcome(f"{kind} {seed}", HANG, str(error))
        report(kind, outcomes)
        is_bad |= any(outcome.kind in BAD for outcome in outcomes.values())
    print(f"\n{time.monotonic() - began:.0f} s")
    return int(is_bad)


if __name__ == "__main__":
    sys.exit(main())
