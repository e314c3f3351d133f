"""The modes of a robot with opening contacts: one system for each set of closed contacts."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray, show
from drake_dae.dae.structure.constrained import ConstraintStructure, find_constraint_structure
from drake_dae.dae.system.system import DaeSystem
from drake_dae.errors import DrakeDaeError, InconsistentStateError, ModelError
from drake_dae.systems.plants.unilateral.contacts import UnilateralContacts
from drake_dae.systems.plants.unilateral.edges import Feet
from drake_dae.systems.plants.unilateral.impacts import rows_of
from drake_dae.trace.functions import TracedFunction

Closed = tuple[bool, ...]

ROUND_OFF = 1e-12
"""A force between zero and minus this, relative to the terms that it is made of, is round-off."""

NEAR = 1e-6
"""The part of their usual spread of states at which the contacts of a peg are examined, since they
depend on each other where its end is at the rim."""


@dataclass(frozen=True, eq=False)
class Mode:
    """The motion of the robot while some contacts are closed.

    Attributes:
        closed: The closed contacts and latches, one flag for each.
        structure: The structure of the system with their constraints alone.
        rows: The indices of its constraints among all; of sticking contacts, the independent ones.
        dynamics: x', a function of state, control if there is one, and parameters.
        force: All constraint forces, zero where open; it takes the control if that enters them.
        grip: The same forces plus their round-off: positive where a closed contact does not pull.
        output: The controlled outputs, likewise.
        holds: For each entry of the constraint residual 1, or 0 if its contact is open.
    """

    closed: Closed
    structure: ConstraintStructure
    rows: tuple[int, ...]
    dynamics: TracedFunction
    force: TracedFunction
    grip: TracedFunction
    output: TracedFunction
    holds: FloatArray


class Modes:
    """The modes, each traced when it is first needed.

    Args:
        contacts: The contacts.
        structure: The structure of the model's system, all contacts closed, if it is known.
    """

    def __init__(
        self, contacts: UnilateralContacts, structure: ConstraintStructure | None = None
    ) -> None:
        self._contacts, self._whole = contacts, structure
        self._traced_modes: dict[Closed, Mode] = {}

    def __call__(self, closed: Closed, state: FloatArray) -> Mode:
        """A mode.

        Args:
            closed: The closed contacts, one flag for each.
            state: A state near which it is examined, if it is new, shape (n,).

        Raises:
            AssumptionError: Its constraints are dependent near the state, or its A(x) is singular.
        """
        if closed not in self._traced_modes:
            self._traced_modes[closed] = self._traced(closed, state)
        return self._traced_modes[closed]

    def check_start(self, state: FloatArray, parameters: FloatArray) -> None:
        """Refuses a state where no run may start, by the parameters that its system has.

        Args:
            state: x, shape (n,).
            parameters: The values of all parameters of the plant.

        Raises:
            InconsistentStateError: It is off the bilateral constraints, or inside a body.
        """
        contacts = self._contacts
        dae, values = contacts.dae, parameters[: contacts.dae.parameter_symbol.numel()]
        bilateral = self((False,) * len(contacts.every), state).structure.manifold
        if not bilateral.is_consistent(state, values):
            residual = bilateral.residual(state, values)
            worst = int(np.argmax(np.abs(residual)))
            signal = bilateral.residual_signals[worst]
            raise InconsistentStateError(
                f"{dae.name}: the start state is not on the constraints that stay: "
                f"{signal.name} = {residual[worst]:.3g} {signal.unit}",
                residual,
            )
        gaps = contacts.gaps.evaluate(state, values)[0]
        contacts.edges.check_outside(state, values, gaps)

    def _traced(self, closed: Closed, state: FloatArray) -> Mode:
        contacts = self._contacts
        names = [n for n, shut in zip(contacts.every, closed, strict=True) if shut]
        dae = contacts.dae
        terms = contacts.terms(state, np.zeros(dae.num_controls), dae.parameter_values)
        pushing = [t for t, shut in zip(contacts.touches, closed, strict=False) if shut]
        bilateral = contacts.bilateral_in(closed)
        independent = rows_of(terms.impulse_matrix, bilateral, pushing)
        if independent is None:
            raise ModelError(
                f"{dae.name}: {', '.join(names)} cannot be closed together at state {show(state)}: "
                "the constraints depend on each other there"
            )
        rows = sorted(independent.tolist())
        whole = self._whole if rows == list(range(contacts.of_model.num_constraints)) else None
        system = _subsystem(contacts, rows, state) if whole is None else whole.system
        try:
            in_hole = bool(rows) and rows[-1] >= contacts.of_model.num_constraints
            spread = NEAR * system.usual_spread(state) if in_hole else None
            structure = whole or find_constraint_structure(system, spread=spread)
        except DrakeDaeError as error:
            note = f"While {', '.join(names) or 'no contact'} is closed: {error}"
            error.args = (note, *error.args[1:])
            raise
        if any(degree > 2 for degree in structure.constraint_degrees):
            raise ModelError(f"{system.name}: a contact that opens and closes has degree 2 at most")
        derivatives = structure.derivatives
        constraint_input = derivatives.expand(derivatives.constraint_input)
        force, grip = ca.SX(dae.num_constraints, 1), ca.SX(dae.num_constraints, 1)
        force[rows] = constraint_input
        # A force that the law cancels is a difference of alpha and the terms of beta u (25).
        by_law = ca.mtimes(ca.fabs(structure.elimination.beta), ca.fabs(derivatives.control))
        terms = ca.fabs(structure.elimination.alpha) + by_law
        grip[rows] = constraint_input + ROUND_OFF * terms
        output = system.outputs(constraint_input)
        by_control = [ca.depends_on(value, derivatives.control) for value in (force, output)]
        rate = derivatives.expand(derivatives.rate)
        return Mode(
            closed=closed,
            structure=structure,
            rows=tuple(rows),
            dynamics=structure.trace("dynamics", rate, dae.num_controls > 0),
            force=structure.trace("constraint force", ca.densify(force), by_control[0]),
            grip=structure.trace("grip of contacts", ca.densify(grip), by_control[0]),
            output=structure.trace("controlled output", output, by_control[1]),
            holds=contacts.holds(closed),
        )


def _subsystem(contacts: UnilateralContacts, rows: Sequence[int], state: FloatArray) -> DaeSystem:
    """The system with some of the constraints only.

    Args:
        contacts: The contacts.
        rows: The constraints that hold.
        state: A state near which it is examined, shape (n,).
    """
    rows, own = list(rows), contacts.of_model
    dae = own if all(row < own.num_constraints for row in rows) else contacts.dae
    embed = ca.SX.eye(dae.num_constraints)[:, rows]
    whole = dae.implicit

    def implicit(rate: ca.SX, force: ca.SX) -> tuple[ca.SX, ca.SX]:
        assert whole is not None
        balance, constraint_rate = whole(rate, ca.mtimes(embed, force))
        return balance, constraint_rate[rows]

    return replace(
        dae,
        g=dae.g[:, rows],
        k=dae.k[rows],
        m=dae.m[:, rows],
        constraint_input_signals=tuple(dae.constraint_input_signals[i] for i in rows),
        constraint_output_signals=tuple(dae.constraint_output_signals[i] for i in rows),
        implicit=None if whole is None or not rows else implicit,
        nominal_state=state,
    )


def closed_of(values: FloatArray) -> Closed:
    """The closed contacts of a discrete state: 1 is closed."""
    return tuple(value > 0.5 for value in values.tolist())


def numbers_of(closed: Closed, feet: Feet) -> FloatArray:
    """The discrete state of a mode: for each contact 1 closed, 0 open, -1 open beside its face.

    After these it has `Feet.on`.
    """
    numbers = np.array(closed, dtype=float)
    numbers[np.flatnonzero(feet.beside)] = -1.0
    return np.concatenate([numbers, feet.on])


def feet_of(values: FloatArray, count: int) -> Feet:
    """The feet of a discrete state with that number of contacts and latches."""
    return Feet(tuple(value < -0.5 for value in values[:count].tolist()), values[count:].copy())
