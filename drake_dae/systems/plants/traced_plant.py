"""The computations of the plant of a DaeSystem, as traced functions.            (1)-(3), (25)"""

from collections.abc import Callable, Mapping, Sequence

import casadi as ca

from drake_dae.arrays import FloatArray
from drake_dae.blocks.computations import (
    DERIVATIVE,
    PARAMETERS,
    STATE,
    Block,
    Computation,
    Projection,
)
from drake_dae.dae.manifold.manifold import Manifold
from drake_dae.dae.structure.constrained import ConstraintStructure
from drake_dae.dae.system.signals import Signal
from drake_dae.systems.plants.contract import Plant


def traced_plant(
    plant: Plant,
    structure: ConstraintStructure,
    projects: bool,
    check_start: Callable[[FloatArray, FloatArray], None],
    moving: Sequence[int],
    signals: Mapping[str, Sequence[Signal]],
) -> Block:
    """The computations of a `DaePlant`; x' and v are one function if v needs the control.

    Args:
        plant: The plant.
        structure: Its structure.
        projects: Whether its state is projected onto N*.
        check_start: Refuses a start, by the state and all parameters.
        moving: The indices of parameters that come through its port "exogenous".
        signals: Names and units of the inputs of its functions, for messages.
    """
    dae, derivatives = structure.system, structure.derivatives
    rate, force = (  # (25)
        derivatives.expand(value) for value in (derivatives.rate, derivatives.constraint_input)
    )
    control = {"control": derivatives.control}
    regular = structure.elimination.pivot, "A(x) of Assumption (2)"
    by_state, by_control = (STATE, PARAMETERS), (STATE, "control", PARAMETERS)
    computations = []
    if structure.elimination.beta.nnz():
        together = dae.trace("plant", {"rate": rate, "force": force}, control, *regular)
        computations.append(Computation.of(together, by_control, (DERIVATIVE, "constraint_input")))
    else:
        motion = dae.trace("plant", {"rate": rate}, control, *regular)
        by_state_alone = dae.trace("plant", {"force": force}, {}, *regular)
        computations.append(Computation.of(motion, by_control, (DERIVATIVE,)))
        computations.append(Computation.of(by_state_alone, by_state, ("constraint_input",)))
    acting = ca.SX.sym("v", dae.num_constraints)
    by_force = (STATE, "constraint_input", PARAMETERS)
    signals_of = {"force": dae.forces(acting), "output": dae.outputs(acting)}
    names = {"force": "constraint_force", "output": "controlled_output"}
    if not structure.elimination.n_star.nnz():
        # m beta u cancels, so the output does not depend on the control.
        alpha = ca.substitute(force, derivatives.control, 0 * derivatives.control)
        output = dae.trace("controlled output", {"value": dae.outputs(alpha)}, {}, *regular)
        computations.append(Computation.of(output, by_state, ("controlled_output",)))
        del signals_of["output"]
    rest = dae.trace("signals", signals_of, {"force": acting})
    computations.append(Computation.of(rest, by_force, tuple(names[name] for name in signals_of)))
    manifold = structure.manifold
    residual = dae.trace("residual", {"value": manifold.residual_expression})
    computations.append(Computation.of(residual, by_state, ("constraint_residual",)))
    same = ca.Function("state", [dae.state], [dae.state])
    computations.append(Computation(same, (STATE,), ("state",)))
    projection = None
    if projects:
        projection = Projection(newton_of(manifold), dae.scale, manifold.project)
    return Block(
        plant,
        tuple(computations),
        check_start=check_start,
        projection=projection,
        scale=dae.scale,
        moving=tuple(moving),
        model=dae,
        ports=plant.port_signals,
        signals=signals,
    )


def newton_of(manifold: Manifold) -> ca.Function:
    """A Newton step to a manifold, as a `Projection` has it."""
    step = manifold.newton_step
    inputs = [ca.SX.sym(*item) for item in zip(step.input_names, step.sizes, strict=True)]
    return ca.Function("newton", inputs, step.function.call(inputs)[:1])
