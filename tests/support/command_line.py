"""The command line in a process of its own, and what short runs are asked for."""

import fcntl
import os
import pty
import struct
import subprocess
import sys
import termios

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


def shown_on_a_terminal(arguments, columns=0, **options):
    """What a command writes to stderr, a terminal; one of 0 columns does not know its width."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(
        theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24 if columns else 0, columns, 0, 0)
    )
    process = subprocess.Popen(
        [sys.executable, "-m", "drake_dae", *map(str, arguments)],
        stdout=subprocess.DEVNULL,
        stderr=theirs,
        env=os.environ | {"PYTHONUTF8": "1"},
        **options,
    )
    os.close(theirs)
    shown = b""
    try:
        while part := os.read(ours, 4096):
            shown += part
    except OSError:
        pass  # Linux says so when the other end is closed.
    os.close(ours)
    assert process.wait(timeout=600) == 0
    return shown.decode()


def error_line(capsys):
    """The one line on stderr."""
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    return line
