"""The measured forces of a contact, without bias and noise."""

import casadi as ca

from drake_dae.arrays import FloatArray
from drake_dae.systems.task.contacts.open_contact import OpeningContact


class ForceFilter:
    """A low-pass of the measured forces of the contact of a task, after their bias.

    Its state has for each force the value after the low-pass, then the mean of the samples before
    the first touch, then the number of these samples.

    Args:
        contact: The contact.
        gain: The gain of the low-pass; see `Task.force_gain`.
        tares: The number of samples in the mean; 0 if no bias is found.

    Attributes:
        rows: The indices of the filtered forces among all measured ones.
        size: The number of entries of the state.
        tares: The argument.
    """

    def __init__(self, contact: OpeningContact, gain: float, tares: int) -> None:
        self.rows = list(contact.forces)
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

    def forces(self, state: FloatArray) -> list[float]:
        """The filtered forces of the contact, in N, one for each of its points."""
        forces: list[float] = state[: len(self.rows)].tolist()
        return forces

    def bias(self, state: FloatArray) -> FloatArray:
        """The bias of these forces, in N."""
        return state[len(self.rows) : -1]
