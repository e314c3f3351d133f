"""The state realization of a DaeSystem as a LeafSystem of minimal dimension.        (23)-(27)"""

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, ContinuousState, ValueProducer

from drake_dae.arrays import FloatArray, show
from drake_dae.dae.normal_form import NormalForm
from drake_dae.dae.structure import Structure, find_structure
from drake_dae.dae.system import DaeSystem, check_is_system
from drake_dae.errors import (
    InconsistentStateError,
    ModelError,
    NonFiniteError,
    SimulationError,
    SingularityError,
)
from drake_dae.systems.block import Formula, ParameterizedSystem
from drake_dae.trace.functions import SINGULAR_PIVOT, TracedFunction


class StateRealization(ParameterizedSystem):
    """The motion on N* in coordinates (zeta, xi) of the normal form, equations (26)-(27):

        zeta_i,j' = zeta_i,j+1,    zeta_i,mu_i' = a_i(x) + B_i(x) u,
        xi' = L_f* xi + L_h* xi u,
        z_i = zeta_i,1, or l*_i + n*_i u where mu_i = 0,    v = alpha + beta u (25),

    with x = Phi^-1(0, zeta, xi). It has n - sum r_i states, as few as the motion allows, and no
    constraint to keep: x is on N* to round-off at every instant, without a projection. The price
    is the inverse of Phi, by Newton's method, in every evaluation, and that Phi must stay
    regular along the motion. `DaePlant` needs neither.

    Input port:
        control: u, shape (p,).

    Output ports:
        state: x, shape (n,).
        coordinates: (zeta, xi), shape (n - sum r_i,).
        constraint_force: v, shape (m,); direct feedthrough from `control` where beta is not zero.
        controlled_output: z, shape (p,); direct feedthrough where n* is not zero.

    The context holds all parameters of the system as one numeric parameter; see `set_parameter`.

    Newton's method starts from the last x that was computed in the same context. What it finds
    does not depend on that start beyond round-off, but for the branch: where several states have
    the same coordinates, x continues the last one. `set_state` chooses the branch;
    `Clone` of a context keeps it, `SetTimeStateAndParametersFrom` does not.

    Args:
        normal_form: Of the system; or the system, or its structure, for a completion that is
            chosen.

    Raises:
        AssumptionError: The system violates an assumption of the theory.
        ModelError: The structure has no normal form.
        SimulationError: During a simulation, with time and last state: there is no x, since the
            motion came to an end of the coordinates.
        SingularityError, NonFiniteError: During a simulation, with time and state.
    """

    def __init__(self, normal_form: NormalForm | Structure | DaeSystem) -> None:
        if not isinstance(normal_form, (NormalForm, Structure)):
            check_is_system(normal_form, "StateRealization")
            normal_form = find_structure(normal_form)
        if isinstance(normal_form, Structure):
            normal_form = NormalForm(normal_form)
        structure = normal_form.structure
        super().__init__(structure.system, structure.system.parameter_values)
        self.normal_form = normal_form
        self.set_name(self.dae.name)
        dae, elimination, motion = self.dae, structure.elimination, structure.motion
        x, u, p = dae.state, motion.control, dae.parameter_symbol
        degrees = np.array(structure.output_degrees)
        starts = np.cumsum(degrees) - degrees
        self._chained, self._direct = np.flatnonzero(degrees), np.flatnonzero(degrees == 0)
        self._heads = starts[self._chained]
        self._ends = self._heads + degrees[self._chained] - 1
        self._num_chained = int(degrees.sum())
        self._on_manifold = np.zeros(sum(structure.constraint_degrees))

        def traced(name: str, needs_control: bool, value: ca.SX) -> TracedFunction:
            inputs = {"state": x, "control": u, "parameters": p}
            if not needs_control:
                value = ca.substitute(value, inputs.pop("control"), ca.SX.zeros(dae.num_controls))
            outputs = {"value": value, "pivot": elimination.pivot}
            return TracedFunction(f"{dae.name} {name}", inputs, outputs)

        highest = structure.drift + ca.mtimes(structure.control_matrix, u)
        rate = ca.SX(0, 1)
        if normal_form.completion.numel():
            rate = ca.jtimes(normal_form.completion, x, motion.expand(motion.rate))
        rates = ca.vertcat(*[highest[int(i)] for i in self._chained], rate)
        force = motion.expand(motion.constraint_input)
        self._force_needs_control = elimination.beta.nnz() > 0
        self._dynamics = traced("state realization", True, rates)
        self._force = traced("constraint force", self._force_needs_control, force)
        direct = ca.vertcat(ca.SX(0, 1), *[highest[int(i)] for i in self._direct])
        self._output = traced("controlled output", True, direct)

        start = structure.states[0]
        state_index = self.DeclareContinuousState(BasicVector(self._coordinates(start, None)))
        self._control_port = self.DeclareVectorInputPort("control", dae.num_controls)
        by_state = {self.xc_ticket(), self.all_parameters_ticket()}
        by_control = by_state | {self.input_port_ticket(self._control_port.get_index())}
        # Drake hands the value before to the calculation: Newton's method starts there.
        self._state_entry = self.DeclareCacheEntry(
            "state",
            ValueProducer(lambda: AbstractValue.Make(start.copy()), self._calc_state),
            by_state,
        )
        self.DeclareVectorOutputPort("state", dae.num_states, self._copy_state, by_state)
        self.DeclareStateOutputPort("coordinates", state_index)
        self.DeclareVectorOutputPort(
            "constraint_force",
            dae.num_constraints,
            self._calc_force,
            by_control if self._force_needs_control else by_state,
        )
        self.DeclareVectorOutputPort(
            "controlled_output",
            dae.num_controls,
            self._calc_output,
            by_control if self._direct.size else {self.xc_ticket()},
        )

    def state(self, context: Context) -> FloatArray:
        """x = Phi^-1(0, zeta, xi), shape (n,)."""
        return self._state_entry.Eval(context).copy()

    def set_state(self, context: Context, state: ArrayLike) -> None:
        """Sets the coordinates to those of a state on N*, shape (n,), and the branch to its own.

        Raises:
            InconsistentStateError: The state is off N*; `manifold.project` finds one that is not.
            ModelError: A wrong shape.
        """
        x = np.array(state, dtype=float)
        p = self.parameters(context)
        manifold = self.normal_form.structure.manifold
        if not manifold.is_consistent(x, p):
            residual = manifold.residual(x, p)
            raise InconsistentStateError(
                f"{self.dae.name}: the state is not on the constraint: the largest of its "
                f"residuals is {np.max(np.abs(residual)):.3g}. Start from "
                "structure.manifold.project(guess)",
                residual,
            )
        context.SetContinuousState(self._coordinates(x, p))
        # Makes x out of date where N* is but points, so that there are no coordinates to set.
        context.get_mutable_numeric_parameter(0)
        entry = self._state_entry.get_mutable_cache_entry_value(context)
        entry.GetMutableValueOrThrow()[:] = x

    def DoCalcTimeDerivatives(self, context: Context, derivatives: ContinuousState) -> None:
        rates = self._evaluate(self._dynamics, context, self._control_port.Eval(context))
        coordinates = context.get_continuous_state_vector().CopyToVector()
        value = np.roll(coordinates, -1)
        value[self._ends] = rates[: self._ends.size]
        value[self._num_chained :] = rates[self._ends.size :]
        derivatives.get_mutable_vector().SetFromVector(value)

    def _coordinates(self, state: FloatArray, parameters: FloatArray | None) -> FloatArray:
        return self.normal_form.coordinates(state, parameters)[self._on_manifold.size :]

    def _calc_state(self, context: Context, value: AbstractValue) -> None:
        coordinates = context.get_continuous_state_vector().CopyToVector()
        last, p = value.get_value(), self.parameters(context)
        if not np.all(np.isfinite(coordinates)):
            raise NonFiniteError(
                f"{self.dae.name}: the coordinates {coordinates} are not finite at t = "
                f"{context.get_time():.6g} s",
                context.get_time(),
                last,
            )
        wanted = np.concatenate([self._on_manifold, coordinates])
        try:
            value.set_value(self.normal_form.state(wanted, last, p))
            return
        except InconsistentStateError as error:
            reason = error
        try:
            value.set_value(self.normal_form.state(wanted, None, p))
        except InconsistentStateError:
            raise SimulationError(
                f"the motion came to an end of its coordinates at t = {context.get_time():.6g} s, "
                f"last state {show(last)}: {reason}. DaePlant needs no coordinates",
                context.get_time(),
                last,
            ) from reason

    def _evaluate(
        self, function: TracedFunction, context: Context, *control: FloatArray
    ) -> FloatArray:
        x = self._state_entry.Eval(context)
        value, pivot = function.evaluate(x, *control, context.get_numeric_parameter(0).value())
        if function.is_finite and pivot[0] >= SINGULAR_PIVOT:
            return value
        time = context.get_time()
        where = f"at t = {time:.6g} s, state {show(x)}"
        bad = [
            signal.name
            for values in control
            for signal, value in zip(self.dae.control_signals, values, strict=True)
            if not np.isfinite(value)
        ]
        if bad:
            raise NonFiniteError(f"the input {', '.join(bad)} is not finite {where}", time, x)
        if not function.is_finite:
            raise NonFiniteError(
                f"{function.name} is not finite {where}: a singular A(x), or a function left its "
                "domain",
                time,
                x,
            )
        raise SingularityError(
            f"A(x) of Assumption (2) is singular {where}: the constraints depend on each other "
            "there, so their forces are not determined",
            time,
            x,
        )

    def _formulas(self) -> dict[str, Formula]:
        raise ModelError(
            f"{self.dae.name}: a state realization does not convert to AutoDiffXd, since Newton's "
            "method finds its state; convert a DaePlant"
        )

    def _copy_state(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._state_entry.Eval(context))

    def _calc_force(self, context: Context, output: BasicVector) -> None:
        control = [self._control_port.Eval(context)] if self._force_needs_control else []
        output.SetFromVector(self._evaluate(self._force, context, *control))

    def _calc_output(self, context: Context, output: BasicVector) -> None:
        value = np.empty(self.dae.num_controls)
        coordinates = context.get_continuous_state_vector().CopyToVector()
        value[self._chained] = coordinates[self._heads]
        if self._direct.size:
            control = self._control_port.Eval(context)
            value[self._direct] = self._evaluate(self._output, context, control)
        output.SetFromVector(value)
