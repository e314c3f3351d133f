"""The outputs of both laws of a task."""

import casadi as ca

from drake_dae.dae.system.signals import Signal
from drake_dae.systems.task.contacts.open_contact import CONTACT, FREE, ContactLaws
from drake_dae.trace.functions import TracedFunction


class TaskOutputs:
    """The outputs of both laws of a task, as columns of its record.

    First the outputs of the law in contact, then the distances of its contact.

    Args:
        pair: The laws of the task.

    Attributes:
        size: The number of columns.
        distances: The columns with the distances of its contact.
        signals: Names and units of the columns.
        function: (x, lambda, parameters) -> the columns, then the derivatives of all distances.
    """

    def __init__(self, pair: ContactLaws) -> None:
        system, contact = pair.laws[CONTACT].system, pair.contact
        self._contact = contact
        self.size = system.num_outputs + contact.size
        self.distances = list(range(system.num_outputs, self.size))
        force = ca.SX.sym("force", system.num_constraints)
        chains = [pair.laws[FREE].structure.output_chains[place] for place in contact.places]
        rows = [system.outputs(force), *(c[0] for c in chains), *(c[1] for c in chains)]
        value = ca.densify(ca.vertcat(*rows))
        self.function: TracedFunction = system.trace(
            "task outputs", {"value": value}, {"force": force}
        )
        distances = [system.constraint_output_signals[row] for row in contact.forces]
        self.signals: tuple[Signal, ...] = (*system.output_signals, *distances)

    def of_law(self, law: int) -> list[int]:
        """The columns of the outputs of a law."""
        columns = list(range(self.size - self._contact.size))
        if law == FREE:
            for place, column in zip(self._contact.places, self.distances, strict=True):
                columns[place] = column
        return columns
