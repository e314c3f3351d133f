"""What follows what in a task: names, successors, counts, and plans that are refused."""

import pytest
from polishing import laws

from drake_dae import (
    Approach,
    Condition,
    Dwell,
    Move,
    Press,
    Release,
    Retreat,
    Task,
    TaskController,
)
from drake_dae.errors import ModelError
from drake_dae.systems.task.phases.plan import Successor

TOUCH, AWAY = Approach(name="touch", retries=2, if_spent="away"), Retreat(0.1, name="away")


def after(task, place, outcome, *before):
    """What follows a phase after phases that began before it, each by its name or by "next"."""
    return task.plan.successor(place, outcome, [0, *before, place], ["", *["touch"] * len(before)])


def test_phases_have_the_names_of_their_classes_with_numbers():
    task = Task(
        [Approach(), Move({}, 1.0), Move({}, 1.0, name="Move 2"), Dwell(1.0), Move({}, 1.0)]
    )
    names = [phase.name for phase in task.phases]
    assert names == ["Approach", "Move", "Move 2", "Dwell", "Move 3"]
    assert [phase.name for phase in Task(task.phases).phases] == names
    assert "3. Move 2, until the end of 1 s" in str(task)
    chosen = Task([Approach(name="Press"), PRESS])
    assert [phase.name for phase in chosen.phases] == ["Press", "Press 2"]


def test_successors_are_those_that_were_chosen():
    task = Task([TOUCH, Press(20.0, on_failure="away", if_lost="touch"), Release(), AWAY])
    assert after(task, 0, "success") == Successor("next", 1)
    assert after(task, 0, "late") == Successor("fail", None)
    assert after(task, 1, "guard") == after(task, 1, "late") == Successor("away", 3)
    assert after(task, 2, "success") == Successor("next", 3)
    assert after(task, 3, "success") == Successor("next", 4)  # Done.
    assert task.contacts == (False, True, True, False, False)


def test_a_phase_is_entered_again_so_often_and_no_more():
    task = Task([TOUCH, Press(20.0, on_failure="away", if_lost="touch"), Release(), AWAY])
    assert after(task, 1, "lost") == Successor("touch", 0, "retry 1 of 2")
    assert after(task, 1, "lost", 1, 0) == Successor("touch", 0, "retry 2 of 2")
    spent = "touch is not entered after 2 retries"
    assert after(task, 1, "lost", 1, 0, 1, 0) == Successor("away", 3, spent)


def test_who_leaves_releases_first_where_it_touches():
    task = Task([Approach(if_late="leave"), Press(20.0, on_failure="leave")])
    assert after(task, 0, "late") == Successor("leave", None)
    assert after(task, 1, "guard") == Successor("leave", 2)
    assert after(task, 1, "success") == Successor("next", 3)
    assert after(task, 2, "success") == after(task, 2, "late") == Successor("stop", None)
    assert [phase.name for phase in task.plan.phases] == ["Approach", "Press", "leave"]


PRESS = Press(20.0)


@pytest.mark.parametrize(
    ("phases", "message"),
    [
        ([Approach(on_failure="park")], "'park'"),
        (
            [Approach(retries=1, if_spent="park")],
            "if_spent: no phase 'park'",
        ),
        ([Approach(name="done")], "'done'"),
        ([Approach(name="a"), Press(2.0, name="a")], "'a'"),
        (
            [Approach(on_failure="Press"), PRESS],
            "phase 2 of the task, Press, after Approach",
        ),
        (
            [Approach(), Press(20.0, on_success="away"), Release(), AWAY],
            "phase 4 of the task, away, after Press",
        ),
        (
            [Approach(), PRESS, Dwell(1.0, on_failure="Press")],
            "Press, after Dwell",
        ),
        (
            [Approach(), Press(20.0, on_failure="Press", if_lost="hold")],
            "Press",
        ),
        (
            [Approach(), PRESS, Release(on_success="Approach")],
            "Approach, Press and Release",
        ),
        (
            [TOUCH, PRESS, Release(), Retreat(0.1, name="away", on_success="touch")],
            "touch and away",
        ),
        ([Approach(on_success="done"), PRESS], "2 of the task, Press"),
        ([Move({}, until=[Condition("force", above=0.2)])], "force: 0.2"),
        ([Approach(), Press(0.3)], "Press: force: 0.3"),
    ],
)
def test_plans_that_make_no_sense_are_refused(phases, message):
    with pytest.raises(ModelError) as caught:
        Task(phases)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Approach(retries=-1), "Approach: retries"),
        (lambda: Approach(on_failure="approach"), "'approach'"),
        (
            lambda: TaskController(
                Task([Approach(guards=[Condition("control", above=1.0, name="elbow")])]),
                *laws(),
                sample_period=1e-3,
            ),
            "'elbow'",
        ),
    ],
)
def test_wrong_phases_are_refused(make, message):
    with pytest.raises(ModelError) as caught:
        make()
    assert message in str(caught.value)
