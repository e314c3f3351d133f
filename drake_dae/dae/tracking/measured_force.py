"""Measured constraint inputs in the tracking law.                       (59), (71), (81)"""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arrays import FloatArray, numbers
from drake_dae.dae.signals import DerivativeLayout
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import GainError, ModelError


@dataclass(frozen=True, eq=False)
class ForceMeasurement:
    """The measurement of v in the law (28), for the outputs z_i = v_j:

        mu_i = 0:  ubar_i = r_i - Gbar_j (v - r), the term J^T Gbar (lambda - r_2) of (59). The
            force error of a wrong model shrinks to 1 / (1 + Gbar).
        mu_i >= 1: v_j takes the place of the model's l*_i, as (71) and (81) allow.

    Outputs that are combinations of constraint inputs, z_i = m_i(x) v, take m_i v in place of v_j;
    then Gbar is a multiple of the identity.
    """

    layout: DerivativeLayout
    rows: dict[int, ca.SX]
    inputs: dict[int, int]
    gain: FloatArray
    symbol: ca.SX

    @classmethod
    def of(cls, system: DaeSystem, layout: DerivativeLayout, gain: ArrayLike) -> "ForceMeasurement":
        """Returns the measurement of all constraint inputs of a system."""
        if system.sharing is not None:
            raise ModelError(
                f"{system.name}: measured_force is not supported for redundant constraints that "
                "share their forces; leave them out with `drop_constraints`, or use the law's "
                "own force"
            )
        rows = _force_outputs(system)
        inputs = {i: j for i, row in rows.items() if (j := _single(row)) is not None}
        matrix = force_gain(gain, system.num_constraints)
        for i in rows:
            name = system.output_signals[i].name
            if i not in inputs and np.any(matrix != matrix[0, 0] * np.eye(len(matrix))):
                raise GainError(
                    f"force_gain must be one number, since '{name}' is a combination of forces"
                )
            if layout.degrees[i] and matrix[inputs.get(i, 0)].any():
                raise GainError(
                    f"force_gain is for outputs of degree 0; '{name}' has degree "
                    f"{layout.degrees[i]} and takes the measured force itself. Leave it 0"
                )
        return cls(layout, rows, inputs, matrix, ca.SX.sym("v", system.num_constraints))

    def value(self, output: int) -> ca.SX:
        """Returns the measured value of an output, m_i v."""
        return ca.mtimes(self.rows[output], self.symbol)

    def chain(self, chain: ca.SX) -> ca.SX:
        """Returns the output chains with the measurement in place of the model's l*_i."""
        result = ca.SX(chain)
        for head, output in zip(self.layout.heads, self.layout.dynamic, strict=True):
            if output in self.rows:
                result[int(head)] = self.value(int(output))  # (71), (81)
        return result

    def highest(self, highest: ca.SX, values: ca.SX) -> ca.SX:
        """Returns the highest derivatives of the reference, less Gbar (v - r) where mu_i = 0."""
        excess = ca.SX(self.symbol.numel(), 1)
        for i, j in self.inputs.items():
            excess[j] = self.symbol[j] - values[i]
        result = ca.SX(highest)
        for i in map(int, self.layout.direct):
            if i in self.inputs:
                result[i] -= ca.mtimes(ca.DM(self.gain[self.inputs[i]]).T, excess)  # (59)
            elif i in self.rows:
                result[i] -= self.gain[0, 0] * (self.value(i) - values[i])
        return result


def force_gain(value: ArrayLike, size: int) -> FloatArray:
    """Checks Gbar of (59) and returns it as a matrix of shape (m, m)."""
    gain = numbers("force_gain", value, GainError)
    if gain.ndim == 0:
        gain = gain * np.eye(size)
    if gain.shape != (size, size) or not np.all(np.isfinite(gain)):
        raise GainError(f"force_gain must be a number or shape ({size}, {size}), got {value!r}")
    smallest = float(np.min(np.linalg.eigvalsh((gain + gain.T) / 2.0), initial=0.0))
    if smallest < -1e-12:
        raise GainError(
            "force_gain, Gbar of (59), must be positive semidefinite: a negative one feeds the "
            f"force error back with the wrong sign. Smallest eigenvalue {smallest:.3g}"
        )
    return gain


def _force_outputs(system: DaeSystem) -> dict[int, ca.SX]:
    """The outputs that consist of constraint inputs, z_i = m_i v, as output index i -> m_i."""
    rows = {
        i: system.m[i, :]
        for i in range(system.num_outputs)
        if system.l[i].is_zero() and not system.m[i, :].is_zero()
    }
    if not rows:
        raise ModelError(
            f"{system.name}: measured_force needs an output that is a constraint input or a "
            "combination of some"
        )
    return rows


def force_outputs_of(system: DaeSystem) -> dict[int, int]:
    """The outputs that are single constraint inputs, z_i = v_j, as output index i -> index j."""
    rows = _force_outputs(system)
    return {i: j for i, row in rows.items() if (j := _single(row)) is not None}


def _single(row: ca.SX) -> int | None:
    """The index j of a row whose only entry is a one; None for another row."""
    row = ca.sparsify(row)
    j: int = row.sparsity().get_triplet()[1][0]
    return j if row.nnz() == 1 and row[j].is_one() else None
