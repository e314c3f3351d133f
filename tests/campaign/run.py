"""Runs the campaign: python tests/campaign/run.py --count 1500 --robots 500 --seed 0."""

import argparse
import json
import logging
import multiprocessing
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import Future
from pathlib import Path

from pebble import ProcessExpired, ProcessPool

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))

from campaign import bad_files, bad_inputs, random_robots
from campaign.outcomes import BAD, CLASSES, HANG, RESULT, Outcome

ATTEMPTS = {
    "input": bad_inputs.attempt,
    "file": bad_files.attempt,
    "robot": random_robots.attempt,
    "measured": random_robots.measured,
}

TIME_LIMIT = 30.0
"""For one attempt, s."""

Item = tuple[str, int]


def campaign(
    items: Sequence[Item], processes: int, limit: float = TIME_LIMIT
) -> dict[Item, Outcome]:
    """Attempts all items, each within a time limit; what kills its process counts as a hang."""
    with ProcessPool(processes, context=multiprocessing.get_context("fork")) as pool:
        futures = {item: pool.schedule(_attempt, item, timeout=limit) for item in items}
        return {item: _outcome(item, future) for item, future in futures.items()}


def _outcome(item: Item, future: Future[Outcome]) -> Outcome:
    try:
        return future.result()
    except (TimeoutError, ProcessExpired) as error:
        return Outcome(str(item), HANG, str(error))


def _attempt(kind: str, seed: int) -> Outcome:
    # Not its level: what Drake only warns of may be refused.
    log = logging.getLogger("drake")
    log.handlers, log.propagate = [logging.NullHandler()], False
    with tempfile.TemporaryDirectory() as folder:
        return ATTEMPTS[kind](seed, Path(folder))


def report(outcomes: dict[Item, Outcome]) -> str:
    """Counts per class, what runs and why, and every attempt that ended as it must not."""
    lines = []
    for kind in ATTEMPTS:
        own = {item: outcome for item, outcome in outcomes.items() if item[0] == kind}
        if not own:
            continue
        counts = Counter(outcome.kind for outcome in own.values())
        lines += ["", f"{len(own)} attempts of kind '{kind}'"]
        lines += [f"  {counts[each]:5d}  {each}" for each in CLASSES]
        ran = [outcome for outcome in own.values() if outcome.kind == RESULT]
        if ran:
            lines.append(
                f"  residual {max(outcome.residual for outcome in ran):.2g} at most, "
                f"off prediction {max(outcome.off for outcome in ran):.2g} at most"
            )
        lines += _table("ran", Counter(outcome.text for outcome in ran))
        refused = (outcome for outcome in own.values() if outcome.kind == "refused")
        lines += _table("refused", Counter(outcome.text.split(":")[0] for outcome in refused))
        lines += [
            f"  seed {item[1]}: {outcome.kind}: {outcome.what}\n      {outcome.text[:300]}"
            for item, outcome in sorted(own.items())
            if outcome.kind in BAD
        ]
    return "\n".join(lines)


def _table(title: str, counts: Counter[str]) -> list[str]:
    return [f"  {title}:", *(f"  {count:7d}  {text}" for text, count in counts.most_common())]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1500, help="bad inputs")
    parser.add_argument("--files", type=int, default=1000, help="bad files and command lines")
    parser.add_argument("--robots", type=int, default=500, help="random robots")
    parser.add_argument("--measured", type=int, default=500, help="the same, with encoders")
    parser.add_argument("--seed", type=int, default=0, help="of the first of each")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--accepted", action="store_true", help="list every bad input that ran")
    parser.add_argument("--json", type=Path, help="write every outcome into a file")
    given = parser.parse_args()
    items = [("input", given.seed + i) for i in range(given.count)]
    items += [("file", given.seed + i) for i in range(given.files)]
    items += [("robot", given.seed + i) for i in range(given.robots)]
    items += [("measured", given.seed + i) for i in range(given.measured)]
    began = time.monotonic()
    outcomes = campaign(items, given.processes)
    print(report(outcomes))
    if given.accepted:
        for (kind, seed), outcome in sorted(outcomes.items()):
            if kind == "input" and outcome.kind == RESULT:
                print(f"  accepted: seed {seed}: {outcome.what}: {outcome.text}")
    if given.json:
        table = [{"item": item, **vars(outcome)} for item, outcome in outcomes.items()]
        given.json.write_text(json.dumps(table, indent=1))
    print(f"\n{time.monotonic() - began:.0f} s")
    return int(any(outcome.kind in BAD for outcome in outcomes.values()))


if __name__ == "__main__":
    sys.exit(main())
