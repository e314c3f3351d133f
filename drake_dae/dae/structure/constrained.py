"""What the constraints alone decide of a system: Assumptions (1)-(3), N*, and (9)-(14)."""

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray, show
from drake_dae.dae.derivatives import Derivatives
from drake_dae.dae.elimination import Elimination, eliminate
from drake_dae.dae.manifold import Manifold
from drake_dae.dae.states.margins import Margin, find_margin
from drake_dae.dae.states.region import Region
from drake_dae.dae.states.samples import Samples
from drake_dae.dae.structure.assumptions import Cause, Violation, rank_violation
from drake_dae.dae.structure.dependence import find_dependence
from drake_dae.dae.structure.relative_degrees import constraint_chains
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import ModelError


@dataclass(frozen=True, eq=False)
class Constrained:
    """What the constraints alone decide of a system, by Assumptions (1) and (3).

    Attributes:
        degrees: r_1, ..., r_m.
        samples: The consistent states at which numbers are decided.
        derivatives: The time derivatives along the motion on N*.
        elimination: Equations (9)-(14) as expressions; not finite where A(x) is singular.
        margin: The margin of A(x); None without constraints.
    """

    degrees: tuple[int, ...]
    samples: Samples
    derivatives: Derivatives
    elimination: Elimination
    margin: Margin | None


def examine_constraints(
    system: DaeSystem, guesses: FloatArray, region: Region | None = None
) -> Constrained:
    """Finds r_1, ..., r_m and A(x) of a system that `check_system` takes.

    Args:
        system: The system (1)-(3).
        guesses: States near which consistent ones are sought, shape (count, n).
        region: Where the consistent states must be; None for anywhere.

    Raises:
        AssumptionError: Assumption (1) or (3) is violated, or no constraint input acts on a
            constraint. A singular A(x) is left to `constraint_violation`.
        InconsistentStateError: There is no consistent state near a guess.
        ModelError: A function is not finite, or the mass matrix is none.
    """
    chains = constraint_chains(system, guesses, region)
    samples = Samples(Manifold(system, chains), guesses, region)
    _check_mass_matrix(system, samples.states)
    derivatives = Derivatives(system, ca.vertcat(ca.SX(0, 1), *[chain[-1] for chain in chains]))
    elimination = eliminate(derivatives)
    margin = find_margin(samples, elimination.constraint_matrix) if chains else None
    degrees = tuple(len(chain) for chain in chains)
    return Constrained(degrees, samples, derivatives, elimination, margin)


def check_system(system: DaeSystem) -> None:
    """Refuses a system in which there is nothing to steer, or too much to keep.

    Raises:
        AssumptionError: There are more constraints than states.
        ModelError: There is no control input, or the mass matrix is not symmetric and positive
            definite.
    """
    if system.num_controls == 0:
        raise ModelError(f"{system.name}: no control inputs, so there is nothing to steer")
    _check_mass_matrix(system, system.nominal_state[None])
    if system.num_constraints > system.num_states:
        names = tuple(signal.name for signal in system.constraint_output_signals)
        raise Violation(2, Cause.COUNT, names).error()


def constraint_violation(found: Constrained) -> Violation | None:
    """How a singular A(x) violates Assumption (1) or (2); None if it is regular."""
    causes = ((1, Cause.CONSTRAINT_DEGREE), (2, Cause.CONSTRAINT_RANK))
    signals = found.samples.system.constraint_output_signals
    violation = rank_violation(found.margin, signals, found.degrees, *causes)
    if violation is None or violation.cause is not Cause.CONSTRAINT_RANK or found.margin is None:
        return violation
    manifold, states = found.samples.manifold, found.samples.states
    dependence = find_dependence(manifold, found.elimination, states, found.margin.state)
    cause = Cause.CONSTRAINT_RANK
    if dependence.in_gradients:
        cause = Cause.REDUNDANT if dependence.everywhere else Cause.SINGULAR_CONFIGURATION
    elif dependence.everywhere:
        cause = Cause.HIDDEN_DEGREE
    return replace(violation, cause=cause, combinations=dependence.combinations)


def _check_mass_matrix(system: DaeSystem, states: FloatArray) -> None:
    """Refuses what is no mass matrix: its factorization LDL^T reads one triangle alone.

    Raises:
        ModelError: It is not symmetric and positive definite at a state.
    """
    function = system.trace("mass matrix", {"mass": ca.densify(system.mass_matrix)}, often=False)
    for state in states:
        mass = function(state, system.parameter_values)[0].reshape(state.size, state.size)
        length = np.sqrt(np.abs(np.diag(mass)))
        if np.all(np.isfinite(mass)) and np.all(length > 0.0):
            scaled = mass / length / length[:, None]
            symmetric = np.allclose(scaled, scaled.T, rtol=0.0, atol=1e-9)
            if symmetric and np.linalg.eigvalsh(scaled)[0] > 1e-12:
                continue
        raise ModelError(
            f"{system.name}: mass_matrix is not symmetric and positive definite at x = "
            f"{show(state)}. An equation in which no derivative stands is a constraint 0 = k(x) "
            "with a constraint input; where it holds an unknown z that has no derivative, lift it: "
            "make z a state with z' = v, v a new constraint input, and keep the equation as "
            "constraint"
        )
