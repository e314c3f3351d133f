"""A campaign of random runs, one for each seed, that goes on where it was interrupted."""

import argparse
import json
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

LONG = 60.0
"""A run that takes longer, in s, is printed."""


def run_seeds(
    description: str | None,
    outcome: Callable[[int, Path], str],
    bad: tuple[str, ...],
    kind: Callable[[str], str],
) -> int:
    """Runs the seeds that the command line names; returns 1 if one ends as none may.

    With `--out` each outcome is a line of that file when it is known, and the seeds in the file are
    not run again.

    Args:
        description: The text of `--help`.
        outcome: (seed, a folder for files) -> how it ends.
        bad: How the outcomes begin that none may have.
        kind: An outcome -> what is counted.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    seeds = range(options.seed, options.seed + options.count)
    lines = options.out.read_text().splitlines() if options.out and options.out.exists() else []
    ended = {seed: found for seed, found in map(json.loads, lines) if seed in seeds}
    with tempfile.TemporaryDirectory() as folder, suppress(KeyboardInterrupt):
        for seed in (seed for seed in seeds if seed not in ended):
            began = time.perf_counter()
            ended[seed] = found = outcome(seed, Path(folder))
            if options.out:
                with options.out.open("a") as file:
                    print(json.dumps([seed, found]), file=file)
            if found.startswith(bad) or time.perf_counter() - began > LONG:
                print(f"{seed}: {found[:400]}, {time.perf_counter() - began:.0f} s", flush=True)
    for text, count in Counter(map(kind, ended.values())).most_common():
        print(f"{count:6} {text}")
    wrong = [seed for seed, found in sorted(ended.items()) if found.startswith(bad)]
    print(f"{len(ended):6} runs, {len(wrong)} of them ended as none may: {wrong}")
    return int(bool(wrong))
