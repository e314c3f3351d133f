"""`python -m contact_peers`: measures, and writes table.md and the picture."""

import argparse
from pathlib import Path

from contact_peers.laws import LAWS
from contact_peers.picture import draw
from contact_peers.search import search_all
from contact_peers.table import load_rows, measure_all, page

HERE = Path(__file__).parent


def main() -> None:
    parser = argparse.ArgumentParser(prog="contact_peers", description=__doc__)
    parser.add_argument("--search", action="store_true", help="search for the gains anew first")
    parser.add_argument("--ours", action="store_true", help="measure our law alone anew")
    given = parser.parse_args()
    if given.search:
        search_all()
    known = [row for row in load_rows() if row.law in LAWS] if given.ours else []
    rows = measure_all(known)
    (HERE / "table.md").write_text(page(rows))
    draw(rows, HERE.parent / "pictures" / "contact_peers.png")


if __name__ == "__main__":
    main()
