"""What a run says of what is approximate in it."""

from dataclasses import replace

import numpy as np
import pytest
from arms import arm, consistent_states, numbers

from drake_dae import Record, robot_motion_limits
from drake_dae.cli import main
from drake_dae.dae.system.signals import Signal
from drake_dae.simulation.records.record import Recorded
from drake_dae.simulation.remarks import departure_remarks, limit_remarks, rate_remarks
from drake_dae.simulation.summary import Limits
from drake_dae.systems.governing.feasible_control import FeasibleControl

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


def test_a_run_says_when_limits_made_errors_leave_their_prediction():
    """The second control is beyond the first drive's limit, the third beyond the second's."""
    found = arm("two_link")
    feasible = FeasibleControl(found.structure, robot_motion_limits(found.model))
    (state,) = consistent_states("two_link", 1)
    state[2:] = 0.0
    there = numbers("two_link", state[:2], np.zeros(2))
    still = there.bias - 20.0 * there.constraint_jacobian[0]  # At rest, with 20 N.
    commanded = np.tile(still, (5, 1))
    commanded[1, 0], commanded[3, 1] = 330.0, -140.0
    parameters = found.model.dae.parameter_values
    values = [feasible.function(state, u, parameters)[:3] for u in commanded]
    columns = [np.array(column) for column in zip(*values, strict=True)]
    times, signals = np.arange(5.0), found.model.dae.control_signals
    kinds = (signals, signals, feasible.departure_signals)
    recorded = {
        name: Recorded(values, of)
        for name, values, of in zip(("control", "excess", "departure"), columns, kinds, strict=True)
    }
    recorded["state"] = Recorded(np.tile(state, (5, 1)), found.model.dae.state_signals)
    (text,) = departure_remarks(Record(times, recorded), feasible)
    # What else exceeds a limit depends on the posture.
    assert text.startswith("Between 1 and 3 s, for 2 s in all, no motion along the path was within")
    assert "largest joint1_motor" in text
    assert "least joint2_motor" in text
    assert "largest joint2_motor" not in text
    size = np.abs(columns[2][:, 0]).max()
    assert f"left their prediction, of tool.z by up to {size:.2g} m/s^2" in text
    # The other torques accelerate it.
    assert rate_remarks(Record(times, recorded), feasible) == []
    rates = dict.fromkeys(("joint1_w", "joint2_w"), (-5.0, 5.0))
    agile = FeasibleControl(found.structure, replace(robot_motion_limits(found.model), rates=rates))
    (text,) = rate_remarks(Record(times, recorded), agile)
    assert text.startswith(
        "Between 1 and 3 s no motion along the path was within the limits of acc"
    )
    # M v' = u + J^T f - bias,   J v' = 0.
    matrix = np.block(
        [[there.mass, -there.constraint_jacobian.T], [there.constraint_jacobian, np.zeros((1, 1))]]
    )
    right = np.append(columns[0][3] - there.bias, 0.0)
    share = np.abs(np.linalg.solve(matrix, right)[:2]).max() / 5.0 - 1.0
    assert f" by {share:.2g} of it" in text
    recorded["departure"] = Recorded(0.0 * columns[2], feasible.departure_signals)
    assert departure_remarks(Record(times, recorded), feasible) == []
    assert departure_remarks(Record(times, {}), None) == []


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
    assert limit_remarks(record, limits) == [
        "of the drives second comes closest to its limit, with 60% of 10 N m",
        "of the joints shoulder comes closest to a limit, with 0.4 rad left",
    ]
    free = np.array([-np.inf, -np.inf]), np.array([np.inf, 1.0])
    assert limit_remarks(record, Limits(np.array([np.inf, np.inf]), free)) == []
