"""The deflection of compliant contacts under a force that changes fast."""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from drake_dae.arrays import positive
from drake_dae.dae.signals import DerivativeLayout
from drake_dae.dae.structure.structure import Structure
from drake_dae.dae.tracking.gains import FeedbackGains, GainDesign
from drake_dae.dae.tracking.measured_force import force_outputs_of
from drake_dae.dae.tracking.model_of_law import damping_gains
from drake_dae.errors import ModelError
from drake_dae.trace.factorization import Factorization


@dataclass(frozen=True, eq=False)
class Deflection:
    """The motion of compliant contacts, lambda = -k phi, that a wanted force lambda_d needs.

    A law that keeps phi'' + c phi' = 0 leaves phi'' + c phi' = A (lambda - lambda_d) there: a step
    of lambda_d makes the contact oscillate with sqrt(A k). With phi_d = -lambda_d / k and

        phi'' - phi_d'' + c (phi' - phi_d') = 0,    so    u for lambda_d + A^-1 (c lambda_d' +
                                                          lambda_d'') / k,

    the error e = phi - phi_d obeys e'' + c e' + A k e = 0 for any reference that is twice
    differentiable. A stiffness that is wrong by a factor s leaves |1 - s| of the oscillation.
    """

    stiffness: float
    damping: ca.DM
    inputs: dict[int, int]
    matrix: ca.SX
    more: tuple[int, ...]

    @classmethod
    def of(
        cls, structure: Structure, stiffness: float, damping: GainDesign | FeedbackGains | None
    ) -> "Deflection":
        """Checks that the forces of a system can be commanded so."""
        system, size = structure.system, structure.system.num_constraints
        inputs = force_outputs_of(system)
        degrees = [structure.output_degrees[i] for i in inputs]
        if sorted(inputs.values()) != list(range(size)) or any(degrees) or not size:
            raise ModelError(
                f"{system.name}: a contact_stiffness is for robots with rigid joints whose "
                "constraint forces are all outputs; leave it out"
            )
        if any(degree != 2 for degree in structure.constraint_degrees):
            raise ModelError(
                f"{system.name}: a contact_stiffness is for contacts, and a constraint is on "
                "velocities; leave it out"
            )
        c = np.zeros((size, size))
        if damping is not None:
            c = damping_gains(structure, damping).matrix
        matrix = structure.elimination.constraint_matrix
        more = tuple(2 if i in inputs else 0 for i in range(system.num_outputs))
        return cls(positive("contact_stiffness", stiffness), ca.DM(c), inputs, matrix, more)

    def force(self, reference: ca.SX, layout: DerivativeLayout) -> ca.SX:
        """A^-1 (c lambda_d' + lambda_d'') / k of each output, shape (p, 1)."""
        rates = [ca.SX.zeros(len(self.inputs)) for _ in range(2)]
        for i, j in self.inputs.items():
            for order, rate in enumerate(rates, 1):
                rate[j] = reference[int(layout.lowest[i]) + order]
        push = ca.mtimes(self.damping, rates[0]) + rates[1]
        forces = Factorization(self.matrix).solve(push) / self.stiffness
        result = ca.SX.zeros(len(layout.degrees))
        for i, j in self.inputs.items():
            result[i] = forces[j]
        return result
