"""Signals that ask a run to end."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Ctrl-C, what batch systems and `kill` send, and a terminal that is closed."""


@contextmanager
def ending_signals(handle: Callable[[signal.Signals], None]) -> Iterator[None]:
    """Calls a function when a signal asks the process to end, as long as the block lasts.

    Python allows this in the main thread only; in other threads nothing changes. A SIGHUP that is
    ignored, as under nohup, stays so.

    Args:
        handle: Gets the signal, between two instructions of Python.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = {}
    try:
        for number in ENDING_SIGNALS:
            if number == signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN:
                continue
            previous[number] = signal.signal(number, lambda n, _: handle(signal.Signals(n)))
        yield
    finally:
        for number, handler in previous.items():
            # None: the handler before was not Python's.
            signal.signal(number, handler or signal.SIG_DFL)


def end_at_once(number: signal.Signals) -> None:
    """Raises KeyboardInterrupt with the signal, whichever it is."""
    raise KeyboardInterrupt(number)


class Ending:
    """Remembers the first signal, instead of an exception in the middle of a step.

    Attributes:
        signal: What came, or None. A second one is a KeyboardInterrupt.
    """

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None

    def __call__(self, number: signal.Signals) -> None:
        if self.signal is not None:
            end_at_once(number)
        self.signal = number
