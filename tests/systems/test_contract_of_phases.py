"""The rules of `systems.phases.Phase`, run on every member; numbers are expressions too."""

from dataclasses import replace

import numpy as np
import pytest
from members import Rise

from drake_dae import Approach, ConstantReference, Dwell, Move, Press, Release, Retreat
from drake_dae.errors import ModelError
from drake_dae.systems import Condition
from drake_dae.systems.phases import Moment

CONTACT_FORCE = 0.5

# A phase; what is seen while it goes on; what is seen when it is over.
MEMBERS = {
    "Approach": (Approach(0.05), Moment(1.0, 0.0, 0.1, -0.05, 0.1), Moment(2.0, 0.6, 0.0, 0.0, 0)),
    "Press": (Press(20.0), Moment(0.6, 18.0, 0.0, 0.0, 20.0), Moment(0.6, 19.5, 0.0, 0.0, 20.0)),
    "Press early": (
        Press(ConstantReference(20.0)),
        Moment(0.4, 20.0, 0.0, 0.0, 20.0),
        Moment(0.5, 20.0, 0.0, 0.0, 20.0),
    ),
    "Move": (Move({}, 2.0), Moment(1.9, 20.0, 0.0, 0.0, 20.0), Moment(2.0, 20.0, 0.0, 0.0, 20.0)),
    "Dwell": (Dwell(2.0), Moment(1.9, 0.0, 0.1, 0.0, 0.1), Moment(2.1, 0.0, 0.1, 0.0, 0.1)),
    "Dwell until": (
        Dwell(until=[Condition("signal", above=0.5, name="ready"), Condition("time", above=2.0)]),
        Moment(1.9, 20.0, 0.0, 0.0, 20.0, signal={"ready": 0.4}),
        Moment(1.9, 20.0, 0.0, 0.0, 20.0, signal={"ready": 1.0}),
    ),
    "Move until it has settled": (
        Move({}, until=[Condition("force error", below=2.0)]),
        Moment(0.4, 20.0, 0.0, 0.0, 20.0),  # In its transition.
        Moment(0.6, 18.5, 0.0, 0.0, 20.0),
    ),
    "Move until": (
        Move({}, until=[Condition("force", above=5.0)]),
        Moment(1.0, 4.9, 0.1, -0.02, 0.1),
        Moment(1.0, 5.1, 0.0, -0.02, 0.0),
    ),
    "Press until": (
        Press(20.0, until=[Condition("control", above=3.0, name="joint7")]),
        Moment(1.0, 20.0, 0.0, 0.0, 20.0, control={"": 9.0, "joint7": 2.9}),
        Moment(1.0, 20.0, 0.0, 0.0, 20.0, control={"": 9.0, "joint7": 3.1}),
    ),
    "Release until": (
        Release(until=[Condition("distance", above=0.01)]),
        Moment(1.0, 0.0, 0.009, 0.0, 0.0),
        Moment(1.0, 0.0, 0.011, 0.0, 0.0),
    ),
    "Rise": (Rise(0.5), Moment(0.4, 0.0, 0.1, 0.0, 0.1), Moment(0.6, 0.0, 0.1, 0.0, 0.1)),
    "Release": (Release(), Moment(0.3, 3.0, 0.0, 0.0, 3.0), Moment(0.5, 0.4, 0.0, 0.0, 0.3)),
    "Retreat": (Retreat(0.1), Moment(0.6, 0.0, 0.09, 0.1, 0.1), Moment(0.6, 0.0, 0.1, 0.0, 0.1)),
}


@pytest.mark.parametrize("name", MEMBERS)
def test_phase_keeps_the_rules(name):
    phase, going_on, over = MEMBERS[name]
    assert phase.name == name.split()[0]
    assert phase.success(going_on, CONTACT_FORCE) > 0.0  # Rule 4.
    assert phase.success(over, CONTACT_FORCE) <= 0.0
    assert phase.remaining(going_on) > 0.0
    assert {phase.successor(outcome)[0] for outcome in ("late", "guard", "lost")} == {"hold"}
    assert phase.successor("success")[0] == "next"  # Rule 6.
    assert phase.awaits(CONTACT_FORCE)
    # Rule 1: what leads from one law to the other says so of both ends.
    assert (phase.begins_in_contact is None) == (phase.ends_in_contact is None)
    # Rule 5: others end before, or without a contact.
    assert phase.holds_contact == isinstance(phase, Press | Move | Dwell)
    # Rule 2: what approaches has no goal for the distance.
    goals = phase.goals("contact")
    assert set(goals) <= {"contact"}
    assert not phase.rates("contact") or not goals


@pytest.mark.parametrize("name", MEMBERS)
def test_phase_takes_a_name_guards_and_successors(name):
    guards = [Condition("force", above=50.0)]
    chosen = {"on_success": "done", "on_failure": "leave", "retries": 2, "if_spent": "hold"}
    phase = replace(MEMBERS[name][0], name="mine", guards=guards, **chosen)
    assert (phase.name, phase.guards) == ("mine", tuple(guards))
    assert phase.successor("success")[0] == "done"
    assert {phase.successor(outcome)[0] for outcome in ("guard", "late", "lost")} == {"leave"}


def test_a_release_that_has_left_does_not_wait_for_the_force():
    near, far = (Moment(0.3, 1.0, 0.0, 0.0, 0.0, away) for away in (0.019, 0.021))
    assert Release().remaining(near) > 0.0 > Release().remaining(far)


@pytest.mark.parametrize("name", MEMBERS)
def test_phase_takes_time(name):
    phase = MEMBERS[name][0]
    with pytest.raises(ModelError, match=rf"{phase.name}: over.*0\.0"):
        replace(phase, over=0.0)


@pytest.mark.parametrize("phase", [Move({}, 1.0), Approach(), Press(5.0), Dwell(1.0), Retreat(0.1)])
def test_a_phase_that_ends_by_a_force_ends_in_contact(phase):
    felt = replace(phase, until=[Condition("force", above=2.0)])
    assert felt.in_contact_after(False)
    assert felt.felt(CONTACT_FORCE) == (5.0 if isinstance(phase, Press) else 2.0)
    either = replace(phase, until=[*felt.until, Condition("time", above=1.0)])
    assert either.in_contact_after(False) == phase.in_contact_after(False)
    assert replace(felt, until=[Condition("force", below=2.0)]).felt(0.5) == phase.felt(0.5)


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: Condition("heat", above=1.0), "heat"),
        (lambda: Condition("force"), "force"),
        (lambda: Condition("force", above=1.0, below=2.0), "force"),
        (lambda: Condition("time", above=np.inf), "inf"),
        (lambda: Condition("signal", above=0.5), "signal"),
        (lambda: Condition("force", above=0.5, name="ready"), "ready"),
        (lambda: Dwell(), "Dwell"),
        (lambda: Move({}, -1.0), "-1"),
    ],
)
def test_wrong_conditions_are_refused(make, named):
    with pytest.raises(ModelError, match=named):
        make()
