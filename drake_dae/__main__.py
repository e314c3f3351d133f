"""The command `drake-dae`, also as `python -m drake_dae`."""

import os
import sys

# Before NumPy is loaded: the matrices here are small, and a thread of BLAS for each core would use
# a fifth of the CPU time of a short run for waiting. OpenBLAS and MKL read this variable, too.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from drake_dae.cli import main

if __name__ == "__main__":
    sys.exit(main())
