"""The ports of a robot with opening contacts, in the mode of its context."""

from collections.abc import Mapping, Sequence
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import BasicVector, Context, ContinuousState

from drake_dae.arrays import FloatArray, numbers, unknown_name
from drake_dae.dae.structure.constrained import ConstraintStructure, constraint_structure_of
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import AssumptionError, ModelError, SimulationError, SingularityError
from drake_dae.robots.model import RobotModel
from drake_dae.systems.blocks.along import function_along
from drake_dae.systems.blocks.block import ParameterizedSystem
from drake_dae.systems.blocks.lifetime import SHARED_DICTIONARY, port_value, weakly
from drake_dae.systems.blocks.trials import state_tickets
from drake_dae.systems.plants.contact.contact_material import Peg
from drake_dae.systems.plants.contract import Plant
from drake_dae.systems.plants.robot_ports import RobotPorts
from drake_dae.systems.plants.unilateral.contacts import UnilateralContacts, coefficient
from drake_dae.systems.plants.unilateral.edges import Feet
from drake_dae.systems.plants.unilateral.modes import Closed, Mode, Modes, closed_of, feet_of
from drake_dae.trace.functions import TracedFunction

_FORCES = ("constraint_force", "hole_force")
_OF_HOLES = (("hole_mode", "closed", ""), ("hole_gap", "gap", "m"), ("hole_force", "force", "N"))


class ModalPorts(ParameterizedSystem, Plant):
    """State, mode and ports of a `UnilateralRobotPlant`, with its attributes, in a fixed mode.

    Args:
        model: The robot.
        contacts: Name of a unilateral constraint -> its coefficient of restitution.
        structure: The structure of `model.dae`, if it is known.
        latches: The names of bilateral constraints that open and close by commands.
        pegs: The pegs that enter holes.
    """

    __slots__ = SHARED_DICTIONARY
    no_gradient = "its velocities jump; convert a RobotPlant with the contacts that stay closed"

    def __init__(
        self,
        model: RobotModel,
        contacts: Mapping[str, float],
        structure: ConstraintStructure | None = None,
        latches: Sequence[str] = (),
        pegs: Sequence[Peg] = (),
    ) -> None:
        if structure is not None:
            structure = constraint_structure_of(type(self).__name__, model.dae, structure)
        self._contacts = bound = UnilateralContacts(model, contacts, latches, pegs)
        dae = model.dae
        signals = {"state": dae.state_signals, "control": dae.control_signals}
        super().__init__(dae, dae.parameter_values, signals)
        self.DeclareNumericParameter(BasicVector(bound.restitution))
        self.set_name(model.name)
        self.model: RobotModel = model
        self.contacts, self.latches = (*bound.shown, *latches), bound.latches
        count = len(bound.every)
        self.normals = tuple(bound.normals[: len(bound.shown)])
        self.gap_signals = tuple(Signal(f"{name}.gap", "m") for name in bound.shown)
        self.mode_signals = tuple(Signal(f"{name}.closed") for name in self.contacts)
        own, m, in_holes = len(bound.shown), dae.num_constraints, bound.names[len(bound.shown) :]
        self.hole_signals = {
            name: tuple(Signal(f"{contact}.{kind}", unit) for contact in in_holes)
            for name, kind, unit in _OF_HOLES
            if in_holes
        }
        parts = {"mode": slice(len(self.contacts)), "gap": slice(own), "constraint_force": slice(m)}
        in_hole = {"hole_mode": own, "hole_gap": own, "hole_force": m}
        self._parts = parts | {name: slice(start, None) for name, start in in_hole.items()}
        self.modes = Modes(bound, structure)
        self._by_numbers: dict[bytes, Mode] = {}
        self._now: Mode | None = None
        opened = self.modes((False,) * count, dae.nominal_state)
        start = opened.structure.manifold.project(dae.nominal_state)
        self.DeclareContinuousState(BasicVector(start))
        self.DeclareDiscreteState(count + bound.edges.size)
        self._is_controlled = dae.num_controls > 0
        self._control_port = self.DeclareVectorInputPort("control", dae.num_controls)
        self._latch_port = None
        if latches:
            self._latch_port = self.DeclareVectorInputPort("latch", len(latches))
        residual = bound.residual
        self._residual = dae.trace("constraint residual", {"value": residual})
        moved = (dae.f, bound.dae.g, dae.h, dae.l, dae.m, residual, dae.exogenous.rate(bound.drift))
        self._by_state = state_tickets(self) | self._declare_exogenous(
            dae.exogenous.degrees(*moved)
        )
        self._by_state.add(self.xd_ticket())
        # The control enters forces if it enters the equations that they balance.
        derivatives = opened.structure.derivatives
        rate = derivatives.expand(derivatives.rate)
        balanced = ca.jtimes(bound.rates, dae.state, rate)
        self._by_control = set(self._by_state)
        if ca.depends_on(balanced, derivatives.control):
            self._by_control.add(self.input_port_ticket(self._control_port.get_index()))
        self._by_latch = set()
        if self._latch_port is not None:
            self._by_latch.add(self.input_port_ticket(self._latch_port.get_index()))
        by_state, by_control, by_mode = self._by_state, self._by_control, {self.xd_ticket()}
        for name, size, value, tickets in (
            ("state", dae.num_states, self._state, by_state),
            ("mode", len(self.contacts), self._mode_numbers, by_mode),
            ("gap", own, self._gap, by_state),
            ("constraint_force", m, self._force, by_control),
            ("constraint_residual", residual.numel(), self._held_residual, by_state),
            ("controlled_output", dae.num_outputs, self._output, by_control),
            ("hole_mode", len(in_holes), self._mode_numbers, by_mode),
            ("hole_gap", len(in_holes), self._gap, by_state),
            ("hole_force", len(in_holes), self._force, by_control),
        ):
            if in_holes or name not in in_hole:
                part = [self._parts[name]] if name in self._parts else []
                self.DeclareVectorOutputPort(name, size, port_value(value, *part), tickets)
        values, force = weakly(self._values), weakly(self._mode_force)
        self._ports = RobotPorts(self, model, values, force, self._by_state, self._by_control)
        self.wrench_signals = self._ports.wrench_signals
        names = ("gap", "constraint_force", "constraint_residual", "controlled_output")
        of_hole = ("hole_gap", "hole_force") if in_holes else ()
        self.functions = (*names, *of_hole, *self._ports.loop_signals)

    def get_parameter(self, context: Context, name: str) -> FloatArray:
        """A parameter by name, shape (k,), such as "<contact>.restitution".

        Raises:
            ModelError: No parameter has that name.
        """
        place = self._restitution_place(name)
        if place is None:
            return super().get_parameter(context, name)
        self.check_context(context)
        return np.array(context.get_numeric_parameter(1).value()[[place]])

    def set_parameter(self, context: Context, name: str, value: ArrayLike) -> None:
        """Changes a parameter in a context; see `DaePlant.set_parameter`.

        Raises:
            ModelError: No parameter has that name, or the value does not fit.
        """
        place = self._restitution_place(name)
        if place is None:
            super().set_parameter(context, name, value)
            return
        self.check_context(context)
        values = context.get_numeric_parameter(1).CopyToVector()
        given = numbers(f"parameter '{name}'", value)
        if given.size != 1:
            raise ModelError(f"parameter '{name}' has 1 entry, got {value!r}")
        values[place] = coefficient(name, given.item())
        context.get_mutable_numeric_parameter(1).SetFromVector(values)

    def _restitution_place(self, name: str) -> int | None:
        """The index of the contact whose coefficient of restitution has a name, or None."""
        names = [f"{contact}.restitution" for contact in self._contacts.shown]
        return names.index(name) if name in names else None

    @property
    def further_signals(self) -> Mapping[str, Sequence[Signal]]:
        contacts = {"mode": self.mode_signals, "gap": self.gap_signals}
        return {**self._ports.loop_signals, **contacts, **self.hole_signals}

    def set_state(self, context: Context, state: ArrayLike) -> None:
        """Sets x as given, shape (n,), all contacts open: a run finds its mode at its start.

        Raises:
            ModelError: The shape is wrong.
        """
        super().set_state(context, state)
        context.SetDiscreteState(np.zeros(len(self._contacts.every) + self._contacts.edges.size))

    def gaps(self, context: Context) -> FloatArray:
        """phi of each contact, m, shape (k,)."""
        gaps = self._contacts.gaps.evaluate(self.state(context), self._values(context))[0]
        return gaps[: len(self.gap_signals)].copy()

    @cached_property
    def structure(self) -> ConstraintStructure:  # type: ignore[override]
        """The structure with all contacts closed, and all latches if that is possible, else none.

        Raises:
            ModelError: The contacts cannot be closed together, likewise as an AssumptionError.
        """
        contacts, nominal = self._contacts, self.dae.nominal_state
        own = len(contacts.shown)
        touching = (*(True for _ in contacts.shown), *(False for _ in contacts.names[own:]))
        try:
            return self.modes((*touching, *(True for _ in self.latches)), nominal).structure
        except (ModelError, AssumptionError):
            if not self.latches:
                raise
            return self.modes((*touching, *(False for _ in self.latches)), nominal).structure

    @property
    def port_signals(self) -> dict[str, tuple[Signal, ...]]:
        residual = self._contacts.residual_signals
        return {**super().port_signals, "constraint_residual": residual}

    def closed(self, context: Context) -> tuple[str, ...]:
        """The names of the contacts that are closed, with those of pegs and latches."""
        self.check_context(context)
        shut = closed_of(self._numbers(context))
        every = self._contacts.every
        return tuple(name for name, is_shut in zip(every, shut, strict=True) if is_shut)

    def along(self, port: str, given: Mapping[str, FloatArray]) -> FloatArray:
        """The values of a port of `functions` at given times, one row each; nan without a value.

        Args:
            port: The port's name.
            given: "state", "mode", "parameters" and "control", and with pegs "hole_mode", one row
                for each time.

        Raises:
            ModelError: There is no such port.
        """
        if port not in self.functions:
            raise ModelError(f"{self.dae.name}: {unknown_name('port', port, self.functions)}")
        table = np.full((len(given["state"]), self.GetOutputPort(port).size()), np.nan)
        modes = np.column_stack([given["mode"], given.get("hole_mode", given["mode"][:, :0])])
        for flags in np.unique(modes, axis=0):
            rows = np.flatnonzero((modes == flags).all(axis=1))
            in_mode = {name: values[rows] for name, values in given.items()}
            mode = self.modes(closed_of(flags), in_mode["state"][0])
            if port == "constraint_residual":
                table[rows] = mode.holds * function_along(self._residual, in_mode)
            else:
                functions = {
                    "gap": self._contacts.gaps,
                    "hole_gap": self._contacts.gaps,
                    "constraint_force": mode.force,
                    "hole_force": mode.force,
                    "controlled_output": mode.output,
                    **self._ports.joints,
                }
                values = function_along(functions[port], in_mode)
                values = self._pushing(values) if port in _FORCES else values
                table[rows] = values[:, self._parts.get(port, slice(None))]
        return table

    def DoCalcTimeDerivatives(self, context: Context, derivatives: ContinuousState) -> None:
        derivatives.SetFromVector(self._evaluate(self._mode(context).dynamics, context))

    def _mode(self, context: Context) -> Mode:
        # Called in each evaluation, so without tuples.
        numbers = context.get_discrete_state_vector().value()
        mode = self._by_numbers.get(numbers.tobytes())
        if mode is None:
            state = context.get_continuous_state_vector().value()
            mode = self.modes(closed_of(self._numbers(context)), state)
            self._by_numbers[numbers.tobytes()] = mode
        self._now = mode
        return mode

    def _commanded(self, context: Context) -> Closed:
        """The latches that are commanded to be closed; all without a wire."""
        port = self._latch_port
        if port is None or not port.HasValue(context):
            return (True,) * len(self.latches)
        return closed_of(port.Eval(context))

    def _control(self, context: Context) -> FloatArray:
        return self._control_port.Eval(context) if self._is_controlled else np.zeros(0)

    def _evaluate(self, function: TracedFunction, context: Context) -> FloatArray:
        x = context.get_continuous_state_vector().value()
        if "control" in function.input_names:
            return self._checked(function, context, x, self._control_port.Eval(context))[0]
        return self._checked(function, context, x)[0]

    def explained(
        self,
        error: SimulationError,
        parameters: FloatArray,
        *inputs: FloatArray,
        held: FloatArray | None = None,
    ) -> SimulationError:
        """Returns in a Painleve paradox the error with its outcome."""
        mode = None if self._now is None else self._now.closed
        if held is not None:
            mode = closed_of(held[: len(self._contacts.every)])
        if mode is None or not isinstance(error, SingularityError):
            return error
        if not self.dae.frictional_contacts:
            return error
        control = inputs[0] if inputs else np.zeros(self.dae.num_controls)
        contacts = self._contacts
        known = parameters[: self.dae.parameter_symbol.numel()]  # No restitution, which is last.
        terms = contacts.terms(error.state, control, known)
        places = [i for i, shut in enumerate(mode[: len(contacts.names)]) if shut]
        normals = [contacts.normals[i] for i in places]
        bilateral = contacts.bilateral_in(mode).tolist()
        outcome = terms.painleve_outcome(bilateral, normals)
        if outcome is None:
            return error
        names = [contacts.names[i] for i in places]
        return contacts.painleve_error(error.time, error.state, names, outcome)

    def _numbers(self, context: Context) -> FloatArray:
        """The numbers of contacts and latches: 1 closed, 0 open, -1 beside a face; (k + l,)."""
        numbers: FloatArray = context.get_discrete_state_vector().value()
        return numbers[: len(self._contacts.every)]

    def _feet(self, context: Context) -> Feet:
        return feet_of(context.get_discrete_state_vector().value(), len(self._contacts.every))

    def _state(self, context: Context) -> FloatArray:
        return context.get_continuous_state_vector().value()

    def _mode_numbers(self, part: slice, context: Context) -> FloatArray:
        # Beside a face a contact is open.
        return np.maximum(self._numbers(context), 0.0)[part]

    def _mode_force(self, context: Context) -> FloatArray:
        return self._evaluate(self._mode(context).force, context)[: self.dae.num_constraints]

    def _force(self, part: slice, context: Context) -> FloatArray:
        return self._pushing(self._evaluate(self._mode(context).force, context))[part]

    def _pushing(self, force: FloatArray) -> FloatArray:
        """Forces, along the last axis; those of contacts are at least zero.

        A contact opens at the end of a step, within round-off after the zero of its force.
        """
        pushing, normals = force.copy(), self._contacts.normals
        pushing[..., normals] = np.maximum(pushing[..., normals], 0.0)
        return pushing

    def _output(self, context: Context) -> FloatArray:
        return self._evaluate(self._mode(context).output, context)

    def _held_residual(self, context: Context) -> FloatArray:
        return self._mode(context).holds * self._evaluate(self._residual, context)

    def _gap(self, part: slice, context: Context) -> FloatArray:
        return self._evaluate(self._contacts.gaps, context)[part]
