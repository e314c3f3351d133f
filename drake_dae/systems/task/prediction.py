"""The error that theory predicts for a task, phase by phase."""

from collections.abc import Mapping

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.systems.task.planner import CONTACT, FREE
from drake_dae.systems.task.progress import ReferenceSegment, places_at


def predicted_errors(
    laws: tuple[TrackingLaw, TrackingLaw],
    place: int,
    force: int,
    segments: tuple[ReferenceSegment, ...],
    times: FloatArray,
    values: Mapping[str, FloatArray],
) -> FloatArray:
    """The error that theory predicts for a run, shape (k, p + 1).

    After each change of phases the error decays from its current value by the gains of the active
    law (30). An impact causes a new error; the change that follows a touch is after the impact.
    While the free law is active, no law controls the force, and its predicted error is the force
    itself. There is no prediction for a contact that is open although it should hold.

    Args:
        laws: The law of the free robot and the law in contact.
        place: The index of the output that is the distance of the first and the force of the
            second.
        force: The index of that force among the constraint forces.
        segments: The references of the run.
        times: The times of the run, in s, shape (k,).
        values: "state", "constraint_force", and "integral" and "free_integral" if the laws have
            any, one row for each time.
    """
    places = places_at(segments, times)
    predicted = np.zeros((times.size, len(laws[CONTACT].degrees) + 1))
    for which, segment in enumerate(segments):
        rows = np.flatnonzero(places == which)
        if not rows.size:
            continue
        start = max(rows[0] - 1, 0)  # The record has the state at the change in the row before.
        is_free = not segment.change.in_contact
        law = laws[FREE if is_free else CONTACT]
        name = "free_integral" if is_free else "integral"
        errors = law.predicted_error(
            times[rows] - times[start],
            values["state"][start],
            segment.reference(max(segment.change.time, times[start])),
            integral=values[name][start] if law.integral.outputs else None,
        )
        columns = np.arange(errors.shape[1])
        if is_free:
            columns[place] = predicted.shape[1] - 1
            predicted[rows, place] = values["constraint_force"][rows, force]
        predicted[rows[:, None], columns] = errors
    return predicted
