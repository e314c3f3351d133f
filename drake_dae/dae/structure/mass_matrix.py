"""Checks of a mass matrix E(x) of E x' = f + g v + h u."""

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray, show
from drake_dae.dae.system.system import DaeSystem
from drake_dae.errors import ModelError


def check_mass_matrix(system: DaeSystem, states: FloatArray) -> None:
    """Checks a mass matrix, since LDL^T reads only one triangle of it."""
    function = system.trace("mass matrix", {"mass": ca.densify(system.mass_matrix)}, often=False)
    for state in states:
        mass = function(state, system.parameter_values)[0].reshape(state.size, state.size)
        if is_positive_definite(mass):
            continue
        raise ModelError(
            f"{system.name}: mass_matrix is not symmetric and positive definite at x = "
            f"{show(state)}. An equation in which no derivative stands is a constraint 0 = k(x) "
            "with a constraint input; where it holds an unknown z that has no derivative, lift it: "
            "make z a state with z' = v, v a new constraint input, and keep the equation as "
            "constraint"
        )


def is_positive_definite(matrix: FloatArray) -> bool:
    """Whether a matrix is symmetric and positive definite, independent of units."""
    length = np.sqrt(np.abs(np.diag(matrix)))
    if not (np.all(np.isfinite(matrix)) and np.all(length > 0.0)):
        return False
    scaled = matrix / length / length[:, None]
    is_symmetric = np.allclose(scaled, scaled.T, rtol=0.0, atol=1e-9)
    return bool(is_symmetric and np.linalg.eigvalsh(scaled)[0] > 1e-12)
