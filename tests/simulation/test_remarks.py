"""What a run says of what is approximate in it."""

import re

import numpy as np
import pytest

from drake_dae import Record
from drake_dae.cli import main
from drake_dae.dae.system.signals import Signal
from drake_dae.simulation.records.record import Recorded
from drake_dae.simulation.remarks import limit_remarks
from drake_dae.simulation.summary import Limits

SHORT = ("--set", "duration=0.02", "--set", "write={plots: false, animation: false}")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "settings", "told"),
    [
        ("wall_point_contact", (), True),
        ("two_link_wall", (), False),
        ("two_link_wall", ("--set", "plant=!MultibodyPlant {radius: 0.004}"), True),
    ],
)
def test_a_run_on_drakes_contact_says_that_its_ball_rolls(name, settings, told, tmp_path, capsys):
    assert main(["simulate", name, *SHORT, *settings, "--out", str(tmp_path / "run")]) == 0
    words = " ".join(capsys.readouterr().out.split())
    assert ("Where the robot tilts by an angle a the ball rolls" in words) is told
    assert ("contact is that of a ball of 4 mm" in words) is bool(settings)


def test_the_nearest_limits_are_named_with_what_is_left():
    """Of two drives the second uses 60 %; of two joints the first is 0.1 of its 4 rad away."""
    control = np.array([[1.0, -6.0], [-2.0, 3.0]])
    state = np.array([[0.0, 0.0], [1.6, 0.4]])
    record = Record(
        [0.0, 1.0],
        {
            "control": Recorded(control, [Signal("first", "N m"), Signal("second", "N m")]),
            "state": Recorded(state, [Signal("shoulder", "rad"), Signal("elbow", "rad")]),
        },
    )
    limits = Limits(np.array([np.inf, 10.0]), (np.array([-2.0, -1.0]), np.array([2.0, 1.0])))
    drive, joint = limit_remarks(record, limits)
    assert re.search("second .*60% of 10 N m", drive)
    assert re.search(r"shoulder .*0\.4 rad", joint)
    free = np.array([-np.inf, -np.inf]), np.array([np.inf, 1.0])
    assert limit_remarks(record, Limits(np.array([np.inf, np.inf]), free)) == []
