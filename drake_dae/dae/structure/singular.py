"""Singular configurations, where gradients of constraints become dependent."""

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.structure.constrained import ConstraintStructure
from drake_dae.trace.round_off import positive

PART = 0.1
"""The least part of a constraint in a vanishing combination, relative to the largest."""


def dependent_constraints(
    structure: ConstraintStructure, state: FloatArray, parameters: FloatArray
) -> tuple[str, ...]:
    """Returns the constraints whose gradients become dependent where A(x) is singular, by name.

    They are the parts of n with n^T A(x) = 0, in units of the usual lengths of the gradients.
    """
    system = structure.system
    names = [signal.name for signal in system.constraint_output_signals]
    outputs = {"A": structure.elimination.constraint_matrix}
    function = system.trace("A(x)", outputs, often=False)
    shape = len(names), len(names)
    usual = [np.diag(function(x, parameters)[0].reshape(shape)) for x in structure.states]
    unit = 1.0 / np.sqrt(positive(np.median(np.abs(usual), axis=0)))
    matrix = function(state, parameters)[0].reshape(shape) * unit * unit[:, None]
    if not np.isfinite(matrix).all():
        return ()
    part = np.abs(np.linalg.svd(matrix)[0][:, -1])
    return tuple(names[i] for i in np.flatnonzero(part > PART * part.max()))
