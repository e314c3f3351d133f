"""Signals that end a run are heard wherever they come."""

import signal
import time
from contextlib import suppress

import casadi as ca
import pytest

from drake_dae.running.interruption import ENDING_SIGNALS, Interruption, end_at_once, ending_signals


class Interrupted:
    """What is asked by CasADi, whether it is a matrix, and is interrupted in the answer."""

    def __init__(self, sent: signal.Signals) -> None:
        self.sent, self.asked = sent, 0

    @property
    def shape(self) -> tuple[int, int]:
        self.asked += 1
        if self.asked == 1:
            signal.raise_signal(self.sent)
        return 2, 1


def compute(found: Interrupted) -> None:
    """CasADi loses exceptions of its arguments' answers, and says that it knows no such type."""
    with suppress(NotImplementedError, TypeError):
        ca.SX.sym("x", 2) + found
    assert found.asked


@pytest.mark.usefixtures("signals_of_a_shell")
@pytest.mark.parametrize("sent", ENDING_SIGNALS)
def test_a_signal_within_a_call_of_casadi_is_heard(sent):
    def wait():
        with ending_signals(end_at_once):
            compute(Interrupted(sent))
            time.sleep(20)

    with pytest.raises(KeyboardInterrupt) as ended:
        wait()
    assert ended.value.args == (sent,)
    with ending_signals(ending := Interruption()):
        compute(Interrupted(sent))
        limit = time.monotonic() + 20
        while ending.signal is None and time.monotonic() < limit:
            time.sleep(1e-3)
    assert ending.signal == sent
