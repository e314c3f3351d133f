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

    From each change of phases on it decays by the gains of the law that acts (30), from what it is
    then. An impact makes errors anew; the change that follows a touch is after it. Of what no law
    steers, the force while the free law acts, it is what it is. Of a contact that is open where it
    should hold there is no theory.

    Args:
        laws: The law of the free robot and that in contact.
        place: Which output is the distance of the first, and the force of the second.
        force: Which of the constraint forces is that force.
        segments: The references of the run.
        times: Of the run, in s, shape (k,).
        values: At these times: "state", "constraint_force", and "integral" and "free_integral"
            where the laws have any; one row for each.
    """
    places = places_at(segments, times)
    found = np.zeros((times.size, len(laws[CONTACT].degrees) + 1))
    for which, segment in enumerate(segments):
        rows = np.flatnonzero(places == which)
        if not rows.size:
            continue
        start = max(rows[0] - 1, 0)  # At a change the state is known, and what was before.
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
            columns[place] = found.shape[1] - 1
            found[rows, place] = values["constraint_force"][rows, force]
        found[rows[:, None], columns] = errors
    return found
