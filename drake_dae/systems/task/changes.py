"""The changes of phase in the record of a run, and why they came."""

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.systems.control.contract import PhaseChange
from drake_dae.systems.task.automaton import ALL_DONE, BEGUN, GIVEN_UP, GUARD, LATE, LOST, SUCCESS
from drake_dae.systems.task.task import Task


def changes_of(task: Task, rows: FloatArray) -> tuple[PhaseChange, ...]:
    """The changes of a run; those between two samples of its record are left out.

    Args:
        task: The task.
        rows: The output `change` of its controller at the times of a record, one row each.
    """
    first = np.unique(rows[:, 0], return_index=True)[1]
    changes, end = list[PhaseChange](), len(task.all_phases)
    for row in rows[first].tolist():
        number, place, is_closed, start, cause, force, distance, rate, ending, before = row
        if not number:
            continue  # The task has not begun.
        at = int(place)
        name = task.all_phases[at].name if at < end else "done" if ending == ALL_DONE else "held"
        failed = ending == GIVEN_UP if at == end else cause > SUCCESS
        lasted = f" {start - changes[-1].time:.4g} s" if changes else ""
        reason = _reason(task, int(before), int(cause), lasted)
        again = sum(change.place == at for change in changes)
        if again and at < end:
            reason += f", retry {again} of {task.retries_of(at)}"
        motion = force, distance, rate
        changes.append(PhaseChange(start, name, at, bool(is_closed), reason, *motion, failed))
    return tuple(changes)


def _reason(task: Task, place: int, cause: int, lasted: str) -> str:
    """Why a phase ended, after it lasted so long."""
    if cause == BEGUN:
        return "the task begins"
    if place == len(task.all_phases):
        return "the contact is lost at rest"
    phase = task.all_phases[place]
    awaits = phase.awaits(task.contact_force)
    if cause == SUCCESS:
        return f"after {awaits}"
    if cause == LATE:
        return f"{phase.name} has waited{lasted} for {awaits}"
    if cause == LOST:
        return f"the contact of {phase.name} is lost"
    return f"{phase.name} is ended by {phase.guards[cause - GUARD]}"
