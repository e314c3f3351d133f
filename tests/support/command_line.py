"""The command line in a process of its own, and what short runs are asked for."""

import subprocess
import sys

QUICK = ["--set", "write.plots=false", "--set", "write.animation=false"]


BARE = [*QUICK, "--set", "write.record=false"]


SHORT = ["--set", "duration=0.2"]


def command(*arguments, **options):
    return subprocess.Popen(
        [sys.executable, "-W", "error", "-m", "drake_dae", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )


def error_line(capsys):
    """The one line on stderr."""
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    return line
