"""All constraints of a robot at once, as the model and the pictures need them.      (37), (38)"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import casadi as ca

from drake_dae.dae.signals import Parameter, Signal
from drake_dae.robots.contact.constraint import Constraint
from drake_dae.robots.links.kinematics import Frames, Kinematics, Reaction
from drake_dae.robots.links.links import Links


@dataclass(frozen=True)
class ConstraintSet:
    """The constraints of a robot, one below the other.

    Attributes:
        constraints: The constraints, in the order of their constraint forces.
    """

    constraints: Sequence[Constraint]

    @property
    def size(self) -> int:
        """m, the number of constraint forces."""
        return len(self.force_signals)

    @property
    def force_signals(self) -> tuple[Signal, ...]:
        """Names and units of lambda."""
        return tuple(s for c in self.constraints for s in c.force_signals)

    @property
    def residual_signals(self) -> tuple[Signal, ...]:
        """Names and units of what stays zero."""
        return tuple(s for c in self.constraints for s in c.residual_signals)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The parameters of all constraints."""
        return tuple(p for c in self.constraints for p in c.parameters)

    def parts(self) -> Iterator[tuple[Constraint, slice]]:
        """Each constraint, and where its constraint forces stand."""
        start = 0
        for constraint in self.constraints:
            stop = start + len(constraint.force_signals)
            yield constraint, slice(start, stop)
            start = stop

    def residual(self, frames: Frames) -> ca.SX:
        """phi(q) of those that restrict positions, shape (k, 1)."""
        return ca.vertcat(ca.SX(0, 1), *[c.residual(frames) for c in self.constraints])

    def rate(self, kinematics: Kinematics) -> ca.SX:
        """phi'(q, v), and the rates of those that restrict velocities alone, shape (m, 1)."""
        return ca.vertcat(ca.SX(0, 1), *[c.rate(kinematics) for c in self.constraints])

    def constraint_output(self, kinematics: Kinematics) -> ca.SX:
        """k of (2), shape (m, 1): phi, or the rate where there is no phi."""
        rows = [ca.SX(0, 1)]
        for constraint in self.constraints:
            residual = constraint.residual(kinematics)
            rows.append(residual if residual.numel() else constraint.rate(kinematics))
        return kinematics.value(ca.vertcat(*rows))

    def reaction(self, kinematics: Kinematics, constraint_force: ca.SX) -> Reaction:
        """The forces that the constraint forces, shape (m, 1), make on the robot."""
        total = Reaction(ca.SX(kinematics.v.numel(), 1))
        for constraint, part in self.parts():
            total += constraint.reaction(kinematics, constraint_force[part])
        return total

    def force_matrix(self, links: Links) -> ca.SX:
        """G of M v' + H = G lambda + B tau, shape (nv, m): J^T without friction."""
        kinematics, force = links.kinematics(), ca.SX.sym("force", self.size)
        columns = self.reaction(kinematics, force).map(lambda part: ca.jacobian(part, force))
        return links.generalized_force(kinematics, columns)

    def implicit(self, links: Links, acceleration: ca.SX, force: ca.SX) -> tuple[ca.SX, ca.SX]:
        """M v' + H - G lambda, shape (nv, 1), and phi'' (38), shape (m, 1), by inverse dynamics.

        Neither M nor J is formed: see `Links.inverse_dynamics`.
        """
        kinematics = links.kinematics(acceleration)
        balance = links.inverse_dynamics(kinematics, self.reaction(kinematics, force))
        return balance, kinematics.value(kinematics.derivative(self.rate(kinematics)))
