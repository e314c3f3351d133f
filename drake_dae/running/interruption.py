"""Signals that ask a run to end."""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

# Ctrl-C, the signals of batch systems and `kill`, and a closed terminal.
ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
AGAIN = 1e-3  # The delay in s after which a signal during a call of CasADi is raised again.


@contextmanager
def ending_signals(handle: Callable[[signal.Signals], None]) -> Iterator[None]:
    """Calls a function when a signal asks the process to end; in its main thread alone."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = {}

    def received(number: int, frame: FrameType | None) -> None:
        if _is_called_by_casadi(frame):
            # Again, a moment later.
            later = threading.Timer(AGAIN, os.kill, (os.getpid(), number))
            later.daemon = True
            later.start()
        else:
            handle(signal.Signals(number))

    try:
        for number in ENDING_SIGNALS:
            if number == signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN:
                continue
            previous[number] = signal.signal(number, received)
        yield
    finally:
        for number, handler in previous.items():
            # None: the previous handler was not set by Python.
            signal.signal(number, handler or signal.SIG_DFL)


def _is_called_by_casadi(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_globals.get("__name__") == "casadi.casadi":
            return True
        frame = frame.f_back
    return False


def end_at_once(number: signal.Signals) -> None:
    """Raises KeyboardInterrupt with the signal, whichever it is."""
    raise KeyboardInterrupt(number)


class Interruption:
    """Stores the first signal; a second one raises a KeyboardInterrupt."""

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None

    def __call__(self, number: signal.Signals) -> None:
        if self.signal is not None:
            end_at_once(number)
        self.signal = number
