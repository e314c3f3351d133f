"""What the constraints alone decide of a system: Assumptions (1)-(3), N*, and (9)-(14)."""

from collections.abc import Sequence
from dataclasses import dataclass

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
from drake_dae.dae.structure.relative_degrees import constraint_chains
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import ModelError


@dataclass(frozen=True, eq=False)
class Constrained:
    """What the constraints alone decide, by Assumptions (1) and (3).

    Attributes:
        degrees: r_1, ..., r_m.
        samples: The consistent states at which numbers are decided.
        derivatives: Time derivatives along the motion on N*.
        elimination: (9)-(14); not finite where A(x) is singular.
        margin: Margin of A(x); None without constraints.
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
        system: (1)-(3).
        guesses: States near which consistent ones are looked for, shape (count, n).
        region: Where these must be.

    Raises:
        AssumptionError: (1), (3), or a constraint that no constraint input acts on. A singular A(x)
            is left to `constraint_violation`.
        InconsistentStateError, ModelError: As `find_structure`.
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
    """Refuses what there is nothing to examine of.

    Raises:
        AssumptionError: More constraints than states.
        ModelError: No control input, or a mass matrix that is not symmetric and positive definite.
    """
    if system.num_controls == 0:
        raise ModelError(f"{system.name}: no control inputs, so there is nothing to steer")
    _check_mass_matrix(system, system.nominal_state[None])
    if system.num_constraints > system.num_states:
        names = tuple(signal.name for signal in system.constraint_output_signals)
        raise Violation(2, Cause.COUNT, names).error()


def constraint_violation(
    system: DaeSystem, degrees: Sequence[int], margin: Margin | None
) -> Violation | None:
    """How a singular A(x) violates Assumption (1) or (2); None if it is regular."""
    causes = ((1, Cause.CONSTRAINT_DEGREE), (2, Cause.CONSTRAINT_RANK))
    return rank_violation(margin, system.constraint_output_signals, degrees, *causes)


def _check_mass_matrix(system: DaeSystem, states: FloatArray) -> None:
    """Its factorization LDL^T reads one triangle, and would not notice.

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
            f"{show(state)}"
        )
