"""Any DaeSystem as a LeafSystem."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import (
    BasicVector,
    Context,
    ContinuousState,
    DependencyTicket,
    EventStatus,
    State,
)

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.blocks.computations import Block
from drake_dae.blocks.failures import (
    assembled_otherwise,
    jammed_contact,
    off_manifold,
    off_start,
    singular_configuration,
)
from drake_dae.blocks.lifetime import SHARED_DICTIONARY, port_value, weakly
from drake_dae.blocks.trials import state_tickets
from drake_dae.dae.structure.constrained import ConstraintStructure, constraint_structure_of
from drake_dae.dae.structure.redundancy import manifold_of_left_out
from drake_dae.dae.system.system import DaeSystem
from drake_dae.errors import InconsistentStateError, ModelError, SimulationError, SingularityError
from drake_dae.systems.blocks.along import function_along
from drake_dae.systems.blocks.block import ParameterizedSystem
from drake_dae.systems.blocks.formulas import Formula, TracedFormula
from drake_dae.systems.plants.contract import Plant
from drake_dae.systems.plants.traced_plant import traced_plant
from drake_dae.trace.functions import TracedFunction

_CHANGED, _UNCHANGED = EventStatus.Succeeded(), EventStatus.DidNothing()


@checked(ModelError)
class DaePlant(ParameterizedSystem, Plant):
    """The solution of a differential-algebraic system (1)-(3) on its manifold N*:

        x' = f(x) + g(x) v + h(x) u,    v = alpha(x) + beta(x) u,    z = l(x) + m(x) v.

    The state stays on N*: after each step it is projected to round-off. Drake does that at the
    start of the next step, so a log or a monitor sees it before its projection;
    `Simulator.AdvancePendingEvents()` projects the last state of a run.

    Only Assumptions (1)-(3) are needed: the numbers of controls and controlled outputs may differ
    or be zero, and the control need not affect the outputs. A port of size 0 needs no wire.

    Input ports:
        control: u, shape (p,).
        exogenous: The signals w with their derivatives, if the system has any; see
            `ParameterizedSystem`.

    Output ports:
        state: x, shape (n,).
        constraint_force: v, shape (m,); direct feedthrough from `control` where beta is not zero.
            With shared forces of redundant constraints it has all forces, in the order of
            `system.force_signals`: their sum is determined, the split is by least squares; see
            `share_forces`.
        constraint_residual: k_i, L_f k_i, ..., L_f^(r_i - 1) k_i, constraint-major, shape
            (sum r_i,); zero on N*.
        controlled_output: z, one entry per output; direct feedthrough where n* = m beta is not
            zero.

    A run ends at a singular configuration, where gradients of constraints become dependent; the
    error names them.

    At a trial state of an integrator, missing values are nan, and error control takes a shorter
    step. At an accepted state, or if no step is short enough, an error is raised.

    The context holds all parameters of the system as one numeric parameter; see `set_parameter`.
    The default state is the consistent one next to `system.nominal_state`.

    The block converts to AutoDiffXd, for Drake's Linearize and DirectCollocation; it then has no
    projection.

    Args:
        system: The system (1)-(3).
        structure: The structure of the system, by `find_constraint_structure` or
            `find_structure`; the former if None.
        project: False leaves the drift off N* uncorrected, to study it.

    Attributes:
        structure: The structure.
        projects: Whether the state is projected onto N* after each step.
        functions: Name of an output port -> its function of state, parameters and, for some, the
            control.

    Raises:
        AssumptionError: The system violates one of Assumptions (1)-(3).
        ModelError: It is not a system, or the structure is that of another one.
        InconsistentStateError: A simulation starts from a state that is off N*.
        SingularityError: A(x) is singular during a run; the exception has time and state. In a
            Painleve paradox it is a PainleveError with the outcome.
        NonFiniteError: A value is not finite during a run, likewise.
        SimulationError: The state cannot be projected onto N* during a run, likewise.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(
        self,
        system: DaeSystem,
        *,
        structure: ConstraintStructure | None = None,
        project: bool = True,
    ) -> None:
        structure = constraint_structure_of(type(self).__name__, system, structure)
        signals = {"state": system.state_signals, "control": system.control_signals}
        super().__init__(system, system.parameter_values, signals)
        self.structure = structure
        self.set_name(system.name)
        elimination, derivatives = structure.elimination, structure.derivatives
        constraint_input = derivatives.expand(derivatives.constraint_input)
        output = system.outputs(constraint_input)
        force = system.forces(constraint_input)
        self._is_controlled = system.num_controls > 0
        rate = derivatives.expand(derivatives.rate)
        self.dynamics = structure.trace("dynamics", rate, self._is_controlled)
        self._force = structure.trace("constraint force", force, elimination.beta.nnz() > 0)
        needs_control = elimination.n_star.nnz() > 0
        self._output = structure.trace("controlled output", output, needs_control)
        self.functions: dict[str, TracedFunction] = {
            "constraint_force": self._force,
            "constraint_residual": structure.manifold.residual_function,
            "controlled_output": self._output,
        }

        self.DeclareContinuousState(BasicVector(structure.manifold.project(system.nominal_state)))
        self._control_port = self.DeclareVectorInputPort("control", system.num_controls)
        residual = structure.manifold.residual_expression
        self._left_out = manifold_of_left_out(system)
        degrees = system.exogenous.degrees(rate, force, output, residual)
        self._by_state = state_tickets(self) | self._declare_exogenous(degrees)
        self._control_ticket = self.input_port_ticket(self._control_port.get_index())
        self.DeclareVectorOutputPort(
            "state", system.num_states, weakly(self._copy_state), state_tickets(self)
        )
        for name, function in self.functions.items():
            calculate = port_value(self._evaluate, function)
            if name == "constraint_residual":
                calculate = port_value(self._residual)
            size = function.outputs[0].size
            self.DeclareVectorOutputPort(name, size, calculate, self._tickets(function))
        self.DeclareInitializationPublishEvent(weakly(self._check_start))
        self.projects = bool(project and system.num_constraints)
        if self.projects:
            self.DeclarePerStepUnrestrictedUpdateEvent(weakly(self._project))

    def _tickets(self, function: TracedFunction) -> set[DependencyTicket]:
        """The dependencies of the values of a function."""
        takes_control = "control" in function.input_names
        return self._by_state | ({self._control_ticket} if takes_control else set())

    def set_consistent_state(self, context: Context, guess: ArrayLike) -> FloatArray:
        """Sets the state on N* next to a guess, shape (n,), and returns it.

        Raises:
            InconsistentStateError: None is found near the guess.
        """
        self.check_context(context)
        values = self._values(context)
        state = self.structure.manifold.settle(guess, values)
        self._check_left_out(state, values)
        self.set_state(context, state)
        return state

    def DoCalcTimeDerivatives(self, context: Context, derivatives: ContinuousState) -> None:
        # Called most by an integrator, so without further calls for valid values.
        if self._is_controlled and self._exogenous is None:
            control = self._control_port.Eval(context)
            state = context.get_continuous_state_vector().value()
            parameters = context.get_numeric_parameter(0).value()
            (rate,) = self.dynamics.evaluate(state, control, parameters)
            if self.dynamics.is_valid:
                derivatives.SetFromVector(rate)
                return
        derivatives.SetFromVector(self._evaluate(self.dynamics, context))

    def _evaluate(self, function: TracedFunction, context: Context) -> FloatArray:
        x = context.get_continuous_state_vector().value()  # The context's own numbers, no copy.
        if "control" in function.input_names:
            return self._checked(function, context, x, self._control_port.Eval(context))[0]
        return self._checked(function, context, x)[0]

    def along(self, port: str, given: Mapping[str, FloatArray]) -> FloatArray:
        """The values of a port of `functions` at given times, one row each; nan without a value.

        Args:
            port: The port's name.
            given: "state", "parameters" and "control", one row for each time.

        Raises:
            ModelError: There is no such port, or values are missing or have a wrong size.
        """
        if port not in self.functions:
            raise ModelError(f"{self.dae.name}: {unknown_name('port', port, self.functions)}")
        function = self.functions[port]
        sizes = {
            "state": self.dae.num_states,
            "control": self.dae.num_controls,
            "parameters": self.dae.parameter_symbol.numel(),
        }
        for name in function.input_names:
            if name not in given or np.shape(given[name])[1:] != (sizes[name],):
                raise ModelError(f"{self.dae.name}: '{name}' must have shape (k, {sizes[name]})")
        return function_along(function, given)

    def explained(
        self,
        error: SimulationError,
        parameters: FloatArray,
        *inputs: FloatArray,
    ) -> SimulationError:
        """Returns the error with dependent constraints, or in a Painleve paradox its outcome."""
        if not isinstance(error, SingularityError):
            return error
        if not self.dae.frictional_contacts:
            names = self.structure.dependent_constraints(error.state, parameters)
            return singular_configuration(self.dae.name, error.time, error.state, names)
        if not inputs and self._is_controlled:
            return error
        control = inputs[0] if self._is_controlled else np.zeros(0)
        taken = (control,) if "control" in self._force.input_names else ()
        force = self._force(error.state, *taken, parameters)[0]
        return jammed_contact(self.structure, error, control, parameters, force) or error

    def _formulas(self) -> dict[str, Formula]:
        state = self.dae.trace("state", {"value": self.dae.state})
        functions = {"derivative": self.dynamics, "state": state, **self.functions}
        return {
            name: TracedFormula(function, function.output_names[0], signals=self._signals)
            for name, function in functions.items()
        }

    def traced(self) -> Block:
        return traced_plant(
            self,
            self.structure,
            self.projects,
            self.check_start,
            self.exogenous_places,
            self._signals,
        )

    def _copy_state(self, context: Context, output: BasicVector) -> None:
        output.SetFrom(context.get_continuous_state_vector())

    def _residual(self, context: Context) -> FloatArray:
        state = context.get_continuous_state_vector().CopyToVector()
        return self.structure.manifold.residual(state, self._values(context))

    def _check_start(self, context: Context) -> EventStatus:
        self.check_start(self.state(context), self._values(context))
        return EventStatus.DidNothing()

    def check_start(self, state: FloatArray, parameters: FloatArray) -> None:
        """Refuses a start that is off N*.

        Args:
            state: x, shape (n,).
            parameters: Values of all parameters.

        Raises:
            InconsistentStateError: The start is off N*.
        """
        manifold = self.structure.manifold
        if manifold.is_consistent(state, parameters):
            self._check_left_out(state, parameters)
            return
        raise off_start(self.dae.name, manifold, manifold.residual(state, parameters))

    def _check_left_out(self, state: FloatArray, parameters: FloatArray) -> None:
        """Refuses a state that violates redundant constraints that were left out."""
        left_out = self._left_out
        if left_out is None or left_out.is_consistent(state, parameters):
            return
        raise assembled_otherwise(
            self.dae.name, left_out, state, left_out.residual(state, parameters)
        )

    def _project(self, context: Context, state: State) -> EventStatus:
        x = context.get_continuous_state_vector().value()
        if self._exogenous is None:
            parameters = context.get_numeric_parameter(0).value()
        else:
            parameters = self._values(context)
        manifold = self.structure.manifold
        projected = manifold.first_steps(x, parameters)
        if projected is None:
            try:
                projected = manifold.searched(x, parameters)
            except InconsistentStateError as error:
                raise off_manifold(context.get_time(), x.copy(), error) from error
        if projected is x:
            return _UNCHANGED
        state.get_mutable_continuous_state().SetFromVector(projected)
        return _CHANGED
