"""Any DaeSystem as a LeafSystem."""

from functools import partial

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import (
    BasicVector,
    Context,
    ContinuousState,
    EventStatus,
    State,
)

from drake_dae.arrays import FloatArray
from drake_dae.dae.structure import Structure, find_structure
from drake_dae.dae.system import DaeSystem, check_is_system
from drake_dae.errors import (
    InconsistentStateError,
    ModelError,
    NonFiniteError,
    SimulationError,
    SingularityError,
)
from drake_dae.systems.block import Formula, ParameterizedSystem, TracedFormula
from drake_dae.trace.functions import SINGULAR_PIVOT, TracedFunction


class DaePlant(ParameterizedSystem):
    """The solution of a differential-algebraic system (1)-(3) on its manifold N*:

        x' = f(x) + g(x) v + h(x) u,    v = alpha(x) + beta(x) u,    z = l(x) + m(x) v.

    The state stays on N*: after each step it is projected to round-off. Drake does that at the
    start of the next step, so a log or a monitor sees it before its projection;
    `Simulator.AdvancePendingEvents()` projects the last state of a run.

    Input port:
        control: u, shape (p,).

    Output ports:
        state: x, shape (n,).
        constraint_force: v, shape (m,); direct feedthrough from `control` where beta is not zero.
        constraint_residual: k_i, L_f k_i, ..., L_f^(r_i - 1) k_i, constraint-major, shape
            (sum r_i,); zero on N*.
        controlled_output: z, shape (p,); direct feedthrough where n* = m beta is not zero.

    The context holds all parameters of the system as one numeric parameter; see `set_parameter`.
    The default state is the consistent one next to `system.nominal_state`.

    Converts to AutoDiffXd, for Drake's Linearize and DirectCollocation; without the projection.

    Args:
        system: The system, or its structure if that is known already.
        project: False leaves the drift off N* uncorrected, to study it.

    Raises:
        AssumptionError: The system violates an assumption of the theory.
        InconsistentStateError: At the start of a simulation, for a start state that is off N*.
        SingularityError, NonFiniteError: During a simulation, with time and state.
    """

    def __init__(self, system: DaeSystem | Structure, project: bool = True) -> None:
        if not isinstance(system, Structure):
            check_is_system(system, "DaePlant")
        structure = system if isinstance(system, Structure) else find_structure(system)
        super().__init__(structure.system, structure.system.parameter_values)
        self.structure = structure
        self.set_name(self.dae.name)
        dae, elimination, motion = self.dae, structure.elimination, structure.motion
        control = motion.control
        force = motion.expand(motion.constraint_input)
        x, p = dae.state, dae.parameter_symbol

        def traced(name: str, needs_control: bool, value: ca.SX) -> TracedFunction:
            inputs = {"state": x, "control": control, "parameters": p}
            if not needs_control:
                value = ca.substitute(value, inputs.pop("control"), ca.SX.zeros(dae.num_controls))
            outputs = {"value": value, "pivot": elimination.pivot}
            return TracedFunction(f"{dae.name} {name}", inputs, outputs)

        self._force_needs_control = elimination.beta.nnz() > 0
        self._output_needs_control = elimination.n_star.nnz() > 0
        self.dynamics = traced("dynamics", True, motion.expand(motion.rate))
        self._force = traced("constraint force", self._force_needs_control, force)
        output = dae.l + ca.mtimes(dae.m, force)
        self._output = traced("controlled output", self._output_needs_control, output)

        state_index = self.DeclareContinuousState(
            BasicVector(structure.manifold.project(dae.nominal_state))
        )
        self._control_port = self.DeclareVectorInputPort("control", dae.num_controls)
        by_state = {self.xc_ticket(), self.all_parameters_ticket()}
        by_control = by_state | {self.input_port_ticket(self._control_port.get_index())}
        self.DeclareStateOutputPort("state", state_index)
        self.DeclareVectorOutputPort(
            "constraint_force",
            dae.num_constraints,
            self._calc_force,
            by_control if self._force_needs_control else by_state,
        )
        self.DeclareVectorOutputPort(
            "constraint_residual",
            len(structure.manifold.residual_signals),
            self._calc_residual,
            by_state,
        )
        self.DeclareVectorOutputPort(
            "controlled_output",
            dae.num_controls,
            self._calc_output,
            by_control if self._output_needs_control else by_state,
        )
        self.DeclareInitializationPublishEvent(self._check_start)
        if project and dae.num_constraints:
            self.DeclarePerStepUnrestrictedUpdateEvent(self._project)

    def state(self, context: Context) -> FloatArray:
        """x, shape (n,)."""
        return context.get_continuous_state_vector().CopyToVector()

    def set_state(self, context: Context, state: ArrayLike) -> None:
        """Sets x as given, shape (n,); a run from there is refused if it is off N*.

        Raises:
            ModelError: A wrong shape.
        """
        x = np.asarray(state, dtype=float)
        if x.shape != (self.dae.num_states,):
            raise ModelError(
                f"{self.dae.name}: a state has shape ({self.dae.num_states},), got {x.shape}"
            )
        context.SetContinuousState(x)

    def set_consistent_state(self, context: Context, guess: ArrayLike) -> FloatArray:
        """Sets the state on N* next to a guess, shape (n,), and returns it.

        Raises:
            InconsistentStateError: None found near the guess.
        """
        state = self.structure.manifold.project(guess, self.parameters(context))
        self.set_state(context, state)
        return state

    def DoCalcTimeDerivatives(self, context: Context, derivatives: ContinuousState) -> None:
        value = self._evaluate(self.dynamics, context, self._control_port.Eval(context))
        derivatives.get_mutable_vector().SetFromVector(value)

    def _evaluate(
        self, function: TracedFunction, context: Context, control: FloatArray | None
    ) -> FloatArray:
        x = context.get_continuous_state_vector().CopyToVector()
        p = context.get_numeric_parameter(0).value()
        arguments = (x, p) if control is None else (x, control, p)
        value, pivot = function.evaluate(*arguments)
        if not function.is_finite or pivot[0] < SINGULAR_PIVOT:
            raise self._failure(function, context.get_time(), *arguments)
        return value

    def _failure(
        self, function: TracedFunction, time: float, state: FloatArray, *others: FloatArray
    ) -> SimulationError:
        """Names the input that was not finite, or the function, or else A(x)."""
        where = f"State: {np.array2string(state, precision=4, separator=', ')}"
        if function.is_finite:
            return SingularityError(
                f"{self.dae.name}: A(x) of Assumption (2) is singular at t = {time:.6g} s, so the "
                "constraint forces are not determined: the constraints depend on each other "
                f"there. {where}",
                time,
                state,
            )
        named = list(zip(self.dae.state_signals, state, strict=True))
        if "control" in function.input_names:
            named = [*zip(self.dae.control_signals, others[0], strict=True), *named]
        bad = [signal.name for signal, value in named if not np.isfinite(value)]
        reason = (
            f"its input {', '.join(bad)} is not finite"
            if bad
            else "a singular A(x), or a function left its domain"
        )
        return NonFiniteError(
            f"{function.name} is not finite at t = {time:.6g} s: {reason}. {where}", time, state
        )

    def _formulas(self) -> dict[str, Formula]:
        dae = self.dae
        by_state = {"state": dae.state, "parameters": dae.parameter_symbol}
        identity = TracedFunction(f"{dae.name} state", {"state": dae.state}, {"value": dae.state})
        residual = TracedFunction(
            f"{dae.name} residual",
            by_state,
            {"value": self.structure.manifold.residual_expression},
        )

        def checked(function: TracedFunction) -> TracedFormula:
            return TracedFormula(function, "value", failure=partial(self._failure, function))

        return {
            "derivative": checked(self.dynamics),
            "state": TracedFormula(identity, "value"),
            "constraint_force": checked(self._force),
            "constraint_residual": TracedFormula(residual, "value"),
            "controlled_output": checked(self._output),
        }

    def _control(self, context: Context, needed: bool) -> FloatArray | None:
        return self._control_port.Eval(context) if needed else None

    def _calc_force(self, context: Context, output: BasicVector) -> None:
        control = self._control(context, self._force_needs_control)
        output.SetFromVector(self._evaluate(self._force, context, control))

    def _calc_output(self, context: Context, output: BasicVector) -> None:
        control = self._control(context, self._output_needs_control)
        output.SetFromVector(self._evaluate(self._output, context, control))

    def _calc_residual(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(
            self.structure.manifold.residual(self.state(context), self.parameters(context))
        )

    def _check_start(self, context: Context) -> EventStatus:
        manifold = self.structure.manifold
        state, parameters = self.state(context), self.parameters(context)
        if manifold.is_consistent(state, parameters):
            return EventStatus.DidNothing()
        residual = manifold.residual(state, parameters)
        table = ", ".join(
            f"{signal.name} = {value:.3g} {signal.unit}"
            for signal, value in zip(manifold.residual_signals, residual, strict=True)
            if not abs(value) <= 1e-3 * np.max(np.abs(residual))
        )
        raise InconsistentStateError(
            f"{self.dae.name}: the start state is not on the constraint: {table}. Call "
            "set_consistent_state(context, guess) to start from the nearest consistent state",
            residual,
        )

    def _project(self, context: Context, state: State) -> EventStatus:
        try:
            x = self.structure.manifold.project(self.state(context), self.parameters(context))
        except InconsistentStateError as error:
            time, x = context.get_time(), self.state(context)
            raise SimulationError(
                f"the state left the constraint too far at t = {time:.6g} s, state "
                f"{np.array2string(x, precision=4, separator=', ')}: {error}. Take smaller "
                "steps or a better accuracy",
                time,
                x,
            ) from error
        state.get_mutable_continuous_state().SetFromVector(x)
        return EventStatus.Succeeded()
