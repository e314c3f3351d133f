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
from multiprocessing.connection import Connection, wait
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))

from campaign import bad_files, bad_inputs, drops, random_robots
from campaign.outcomes import BAD, CLASSES, HANG, RESULT, Outcome

ATTEMPTS = {
    "input": bad_inputs.attempt,
    "file": bad_files.attempt,
    "several": bad_files.several,
    "robot": random_robots.attempt,
    "measured": random_robots.measured,
    "drop": drops.attempt,
}

TIME_LIMIT = 30.0
"""For one attempt, s."""

Item = tuple[str, int]


def campaign(
    items: Sequence[Item], processes: int, limit: float = TIME_LIMIT
) -> dict[Item, Outcome]:
    """Attempts all items, each within a time limit; what kills its process counts as a hang."""
    waiting, outcomes = list(reversed(items)), {}
    workers = [_Worker() for _ in range(processes)]
    while waiting or any(worker.item for worker in workers):
        for worker in workers:
            if worker.item is None and waiting:
                worker.start(waiting.pop())
        wait([worker.pipe for worker in workers if worker.item], timeout=0.2)
        for index, worker in enumerate(workers):
            if worker.item is None:
                continue
            outcome = worker.outcome(limit)
            if outcome is not None:
                outcomes[worker.item] = outcome
                worker.item = None
                if outcome.kind == HANG:
                    worker.stop()
                    workers[index] = _Worker()
    for worker in workers:
        worker.stop()
    return outcomes


class _Worker:
    """A process that makes one attempt after the other."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("fork")
        self.pipe, other = context.Pipe()
        self._process = context.Process(target=_serve, args=(other,), daemon=True)
        self._process.start()
        other.close()
        self.item: Item | None = None
        self._began = 0.0

    def start(self, item: Item) -> None:
        self.item, self._began = item, time.monotonic()
        self.pipe.send(item)

    def outcome(self, limit: float) -> Outcome | None:
        try:
            if self.pipe.poll():
                return self.pipe.recv()
        except EOFError:
            return Outcome(str(self.item), HANG, "the process died")
        if time.monotonic() - self._began > limit:
            return Outcome(str(self.item), HANG, f"no end within {limit} s")
        return None

    def stop(self) -> None:
        self._process.kill()
        self._process.join()
        self.pipe.close()


def _serve(pipe: Connection) -> None:
    # Not its level: what Drake only warns of may be refused.
    log = logging.getLogger("drake")
    log.handlers, log.propagate = [logging.NullHandler()], False
    os.environ["OMP_NUM_THREADS"] = "1"
    while True:
        kind, seed = pipe.recv()
        with tempfile.TemporaryDirectory() as folder:
            pipe.send(ATTEMPTS[kind](seed, Path(folder)))


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
    parser.add_argument("--several", type=int, default=500, help="several bad settings at once")
    parser.add_argument("--robots", type=int, default=500, help="random robots")
    parser.add_argument("--measured", type=int, default=500, help="the same, with encoders")
    parser.add_argument("--drops", type=int, default=1000, help="drops onto a floor")
    parser.add_argument("--seed", type=int, default=0, help="of the first of each")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--accepted", action="store_true", help="list every bad input that ran")
    parser.add_argument("--json", type=Path, help="write every outcome into a file")
    given = parser.parse_args()
    items = [("input", given.seed + i) for i in range(given.count)]
    items += [("file", given.seed + i) for i in range(given.files)]
    items += [("several", given.seed + i) for i in range(given.several)]
    items += [("robot", given.seed + i) for i in range(given.robots)]
    items += [("measured", given.seed + i) for i in range(given.measured)]
    items += [("drop", given.seed + i) for i in range(given.drops)]
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
