"""The state realization of a DaeSystem as a LeafSystem of minimal dimension.        (25)-(27)"""

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import (
    BasicVector,
    CacheEntry,
    Context,
    ContinuousState,
    ValueProducer,
)

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, show
from drake_dae.blocks.lifetime import SHARED_DICTIONARY, port_value, weakly
from drake_dae.blocks.trials import state_tickets
from drake_dae.dae.normal_form import NormalForm
from drake_dae.errors import InconsistentStateError, ModelError, NonFiniteError, SimulationError
from drake_dae.systems.blocks.block import ParameterizedSystem
from drake_dae.trace.functions import TracedFunction


@checked(ModelError)
class StateRealization(ParameterizedSystem):
    """The motion on N* in coordinates (zeta, xi) of the normal form, equations (26)-(27):

        zeta_i,j' = zeta_i,j+1,    zeta_i,mu_i' = a_i(x) + B_i(x) u,
        xi' = L_f* xi + L_h* xi u,
        z_i = zeta_i,1, or l*_i + n*_i u where mu_i = 0,    v = alpha + beta u (25),

    with x = Phi^-1(0, zeta, xi). It has n - sum r_i states, the minimal number, and no constraints:
    x is on N* to round-off at every instant, without a projection. In exchange every evaluation
    inverts Phi by Newton's method, and Phi must stay regular along the motion. `DaePlant` needs
    neither.

    Input ports:
        control: u, shape (p,).
        exogenous: The signals w with their derivatives, if the system has any; see
            `ParameterizedSystem`.

    Output ports:
        state: x, shape (n,).
        coordinates: (zeta, xi), shape (n - sum r_i,).
        constraint_force: v, shape (m,); direct feedthrough from `control` where beta is not zero.
        controlled_output: z, shape (p,); direct feedthrough where n* is not zero.

    The context holds all parameters of the system as one numeric parameter; see `set_parameter`.

    Newton's method starts from the last x that was computed in the same context. Its result does
    not depend on that start beyond round-off, except for the branch: if several states have the
    same coordinates, x continues the last one. `set_state` chooses the branch; `Clone` of a context
    keeps it, `SetTimeStateAndParametersFrom` does not.

    Args:
        normal_form: The coordinates, `NormalForm(system)`.

    Raises:
        ModelError: It is not a normal form.
        SimulationError: During a run there is no x, since the motion left the domain of the
            coordinates; the exception has the time and the last state.
        SingularityError: A(x) is singular during a run; the exception has time and state.
        NonFiniteError: A value is not finite during a run, likewise.
    """

    __slots__ = SHARED_DICTIONARY
    no_gradient = "Newton's method finds its state; convert a DaePlant"

    def __init__(self, normal_form: NormalForm) -> None:
        structure, dae = normal_form.structure, normal_form.system
        signals = {"state": dae.state_signals, "control": dae.control_signals}
        super().__init__(dae, dae.parameter_values, signals)
        self.normal_form = normal_form
        self.set_name(dae.name)
        self._layout = layout = structure.layout
        self._on_manifold = np.zeros(sum(structure.constraint_degrees))
        elimination, derivatives = structure.elimination, structure.derivatives
        highest = structure.drift + ca.mtimes(structure.control_matrix, derivatives.control)  # (26)
        rate = ca.SX(0, 1)
        if normal_form.completion.numel():
            moving = derivatives.expand(derivatives.rate)
            rate = ca.jtimes(normal_form.completion, dae.state, moving)
            rate += dae.exogenous.rate(normal_form.completion)
        rates = ca.vertcat(highest[layout.dynamic.tolist(), :], rate)
        force = dae.forces(derivatives.expand(derivatives.constraint_input))  # (25)
        needs_control = elimination.beta.nnz() > 0
        self._dynamics = structure.trace("state realization", rates, True)
        self._force = structure.trace("constraint force", force, needs_control)
        direct = highest[layout.direct.tolist(), :]
        self._output = structure.trace("controlled output", direct, True)

        start = structure.states[0]
        coordinates = BasicVector(self._coordinates(start, None))
        self.DeclareContinuousState(coordinates)
        self._control_port = self.DeclareVectorInputPort("control", dae.num_controls)
        chain = ca.vertcat(structure.manifold.residual_expression, structure.chain)
        degrees = dae.exogenous.degrees(rates, force, direct, chain, normal_form.completion)
        by_state = state_tickets(self) | self._declare_exogenous(degrees)
        by_control = by_state | {self.input_port_ticket(self._control_port.get_index())}
        # x and the start of Newton's method: Drake passes the previous value to the calculation.
        # Only the index is kept, since Drake's entry would keep this system alive.
        self._state_index = self.DeclareCacheEntry(
            "state",
            ValueProducer(
                lambda: AbstractValue.Make((start.copy(), start.copy())), weakly(self._calc_state)
            ),
            by_state,
        ).cache_index()
        self.DeclareVectorOutputPort(
            "state", dae.num_states, port_value(self._eval_state), by_state
        )
        self.DeclareVectorOutputPort(
            "coordinates", coordinates.size(), weakly(self._copy_coordinates), state_tickets(self)
        )
        self.DeclareVectorOutputPort(
            "constraint_force",
            len(dae.force_signals),
            port_value(self._evaluate, self._force),
            by_control if needs_control else by_state,
        )
        self.DeclareVectorOutputPort(
            "controlled_output",
            dae.num_outputs,
            weakly(self._calc_output),
            by_control if layout.direct.size else state_tickets(self),
        )

    def state(self, context: Context) -> FloatArray:
        """The state x = Phi^-1(0, zeta, xi) in a context, shape (n,)."""
        return self._eval_state(context).copy()

    def set_state(self, context: Context, state: ArrayLike) -> None:
        """Sets the coordinates to those of a state on N*, shape (n,), and the branch to its own.

        Raises:
            InconsistentStateError: The state is off N*; use `manifold.project`.
            ModelError: The shape is wrong.
        """
        self.check_context(context)
        x, p = self.dae.state_vector(state), self._values(context)
        manifold = self.normal_form.structure.manifold
        if not manifold.is_consistent(x, p):
            residual = manifold.residual(x, p)
            raise InconsistentStateError(
                f"{self.dae.name}: the state is not on the constraint: its largest constraint "
                f"residual is {np.max(np.abs(residual)):.3g}. Start from "
                "structure.manifold.project(guess)",
                residual,
            )
        context.SetContinuousState(self._coordinates(x, p))
        # Invalidates x even if N* consists of points, so that there are no coordinates to set.
        context.get_mutable_numeric_parameter(0)
        entry = self._state_entry().get_mutable_cache_entry_value(context)
        entry.GetMutableValueOrThrow()[1][:] = x

    def DoCalcTimeDerivatives(self, context: Context, derivatives: ContinuousState) -> None:
        rates = self._evaluate(self._dynamics, context)
        coordinates = context.get_continuous_state_vector().CopyToVector()
        value = np.roll(coordinates, -1)
        value[self._layout.ends] = rates[: self._layout.ends.size]
        value[self._layout.chain_size :] = rates[self._layout.ends.size :]
        derivatives.get_mutable_vector().SetFromVector(value)

    def _state_entry(self) -> CacheEntry:
        return self.get_cache_entry(self._state_index)

    def _eval_state(self, context: Context) -> FloatArray:
        state: FloatArray = self._state_entry().Eval(context)[0]
        return state

    def _coordinates(self, state: FloatArray, parameters: FloatArray | None) -> FloatArray:
        return self.normal_form.coordinates(state, parameters)[self._on_manifold.size :]

    def _calc_state(self, context: Context, value: AbstractValue) -> None:
        coordinates = context.get_continuous_state_vector().CopyToVector()
        last, p = value.get_value()[1], self._values(context)
        if not np.all(np.isfinite(coordinates)):
            error = NonFiniteError(
                f"{self.dae.name}: the coordinates {coordinates} are not finite at t = "
                f"{context.get_time():.6g} s",
                context.get_time(),
                last,
            )
            self._steps.tolerate(context, error)
            value.set_value((np.full_like(last, np.nan), last))
            return
        target = np.concatenate([self._on_manifold, coordinates])  # (27)
        try:
            x = self.normal_form.state(target, last, p)
            value.set_value((x, x))
            return
        except InconsistentStateError as error:
            reason = error
        try:
            x = self.normal_form.state(target, None, p)
            value.set_value((x, x))
        except InconsistentStateError:
            # Also at a trial state: shorter steps would carry the motion over a fold of its
            # coordinates, where the continuation is not unique, to a wrong branch.
            raise SimulationError(
                f"the motion left the domain of its coordinates at t = {context.get_time():.6g} s, "
                f"last state {show(last)}: {reason}. DaePlant needs no coordinates",
                context.get_time(),
                last,
            ) from reason

    def _evaluate(self, function: TracedFunction, context: Context) -> FloatArray:
        x = self._eval_state(context)
        takes_control = "control" in function.input_names
        inputs = (self._control_port.Eval(context),) if takes_control else ()
        return self._checked(function, context, x, *inputs)[0]

    def _copy_coordinates(self, context: Context, output: BasicVector) -> None:
        output.SetFrom(context.get_continuous_state_vector())

    def _calc_output(self, context: Context, output: BasicVector) -> None:
        layout, value = self._layout, np.empty(self.dae.num_outputs)
        coordinates = context.get_continuous_state_vector().CopyToVector()
        value[layout.dynamic] = coordinates[layout.heads]
        if layout.direct.size:
            value[layout.direct] = self._evaluate(self._output, context)
        output.SetFromVector(value)
