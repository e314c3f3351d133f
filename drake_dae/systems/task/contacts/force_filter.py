"""The measured forces of contacts, without bias and noise."""

from collections.abc import Sequence

import casadi as ca

from drake_dae.arrays import FloatArray
from drake_dae.systems.task.contacts.open_contact import OpeningContact


class ForceFilter:
    """A low-pass of the measured forces of all contacts of a task, after their bias.

    Its state has for each force the value after the low-pass, then the mean of the samples before
    the first touch, then the number of these samples.

    Args:
        contacts: The contact of each pair of laws.
        gain: The gain of the low-pass; see `Task.force_gain`.
        tares: The number of samples in the mean; 0 if no bias is found.

    Attributes:
        rows: The indices of the filtered forces among all measured ones.
        size: The number of entries of the state.
        tares: The argument.
    """

    def __init__(self, contacts: Sequence[OpeningContact], gain: float, tares: int) -> None:
        self.rows = sorted({row for contact in contacts for row in contact.forces})
        self._places = [[self.rows.index(row) for row in each.forces] for each in contacts]
        self.size, self.tares, self._gain = 2 * len(self.rows) + 1, tares, gain

    def after(self, before: ca.SX, measured: ca.SX) -> ca.SX:
        """The state after a sample.

        Args:
            before: The state before it.
            measured: All measured forces.
        """
        size, own = len(self.rows), measured[self.rows]
        force, bias, count = before[:size], before[size : 2 * size], before[-1]
        unbiased = own
        if self.tares:
            waits = count < self.tares - 0.5
            count = ca.if_else(waits, count + 1, count)
            bias = ca.if_else(waits, bias + (own - bias) / count, bias)
            unbiased = ca.if_else(waits, ca.SX.zeros(size), own - bias)
        return ca.vertcat(force + self._gain * (unbiased - force), bias, count)

    def of_law(self, law: int) -> list[int]:
        """The places of the forces of the contact of a law in the state."""
        return self._places[law // 2]

    def forces(self, state: FloatArray, law: int) -> list[float]:
        """The filtered forces of the contact of a law, in N, one for each of its points."""
        forces: list[float] = state[self.of_law(law)].tolist()
        return forces

    def bias(self, state: FloatArray) -> FloatArray:
        """The bias of the forces of the contacts, in N."""
        return state[len(self.rows) : -1]
