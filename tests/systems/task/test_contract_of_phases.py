"""The rules of `systems.task.phases.Phase`, run on every member."""

from dataclasses import replace

import numpy as np
import pytest
from members import Rise

from drake_dae import (
    Approach,
    Close,
    ConstantReference,
    Dwell,
    Follow,
    GuardedMove,
    Insert,
    Move,
    PhaseGuard,
    Press,
    Release,
    Retreat,
    Screw,
    Search,
    Wait,
)
from drake_dae.errors import ModelError
from drake_dae.systems.task.phases import Moment

CONTACT_FORCE = 0.5

# A phase; what is seen while it goes on; what is seen when it is over.
MEMBERS = {
    "Approach": (Approach(0.05), Moment(1.0, 0.0, 0.1, -0.05, 0.1), Moment(2.0, 0.6, 0.0, 0.0, 0)),
    "Close": (
        Close(tolerance=1e-3, speed=0.01),
        Moment(0.6, 0.0, 9e-4, 0.02, 0.0),
        Moment(0.6, 0.0, 9e-4, 0.005, 0.0),
    ),
    "Press": (Press(20.0), Moment(0.6, 18.0, 0.0, 0.0, 20.0), Moment(0.6, 19.5, 0.0, 0.0, 20.0)),
    "Press early": (
        Press(ConstantReference(20.0)),
        Moment(0.4, 20.0, 0.0, 0.0, 20.0),
        Moment(0.5, 20.0, 0.0, 0.0, 20.0),
    ),
    "Press flat": (
        Press(20.0, eccentricity=0.3),
        Moment(0.6, 20.0, 0.0, 0.0, 20.0, eccentricity=0.4),
        Moment(0.6, 20.0, 0.0, 0.0, 20.0, eccentricity=0.2),
    ),
    "Move": (Move({}, 2.0), Moment(1.9, 20.0, 0.0, 0.0, 20.0), Moment(2.0, 20.0, 0.0, 0.0, 20.0)),
    "Dwell": (Dwell(2.0), Moment(1.9, 0.0, 0.1, 0.0, 0.1), Moment(2.1, 0.0, 0.1, 0.0, 0.1)),
    "Wait": (
        Wait("ready"),
        Moment(1.9, 20.0, 0.0, 0.0, 20.0, signal=0.4),
        Moment(2.0, 20.0, 0.0, 0.0, 20.0, signal=1.0),
    ),
    "Wait long": (
        Wait(duration=2.0),
        Moment(1.9, 20.0, 0.0, 0.0, 20.0),
        Moment(2.0, 20.0, 0.0, 0.0, 20.0),
    ),
    "GuardedMove": (
        GuardedMove(0.1, force=5.0),
        Moment(1.0, 4.9, 0.1, -0.02, 0.1, travel=0.09),
        Moment(1.0, 5.1, 0.0, -0.02, 0.0, travel=0.09),
    ),
    "Search": (
        Search("tool.yz", 0.01, depth=0.002),
        Moment(1.0, 5.0, -0.0019, 0.0, 5.0, away=-0.0019),
        Moment(1.0, 5.0, -0.0021, 0.0, 5.0, away=-0.0021),
    ),
    "Search along a line": (
        Search("tool.yz", 0.1, pattern="line", heading=1.0),
        Moment(1.0, 5.0, -0.0019, 0.0, 5.0, away=-0.0019),
        Moment(1.0, 5.0, -0.0021, 0.0, 5.0, away=-0.0021),
    ),
    "Follow": (
        Follow("tool.z", -0.1, speed=0.05),  # 2 s at its speed, 0.1 s for the ramps, 0.5 s over.
        Moment(2.5, 10.0, 0.0, 0.0, 10.0),
        Moment(2.8, 10.0, 0.0, 0.0, 10.0),
    ),
    "Insert": (
        Insert(0.02, lag=0.005),
        Moment(1.0, 2.0, -0.015, -0.01, -0.019),
        Moment(2.0, 2.0, -0.0201, -0.01, -0.022),
    ),
    "Screw": (
        Screw("joint7", 0.001, 2.0, speed=6.0),
        Moment(1.0, 20.0, -0.0007, -0.001, 20.0, away=-0.0006),
        Moment(5.0, 20.0, -0.002, 0.0, 20.0, away=-0.002),
    ),
    "Screw until it is tight": (
        Screw("joint7", 0.001, -2.0, "joint7", 0.8, speed=6.0),
        Moment(1.0, 20.0, -0.0007, -0.001, 20.0, away=-0.0006, torque=0.7),
        Moment(1.0, 20.0, -0.0007, -0.001, 20.0, away=-0.0006, torque=0.81),
    ),
    "Rise": (Rise(0.5), Moment(0.4, 0.0, 0.1, 0.0, 0.1), Moment(0.6, 0.0, 0.1, 0.0, 0.1)),
    "Release": (Release(), Moment(0.3, 3.0, 0.0, 0.0, 3.0), Moment(0.5, 0.4, 0.0, 0.0, 0.3)),
    "Retreat": (Retreat(0.1), Moment(0.6, 0.0, 0.09, 0.1, 0.1), Moment(0.6, 0.0, 0.1, 0.0, 0.1)),
}


@pytest.mark.parametrize("name", MEMBERS)
def test_phase_keeps_the_rules(name):
    phase, going_on, over = MEMBERS[name]
    assert phase.name == name.split()[0]
    assert phase.margin(going_on, CONTACT_FORCE) > 0.0  # Rule 4.
    assert phase.margin(over, CONTACT_FORCE) <= 0.0
    assert phase.within > going_on.time
    assert phase.chosen("late") == "fail" == phase.chosen("guard")  # Rule 5.
    assert phase.chosen("lost") == "hold"
    assert phase.chosen("success") == "next"
    assert phase.awaited(CONTACT_FORCE)
    # Rule 1: what leads from one law to the other says so of both ends.
    assert (phase.begins_in_contact is None) == (phase.ends_in_contact is None)
    # Rule 2: what approaches has no goal for the distance.
    goals = phase.goals("contact")
    assert set(goals) <= {"contact"} or phase.is_relative
    assert not phase.rates("contact") or not goals
    # What a guard may not end is reached by what ends the phase.
    assert all(getattr(over, of) >= least for of, least in phase.needed(CONTACT_FORCE).items())


@pytest.mark.parametrize("name", MEMBERS)
def test_phase_takes_a_name_guards_and_successors(name):
    guards = [PhaseGuard("force", 50.0)]
    chosen = {"on_success": "done", "on_failure": "leave", "retries": 2, "if_spent": "hold"}
    phase = replace(MEMBERS[name][0], name="mine", guards=guards, **chosen)
    assert (phase.name, phase.guards) == ("mine", tuple(guards))
    assert phase.chosen("success") == "done"
    assert {phase.chosen(outcome) for outcome in ("guard", "late", "lost")} == {"leave"}
    assert phase.lateness(MEMBERS[name][1], CONTACT_FORCE).startswith("mine ")


def test_a_release_that_has_left_does_not_wait_for_the_force():
    near, far = (Moment(0.3, 1.0, 0.0, 0.0, 0.0, away) for away in (0.019, 0.021))
    assert Release().remaining(near) > 0.0 > Release().remaining(far)
    assert "gone 0.021 m away, and a force of 1 N" in Release().lateness(far, CONTACT_FORCE)
    late = replace(far, time=61.0)
    assert Release().lateness(late, CONTACT_FORCE).startswith("Release has waited 60 s")


def test_a_press_on_an_edge_says_what_it_waits_for():
    on_edge = Moment(60.0, 20.0, 0.0, 0.0, 20.0, eccentricity=1.0)
    assert Press(20.0).lateness(on_edge, CONTACT_FORCE) == (
        "Press has waited 60 s for all points of its face, and has an eccentricity of 1, more than "
        "0.5"
    )
    flat = replace(on_edge, force=10.0, eccentricity=0.0)
    assert "for a force within 1 N" in Press(20.0).lateness(flat, CONTACT_FORCE)


def test_an_insertion_that_jams_is_late():
    """The lag is the distance less its reference; 5.1 mm of it are too much, 4.9 mm are not."""
    going, jammed = (Moment(1.0, 7.0, -0.004, 0.0, -0.004 - lag) for lag in (0.0049, 0.0051))
    phase = Insert(0.02, lag=0.005)
    assert phase.remaining(going) > 0.0 > phase.remaining(jammed)
    text = phase.lateness(jammed, CONTACT_FORCE)
    assert text == (
        "Insert lags 0.0051 m behind its reference at a depth of 0.004 m, with a force of 7 N"
    )


def path_of(search):
    """Points along the path of a search, from its start to its end, shape (k, 2)."""
    place = search.path.derivatives([0, 0])
    return np.array([place(time) for time in np.linspace(0.0, search.duration, 4001)])


@pytest.mark.parametrize("heading", [0.0, 2.0])
def test_a_line_and_a_raster_go_along_their_heading(heading):
    """In axes along and across it, from the start: a straight line, and lines over a rectangle."""
    turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
    settings = {"radius": 0.01, "heading": heading, "speed": 0.02}
    line = path_of(Search("tool.yz", pattern="line", **settings)) @ turn
    np.testing.assert_allclose(line[:, 1], 0.0, atol=1e-15)
    np.testing.assert_allclose(line[[0, -1], 0], [0.0, 0.01], atol=1e-12)
    assert np.all(np.diff(line[:, 0]) >= -1e-15)
    raster = path_of(Search("tool.yz", pattern="raster", pitch=0.003, **settings)) @ turn
    np.testing.assert_allclose(raster[0], 0.0, atol=1e-15)
    # Five lines, 3 mm apart, the last one at least 10 mm ahead.
    np.testing.assert_allclose(raster.min(0), [0.0, -0.01], atol=1e-12)
    np.testing.assert_allclose(raster.max(0), [0.012, 0.01], atol=1e-12)
    grid = np.stack(np.meshgrid(np.linspace(0, 0.01, 21), np.linspace(-0.0095, 0.0095, 21)), -1)
    apart = [np.linalg.norm(raster - place, axis=1).min() for place in grid.reshape(-1, 2)]
    assert max(apart) < 0.0016


@pytest.mark.parametrize("name", MEMBERS)
def test_phase_takes_time(name):
    phase = MEMBERS[name][0]
    with pytest.raises(ModelError, match=rf"{phase.name}: over must be positive, got 0\.0"):
        replace(phase, over=0.0)


@pytest.mark.parametrize("name", MEMBERS)
def test_a_pace_changes_times_and_speeds_and_nothing_else(name):
    """Twice the pace, then half of it, is the same phase."""
    phase = MEMBERS[name][0]
    fast = phase.at_pace(2.0)
    assert fast.over == phase.over / 2.0
    assert fast.awaited(CONTACT_FORCE).split()[0] == phase.awaited(CONTACT_FORCE).split()[0]
    assert fast.speed_of_approach == 2.0 * phase.speed_of_approach
    if not isinstance(phase, Move):  # Its references are wrapped.
        assert fast.at_pace(0.5) == phase
