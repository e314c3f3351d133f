"""The error that theory predicts for a task, phase by phase."""

from collections.abc import Mapping, Sequence

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.systems.task.contacts.laws import CONTACT, ContactLaws
from drake_dae.systems.task.contacts.outputs import TaskOutputs
from drake_dae.systems.task.progress import ReferenceSegment, places_at


def predicted_errors(
    pairs: Sequence[ContactLaws],
    columns: TaskOutputs,
    segments: tuple[ReferenceSegment, ...],
    times: FloatArray,
    values: Mapping[str, FloatArray],
) -> FloatArray:
    """The error that theory predicts for a run, shape (k, columns.size).

    After each change of phases the error decays from its current value by the gains of the active
    law (30). An impact causes a new error; the change that follows a touch is after the impact.
    While the free law is active, no law controls the forces, and their predicted errors are the
    forces themselves. There is no prediction for a contact that is open although it should hold.

    Args:
        pairs: The laws of the task.
        columns: The places of their outputs.
        segments: The references of the run.
        times: The times of the run, in s, shape (k,).
        values: "state", "outputs", in the order of the columns, "parameters" of the laws' system,
            and "integral" and "free_integral" if the laws have any, one row for each time.
    """
    places, outputs = places_at(segments, times), values["outputs"]
    predicted = np.zeros((times.size, columns.size))
    for which, segment in enumerate(segments):
        rows = np.flatnonzero(places == which)
        if not rows.size:
            continue
        # The record of a simulation has the state at the change in the row before; a rollout not.
        start = max(rows[0] - 1, 0)
        if times[start] < segment.change.time:
            start = rows[0]
        is_closed, pair = segment.law % 2 == CONTACT, segment.law // 2
        law = pairs[pair].laws[segment.law % 2]
        name = "integral" if is_closed else "free_integral"
        errors = law.predicted_error(
            times[rows] - times[start],
            values["state"][start],
            segment.reference(times[start]),
            values["parameters"][start] if "parameters" in values else None,
            integral=values[name][start] if law.integral.outputs else None,
        )
        if not is_closed:
            forces = rows[:, None], columns.forces[pair]
            predicted[forces] = outputs[forces]
        predicted[rows[:, None], columns.of_law(segment.law)] = errors
    return predicted
