"""`python -m referee`: compares the engines that are installed, and writes table.md."""

import argparse
from pathlib import Path

from referee.compare import ENGINES, compare_motion, compare_state, find_engines, page
from referee.reference import MOTIONS, STATES, load
from referee.spatial import MECHANISMS


def main() -> None:
    parser = argparse.ArgumentParser(prog="referee", description=__doc__)
    parser.add_argument("mechanisms", nargs="*", help="these alone; the page is then not written")
    parser.add_argument("--ours", action="store_true", help="drake_dae alone, likewise")
    given = parser.parse_args()
    names = given.mechanisms or list(MECHANISMS)
    unknown = [name for name in names if name not in MECHANISMS]
    if unknown:
        parser.error(f"no mechanism {', '.join(unknown)}; there are {', '.join(MECHANISMS)}")
    engines, missing = find_engines(("ours",) if given.ours else ENGINES)
    start, end = load(STATES), load(MOTIONS)
    states, motions = {}, {}
    for name in names:
        mechanism = MECHANISMS[name]
        states[name] = {e.NAME: compare_state(e, mechanism, start) for e in engines}
        print(name, *(f"{key} {cell}" for key, cell in states[name].items()), sep="  ", flush=True)
        if name in end:
            title = f"{name}, {mechanism.duration:g} s"
            motions[title] = {e.NAME: compare_motion(e, mechanism, start, end) for e in engines}
            cells = (f"{key} {cell}" for key, cell in motions[title].items())
            print("  after", *cells, sep="  ", flush=True)
    text = page(engines, states, motions, missing)
    print("\n" + text)
    if not (given.mechanisms or given.ours):
        Path(__file__).with_name("table.md").write_text(text)


if __name__ == "__main__":
    main()
