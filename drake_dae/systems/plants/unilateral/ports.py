"""The ports of a robot with opening contacts, in the mode of its context."""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import BasicVector, Context, ContinuousState

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, numbers, unknown_name
from drake_dae.dae.structure.constrained import (
    ConstraintStructure,
    constraint_structure_of,
)
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError, SimulationError, SingularityError
from drake_dae.robots.model import RobotModel
from drake_dae.systems.blocks.along import function_along
from drake_dae.systems.blocks.block import ParameterizedSystem
from drake_dae.systems.blocks.formulas import Formula
from drake_dae.systems.blocks.lifetime import SHARED_DICTIONARY, weakly
from drake_dae.systems.blocks.trials import state_tickets
from drake_dae.systems.plants.contract import Plant
from drake_dae.systems.plants.robot_ports import RobotPorts
from drake_dae.systems.plants.unilateral.contacts import UnilateralContacts, coefficient
from drake_dae.systems.plants.unilateral.modes import Mode, Modes, closed_of
from drake_dae.trace.functions import TracedFunction


@checked(ModelError)
class ModalPorts(ParameterizedSystem, Plant):
    """State, mode and ports of a `UnilateralRobotPlant`, with its attributes, in a fixed mode.

    Args:
        model: The robot.
        contacts: Name of a unilateral constraint -> its coefficient of restitution.
        structure: The structure of `model.dae`, if it is known.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(
        self,
        model: RobotModel,
        contacts: Mapping[str, float],
        structure: ConstraintStructure | None = None,
    ) -> None:
        if structure is not None:
            structure = constraint_structure_of(type(self).__name__, model.dae, structure)
        self._contacts = bound = UnilateralContacts(model, contacts)
        dae = bound.dae
        signals = {"state": dae.state_signals, "control": dae.control_signals}
        super().__init__(dae, dae.parameter_values, signals)
        self.DeclareNumericParameter(BasicVector(bound.restitution))
        self.set_name(model.name)
        self.model: RobotModel = model
        self.contacts = bound.names
        self.normals = tuple(bound.normals)
        self.gap_signals = tuple(Signal(f"{name}.gap", "m") for name in bound.names)
        self.mode_signals = tuple(Signal(f"{name}.closed") for name in bound.names)
        self.modes = Modes(bound, structure)
        self._by_numbers: dict[bytes, Mode] = {}
        self._now: Mode | None = None
        count = len(self.contacts)
        opened = self.modes((False,) * count, dae.nominal_state)
        start = opened.structure.manifold.project(dae.nominal_state)
        self.DeclareContinuousState(BasicVector(start))
        self.DeclareDiscreteState(count)
        self._is_controlled = dae.num_controls > 0
        self._control_port = self.DeclareVectorInputPort("control", dae.num_controls)
        residual = bound.residual
        self._residual = dae.trace("constraint residual", {"value": residual})
        moved = (dae.f, dae.g, dae.h, dae.l, dae.m, residual, dae.exogenous.rate(bound.drift))
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
        self._declare("state", dae.num_states, self._copy_state)
        self.DeclareVectorOutputPort("mode", count, weakly(self._copy_mode), {self.xd_ticket()})
        self._declare("gap", count, self._calc_gap)
        self._declare("constraint_force", dae.num_constraints, self._calc_force, True)
        self._declare("constraint_residual", residual.numel(), self._calc_residual)
        self._declare("controlled_output", dae.num_outputs, self._calc_output, True)
        own = weakly(self._values), weakly(self._shown_force)
        self._ports = RobotPorts(self, model, dae, *own, self._by_state, self._by_control)
        self.wrench_signals = self._ports.wrench_signals
        known = ("gap", "constraint_force", "constraint_residual", "controlled_output")
        self.functions = (*known, *self._ports.loop_signals)

    def _declare(
        self, name: str, size: int, calc: Callable[..., None], by_control: bool = False
    ) -> None:
        tickets = self._by_control if by_control else self._by_state
        self.DeclareVectorOutputPort(name, size, weakly(calc), tickets)

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
        names = [f"{contact}.restitution" for contact in self.contacts]
        return names.index(name) if name in names else None

    @property
    def further_signals(self) -> Mapping[str, Sequence[Signal]]:
        own = {"mode": self.mode_signals, "gap": self.gap_signals}
        return {**self._ports.loop_signals, **own}

    def state(self, context: Context) -> FloatArray:
        """The state x in a context, shape (n,)."""
        self.check_context(context)
        return super().state(context)

    def set_state(self, context: Context, state: ArrayLike) -> None:
        """Sets x as given, shape (n,), all contacts open: a run finds its mode at its start.

        Raises:
            ModelError: The shape is wrong.
        """
        self.check_context(context)
        super().set_state(context, state)
        context.SetDiscreteState(np.zeros(len(self.contacts)))

    def gaps(self, context: Context) -> FloatArray:
        """phi of each contact, m, shape (k,)."""
        self.check_context(context)
        return self._contacts.gaps.evaluate(self.state(context), self._values(context))[0].copy()

    @cached_property
    def structure(self) -> ConstraintStructure:  # type: ignore[override]
        """The structure of the system with all contacts closed.

        Raises:
            ModelError: They cannot be closed together, likewise as an AssumptionError.
        """
        return self.modes((True,) * len(self.contacts), self.dae.nominal_state).structure

    def closed(self, context: Context) -> tuple[str, ...]:
        """The names of the contacts that are closed."""
        self.check_context(context)
        shut = closed_of(context.get_discrete_state_vector().value())
        return tuple(name for name, is_shut in zip(self.contacts, shut, strict=True) if is_shut)

    def along(self, port: str, given: Mapping[str, FloatArray]) -> FloatArray:
        """The values of a port of `functions` at given times, one row each; nan without a value.

        Args:
            port: The port's name.
            given: "state", "mode", "parameters" and "control", one row for each time.

        Raises:
            ModelError: There is no such port.
        """
        if port not in self.functions:
            raise ModelError(f"{self.dae.name}: {unknown_name('port', port, self.functions)}")
        found = np.full((len(given["state"]), self.GetOutputPort(port).size()), np.nan)
        for now in np.unique(given["mode"], axis=0):
            rows = np.flatnonzero((given["mode"] == now).all(axis=1))
            here = {name: values[rows] for name, values in given.items()}
            mode = self.modes(closed_of(now), here["state"][0])
            if port == "constraint_residual":
                found[rows] = mode.holds * function_along(self._residual, here)
            else:
                function = {
                    "gap": self._contacts.gaps,
                    "constraint_force": mode.force,
                    "controlled_output": mode.output,
                    "loop_state": self._ports.loops,
                }[port]
                assert function is not None  # It is one of `functions`.
                found[rows] = function_along(function, here)
        return self._pushing(found) if port == "constraint_force" else found

    def DoCalcTimeDerivatives(self, context: Context, derivatives: ContinuousState) -> None:
        dynamics = self._mode(context).dynamics
        derivatives.SetFromVector(self._evaluated(dynamics, context, self._is_controlled))

    def _formulas(self) -> dict[str, Formula]:
        raise ModelError(
            f"{self.dae.name}: a plant whose contacts open and close does not convert to "
            "AutoDiffXd, since its velocities jump; convert a RobotPlant with those contacts that "
            "stay closed"
        )

    def _mode(self, context: Context) -> Mode:
        numbers = context.get_discrete_state_vector().value()
        mode = self._by_numbers.get(
            numbers.tobytes()
        )  # Called in each evaluation, so without tuples.
        if mode is None:
            state = context.get_continuous_state_vector().value()
            mode = self.modes(closed_of(numbers), state)
            self._by_numbers[numbers.tobytes()] = mode
        self._now = mode
        return mode

    def _control(self, context: Context) -> FloatArray:
        return self._control_port.Eval(context) if self._is_controlled else np.zeros(0)

    def _evaluated(
        self, function: TracedFunction, context: Context, needs_control: bool
    ) -> FloatArray:
        x = context.get_continuous_state_vector().value()
        if needs_control:
            return self._checked(function, context, x, self._control_port.Eval(context))[0]
        return self._checked(function, context, x)[0]

    def _shown_force(self, context: Context) -> FloatArray:
        mode = self._mode(context)
        return self._evaluated(mode.force, context, mode.force_needs_control)

    def _explained(
        self, error: SimulationError, parameters: FloatArray, *inputs: FloatArray
    ) -> SimulationError:
        """In a Painleve paradox, the error with its outcome."""
        if not (self.dae.frictional_contacts and isinstance(error, SingularityError) and self._now):
            return error
        control = inputs[0] if inputs else np.zeros(self.dae.num_controls)
        bound = self._contacts
        terms = bound.terms(error.state, control, parameters)
        places = [i for i, shut in enumerate(self._now.closed) if shut]
        found = terms.painleve_outcome(bound.kept.tolist(), [bound.normals[i] for i in places])
        if found is None:
            return error
        return bound.painleve_error(
            error.time, error.state, [self.contacts[i] for i in places], found
        )

    def _copy_state(self, context: Context, output: BasicVector) -> None:
        output.SetFrom(context.get_continuous_state_vector())

    def _copy_mode(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state_vector().value())

    def _calc_force(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._pushing(self._shown_force(context)))

    def _pushing(self, force: FloatArray) -> FloatArray:
        """Forces, along the last axis; those of contacts are at least zero.

        A contact opens at the end of a step, within round-off after the zero of its force.
        """
        found, normals = force.copy(), self._contacts.normals
        found[..., normals] = np.maximum(found[..., normals], 0.0)
        return found

    def _calc_output(self, context: Context, output: BasicVector) -> None:
        mode = self._mode(context)
        output.SetFromVector(self._evaluated(mode.output, context, mode.output_needs_control))

    def _calc_residual(self, context: Context, output: BasicVector) -> None:
        residual = self._evaluated(self._residual, context, False)
        output.SetFromVector(self._mode(context).holds * residual)

    def _calc_gap(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._evaluated(self._contacts.gaps, context, False))
