"""The figures of a run, of a record made by hand."""

import numpy as np
import pytest

from drake_dae import Record, Signal
from drake_dae.simulation.figures import figures_of, margins
from drake_dae.simulation.records.record import Recorded
from drake_dae.simulation.summary import Limits


def recorded(names, unit, *columns):
    return Recorded(np.array(columns, float).T, tuple(Signal(name, unit) for name in names))


RECORD = Record(
    np.array([0.0, 0.5, 1.0]),
    {
        "tracking_error": recorded(["z", "f"], "m", [0.1, -0.3, 0.05], [0.0, 1.0, -2.0]),
        "constraint_force": recorded(["wall.force", "weld.fx"], "N", [5, -1, 8], [-3, -4, -5]),
        "control": recorded(["motor", "free"], "N m", [1, -7, 2], [0, 0, 100]),
        "constraint_residual": recorded(["wall"], "m", [1e-12, -3e-9, 0]),
        "state": recorded(["q1", "q2", "v1"], "rad", [0, 0.5, 2], [-1 - 1e-12, 0, 1], [9, 9, 9]),
    },
)
LIMITS = Limits(
    control=np.array([10.0, np.inf]),
    state=(np.array([-1.0, -1.0, -np.inf]), np.array([1.5, 2.0, np.inf])),
    pushing=frozenset({"wall.force"}),
)


def test_figures_by_hand():
    figures = figures_of(RECORD, margins(RECORD, LIMITS))
    assert figures == {
        "largest error of z [m]": 0.3,
        "final error of z [m]": 0.05,
        "late error of z [m]": pytest.approx(np.sqrt((0.3**2 - 0.3 * 0.05 + 0.05**2) / 3)),
        "largest error of f [m]": 2.0,
        "final error of f [m]": -2.0,
        "late error of f [m]": 1.0,
        "least wall.force [N]": -1.0,
        "largest wall.force [N]": 8.0,
        "least weld.fx [N]": -5.0,
        "largest weld.fx [N]": -3.0,
        "largest motor [N m]": 7.0,
        "largest free [N m]": 100.0,
        "margin of motor [N m]": 3.0,
        "margin of q1 [rad]": -0.5,
        "margin of q2 [rad]": 0.0,
        "largest residual": 3e-9,
        "end [s]": 1.0,
    }


def test_what_left_its_limits():
    """A force that pulls, a joint beyond; round-off on a limit is none."""
    assert margins(RECORD, LIMITS).exceeded == ("wall.force", "q1")
    free = margins(RECORD, Limits(pushing=frozenset()))
    assert [signal.name for signal in free.signals] == ["motor", "free"]
    assert free.values == [np.inf, np.inf]


def test_an_empty_record_has_none():
    empty = Record(
        np.zeros(0),
        {
            name: Recorded(values.values[:0], values.signals)
            for name, values in RECORD.signals.items()
        },
    )
    rooms = margins(empty, LIMITS)
    assert rooms.exceeded == ()
    assert figures_of(empty, rooms) == {}
