"""Any DaeSystem as a LeafSystem."""

from collections.abc import Mapping

import casadi as ca
import numpy as np
from pydrake.systems.framework import Context, EventStatus

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.blocks.block import Block, Projection, Requirement
from drake_dae.blocks.failures import (
    assembled_otherwise,
    jammed_contact,
    off_start,
    singular_configuration,
)
from drake_dae.blocks.lifetime import SHARED_DICTIONARY, weakly
from drake_dae.dae import ConstraintStructure, DaeSystem, constraint_structure_of
from drake_dae.dae.redundancy import manifold_of_left_out
from drake_dae.errors import ModelError, SimulationError, SingularityError
from drake_dae.systems.parameterized import ParameterizedSystem
from drake_dae.systems.plants.contract import Plant, port_signals


@checked(ModelError)
class DaePlant(ParameterizedSystem, Plant):
    """The solution of a differential-algebraic system (1)-(3) on its manifold N*:

        x' = f(x) + g(x) v + h(x) u,    v = alpha(x) + beta(x) u,    z = l(x) + m(x) v.

    The state stays on N*: after each step it is projected to round-off. Drake does that at the
    start of the next step, so a log or a monitor sees it before its projection;
    `Simulator.AdvancePendingEvents()` projects the last state of a run.

    Only Assumptions (1)-(3) are needed: there may be other numbers of controls than of outputs, or
    none. The default state is the consistent one next to `system.nominal_state`.

    Input ports:
        control: u, shape (p,).
        exogenous: The signals w with their derivatives, if there are any.

    Output ports:
        state: x, shape (n,).
        constraint_force: v, shape (m,); direct feedthrough from `control` where beta is not zero.
            With `share_forces` it has all forces of `system.force_signals`.
        constraint_residual: k_i, L_f k_i, ..., L_f^(r_i - 1) k_i, shape (sum r_i,); zero on N*.
        controlled_output: z, shape (p,); direct feedthrough where n* = m beta is not zero.

    A converted plant (AutoDiffXd, for Linearize or DirectCollocation) has no projection.

    Args:
        system: The system (1)-(3).
        structure: Its structure; found if None.
        project: False leaves the drift off N* uncorrected, to study it.

    Raises:
        AssumptionError: The system violates one of Assumptions (1)-(3).
        ModelError: It is not a system, or the structure is that of another one.
        InconsistentStateError: A simulation starts from a state that is off N*.
        SingularityError, NonFiniteError, SimulationError: During a run A(x) is singular (a
            PainleveError in a paradox), a value is not finite, or the state cannot be projected.
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
        self._start(structure, dae_block(structure, project))

    def _start(self, structure: ConstraintStructure, block: Block) -> None:
        """Makes the system of its block."""
        self.structure, self.equations = structure, structure.system
        self._left_out = manifold_of_left_out(structure.system)
        super().__init__(structure.system, block)
        self.DeclareInitializationPublishEvent(weakly(self._check_start))

    def explained(
        self, error: SimulationError, values: Mapping[str, FloatArray]
    ) -> SimulationError:
        """Returns the error with dependent constraints, or as that of a Painleve paradox."""
        if not isinstance(error, SingularityError):
            return error
        parameters = values.get("parameters", np.zeros(0)).copy()
        if "input exogenous" in values:
            parameters[self.exogenous_places] = values["input exogenous"]
        if not self.dae.frictional_contacts:
            names = self.structure.dependent_constraints(error.state, parameters)
            return singular_configuration(self.dae.name, error.time, error.state, names)
        return jammed_contact(self.structure, error, parameters) or error

    def _check_start(self, context: Context) -> EventStatus:
        self.check_start(self.state(context), self._values(context))
        return EventStatus.DidNothing()

    def check_start(self, state: FloatArray, parameters: FloatArray) -> None:
        """Refuses a start off N*, or that violates redundant constraints that were left out."""
        name, manifold, left_out = self.dae.name, self.structure.manifold, self._left_out
        if not manifold.is_consistent(state, parameters):
            raise off_start(name, manifold, manifold.residual(state, parameters))
        if left_out is not None and not left_out.is_consistent(state, parameters):
            residual = left_out.residual(state, parameters)
            raise assembled_otherwise(name, left_out, state, residual)


def dae_block(structure: ConstraintStructure, project: bool = True) -> Block:
    """The motion on N* and the constraint force, (25), as a block; see `DaePlant`."""
    system, derivatives = structure.system, structure.derivatives
    manifold, control = structure.manifold, derivatives.control
    regular = Requirement.regular(structure.elimination.pivot, "A(x) of Assumption (2)")
    force = derivatives.expand(derivatives.constraint_input)
    output, none = system.outputs(force), ca.SX.zeros(control.numel())
    if not structure.elimination.n_star.nnz():  # m beta u cancels.
        output = ca.substitute(output, control, none)
    if not structure.elimination.beta.nnz():
        force = ca.substitute(force, control, none)
    projection = None
    if project and system.num_constraints:
        step = manifold.newton_step
        symbols = [ca.SX.sym(*item) for item in zip(step.input_names, step.sizes, strict=True)]
        newton = ca.Function("newton", symbols, step.function.call(symbols)[:1])
        projection = Projection(newton, manifold.projected, system.parameter_symbol)
    return Block(
        system.name,
        inputs={"control": control},
        outputs={
            "state": system.state,
            "constraint_force": regular.of(system.forces(force)),
            "constraint_residual": manifold.residual_expression,
            "controlled_output": regular.of(output),
        },
        state=system.state,
        derivative=regular.of(derivatives.expand(derivatives.rate)),
        parameters=system.parameter_symbol,
        start={
            "state": manifold.project(system.nominal_state),
            "parameters": system.parameter_values,
        },
        projection=projection,
        scale=system.scale,
        requirements=(regular,),
        signals={
            **port_signals(structure),
            "control": system.control_signals,
            "parameters": system.parameter_signals,
        },
    )
