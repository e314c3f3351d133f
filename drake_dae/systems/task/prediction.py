"""The error that theory predicts for a task, phase by phase."""

from collections.abc import Mapping

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.systems.task.open_contact import OpeningContact
from drake_dae.systems.task.planner import CONTACT, FREE
from drake_dae.systems.task.progress import ReferenceSegment, places_at


def predicted_errors(
    laws: tuple[TrackingLaw, TrackingLaw],
    contact: OpeningContact,
    segments: tuple[ReferenceSegment, ...],
    times: FloatArray,
    values: Mapping[str, FloatArray],
) -> FloatArray:
    """The error that theory predicts for a run, shape (k, p + c) with a contact of c points.

    After each change of phases the error decays from its current value by the gains of the active
    law (30). An impact causes a new error; the change that follows a touch is after the impact.
    While the free law is active, no law controls the forces, and their predicted errors are the
    forces themselves. There is no prediction for a contact that is open although it should hold.

    Args:
        laws: The law of the free robot and the law in contact.
        contact: The contact that opens and closes.
        segments: The references of the run.
        times: The times of the run, in s, shape (k,).
        values: "state", "outputs", those of the law in contact, "parameters" of the laws' system,
            and "integral" and "free_integral" if the laws have any, one row for each time.
    """
    places, own = places_at(segments, times), np.array(contact.places)
    predicted = np.zeros((times.size, len(laws[CONTACT].degrees) + contact.size))
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
            values["parameters"][start] if "parameters" in values else None,
            integral=values[name][start] if law.integral.outputs else None,
        )
        columns = np.arange(errors.shape[1])
        if is_free:
            columns[own] = np.arange(errors.shape[1], predicted.shape[1])
            predicted[np.ix_(rows, own)] = values["outputs"][np.ix_(rows, own)]
        predicted[rows[:, None], columns] = errors
    return predicted
