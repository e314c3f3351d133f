"""`drake-dae cache`: shows the machine code in the cache, or removes it."""

import argparse

from drake_dae.errors import MachineCodeError
from drake_dae.trace.cache import cache_folder, clear, contents
from drake_dae.trace.compiler import find_compiler


def run_command(options: argparse.Namespace) -> int:
    """Prints the cache's contents and the compiler; returns the exit code."""
    files = contents()
    size = sum(path.stat().st_size for path in files if path.is_file())
    what = f"{len(files)} files, {size / 1e6:.1f} MB"
    if options.clear:
        clear()
        print(f"removed from {cache_folder()}: {what}")
        return 0
    print(f"cache     {cache_folder()}: {what}")
    try:
        print(f"compiler  {' '.join(find_compiler().command)}")
    except MachineCodeError as error:
        print(f"compiler  none: {error}")
    return 0
