"""The outputs of all laws of a task."""

from collections.abc import Sequence

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.layout import Indices
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.system.system import DaeSystem
from drake_dae.systems.task.contacts.laws import FREE, ContactLaws
from drake_dae.trace.functions import TracedFunction


class TaskOutputs:
    """The outputs of all laws of a task, as columns of its record.

    First the outputs of the first law in contact, then the distances of its contact; then forces
    and distances of each further latch.

    Args:
        pairs: The laws of the task.
        whole: The system with all constraints.

    Attributes:
        size: The number of columns.
        forces, distances: For each pair, the columns with the forces and distances of its contact.
        signals: Names and units of the columns.
        function: (x, lambda, parameters) -> the columns, then the derivatives of all distances in
            the order of their columns.
    """

    def __init__(self, pairs: Sequence[ContactLaws], whole: DaeSystem) -> None:
        self._pairs, self.size = pairs, pairs[0].laws[0].system.num_outputs
        known = dict[tuple[int, ...], tuple[list[int], list[int]]]()
        for pair in pairs:
            contact = pair.contact
            if contact.forces in known:
                continue
            forces = list(contact.places)
            if known:
                forces = [self.size + i for i in range(contact.size)]
                self.size += contact.size
            known[contact.forces] = forces, [self.size + i for i in range(contact.size)]
            self.size += contact.size
        self.forces, self.distances = zip(*(known[p.contact.forces] for p in pairs), strict=True)
        self.function, self.signals = self._traced(whole)

    def _traced(self, whole: DaeSystem) -> tuple[TracedFunction, tuple[Signal, ...]]:
        force = ca.SX.sym("force", whole.num_constraints)
        values, rates = ca.SX.zeros(self.size), dict[int, ca.SX]()
        signals = [Signal("")] * self.size
        values[: whole.num_outputs] = whole.outputs(force)
        signals[: whole.num_outputs] = whole.output_signals
        for pair, of_forces, of_distances in zip(
            self._pairs, self.forces, self.distances, strict=True
        ):
            contact, chains = pair.contact, pair.laws[FREE].structure.output_chains
            for i, (place, row) in enumerate(zip(contact.places, contact.forces, strict=True)):
                column = of_distances[i]
                values[column], rates[column] = chains[place][0], chains[place][1]
                signals[column] = whole.constraint_output_signals[row]
                if contact.is_latch:
                    values[of_forces[i]] = force[row]
                    signals[of_forces[i]] = whole.force_signals[row]
        every = ca.vertcat(values, *(rates[column] for column in self.of_distances))
        traced = whole.trace("task outputs", {"value": ca.densify(every)}, {"force": force})
        return traced, tuple(signals)

    @property
    def of_distances(self) -> list[int]:
        """The columns of all distances."""
        return sorted({column for own in self.distances for column in own})

    def of_law(self, law: int) -> list[int]:
        """The columns of the outputs of a law, by its number."""
        pair = law // 2
        columns = list(range(self._pairs[0].laws[0].system.num_outputs))
        own = self.forces[pair] if law % 2 else self.distances[pair]
        for place, column in zip(self._pairs[pair].contact.places, own, strict=True):
            columns[place] = column
        return columns

    def led(self, desired: FloatArray, outputs: FloatArray, laws: Indices) -> FloatArray:
        """Desired outputs in which those of latches that a law does not lead are the actual ones.

        Args:
            desired, outputs: Desired and actual outputs, one row for each time.
            laws: The number of the law that is active at each time.
        """
        if not self._pairs[0].contact.is_latch:
            return desired
        led = outputs.copy()
        for law in np.unique(laws):
            rows = np.ix_(laws == law, self.of_law(int(law)))
            led[rows] = desired[rows]
        return led
