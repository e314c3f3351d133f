"""What follows what in a task: names, successors, counts, and plans that are refused."""

import pytest
from polishing import laws

from drake_dae import Approach, Dwell, Move, Press, Release, Retreat, Task, TaskController
from drake_dae.errors import ModelError
from drake_dae.systems import Condition

TOUCH, AWAY = Approach(name="touch", retries=2, if_spent="away"), Retreat(0.1, name="away")


def test_phases_have_the_names_of_their_classes_with_numbers():
    task = Task(
        [Approach(), Move({}, 1.0), Move({}, 1.0, name="Move 2"), Dwell(1.0), Move({}, 1.0)]
    )
    names = [phase.name for phase in task.phases]
    assert names == ["Approach", "Move", "Move 2", "Dwell", "Move 3"]
    assert [phase.name for phase in Task(task.phases).phases] == names
    chosen = Task([Approach(name="Press"), PRESS])
    assert [phase.name for phase in chosen.phases] == ["Press", "Press 2"]


def test_successors_are_those_that_were_chosen():
    """The phases of which the first follows that may be entered, and whether the task is done."""
    task = Task([TOUCH, Press(20.0, on_failure="away", if_lost="touch"), Release(), AWAY])
    assert task.successors(0, "success") == ([1], False)
    assert task.successors(0, "late") == ([], False)
    assert task.successors(1, "guard") == task.successors(1, "late") == ([3], False)
    assert task.successors(1, "lost") == ([0, 3], False)  # touch may be spent.
    assert task.successors(3, "success") == ([], True)
    assert task.contacts == (False, True, True, False)
    assert [task.retries_of(place) for place in range(4)] == [2, 10, 10, 10]


def test_who_leaves_releases_first_where_it_touches():
    task = Task([Approach(if_late="leave"), Press(20.0, on_failure="leave")])
    assert task.successors(0, "late") == ([], False)
    assert task.successors(1, "guard") == ([2], False)
    assert task.successors(1, "success") == ([], True)
    assert task.successors(2, "success") == task.successors(2, "late") == ([], False)
    assert [phase.name for phase in task.all_phases] == ["Approach", "Press", "leave"]


PRESS = Press(20.0)


@pytest.mark.parametrize(
    ("phases", "message"),
    [
        ([], "phases"),
        ([Press(20.0, if_lost="approach")], "if_lost: "),
        ([Approach(on_failure="park")], "'park'"),
        ([Approach(retries=1, if_spent="park")], "'park'"),
        ([Approach(name="done")], "'done'"),
        ([Approach(name="a"), Press(2.0, name="a")], "'a'"),
        ([Approach(), Retreat(0.1)], "Retreat, after Approach"),
        ([Approach(on_failure="Press"), PRESS], "Press, after Approach"),
        ([Approach(), Press(20.0, on_success="away"), Release(), AWAY], "away, after Press"),
        ([Approach(), PRESS, Dwell(1.0, on_failure="Press")], "Press, after Dwell"),
        ([Move({}, until=[Condition("force", above=0.2)])], "force: 0.2"),
        ([Approach(), Press(0.3)], "Press: force: 0.3"),
    ],
)
def test_plans_that_make_no_sense_are_refused(phases, message):
    with pytest.raises(ModelError) as caught:
        Task(phases)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_wrong_phases_are_refused():
    with pytest.raises(ModelError, match="Approach: retries"):
        Approach(retries=-1)
    guarded = Task([Approach(guards=[Condition("control", above=1.0, name="elbow")])])
    with pytest.raises(ModelError, match="'elbow'"):
        TaskController(guarded, *laws(), sample_period=1e-3)
