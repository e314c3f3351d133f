"""`python -m referee [MECHANISM ...]`: the installed engines; without names it writes table.md."""

import sys

from referee.compare import main

main(sys.argv[1:])
