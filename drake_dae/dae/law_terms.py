"""Terms of the law: measured constraint inputs, integrals, and deflection.   (59), (71), (81)"""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arrays import FloatArray, numbers, positive, unknown_name
from drake_dae.dae.gains import FeedbackGains, GainDesign
from drake_dae.dae.law_model import damping_gains
from drake_dae.dae.signals import DerivativeLayout, Signal
from drake_dae.dae.structure import Structure
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import GainError, ModelError
from drake_dae.trace.factorization import Factorization


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
        if system.sharing is not None:
            raise ModelError(
                f"{system.name}: measured_force is not supported for redundant constraints that "
                "share their forces; leave them out with `drop_constraints`, or use the law's "
                "own force"
            )
        rows, inputs = _force_outputs(system)
        matrix = _force_gain(gain, system.num_constraints)
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


def _force_gain(value: ArrayLike, size: int) -> FloatArray:
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


def _force_outputs(system: DaeSystem) -> tuple[dict[int, ca.SX], dict[int, int]]:
    """The outputs z_i = m_i v, as i -> m_i; and those that are one input, z_i = v_j, as i -> j."""
    rows = {
        i: ca.sparsify(system.m[i, :])
        for i in range(system.num_outputs)
        if system.l[i].is_zero() and not system.m[i, :].is_zero()
    }
    if not rows:
        raise ModelError(
            f"{system.name}: measured_force needs an output that is a constraint input or a "
            "combination of some"
        )
    columns = {i: row.sparsity().get_triplet()[1] for i, row in rows.items()}
    single = {i: j[0] for i, j in columns.items() if len(j) == 1 and rows[i][j[0]].is_one()}
    return rows, single


@dataclass(frozen=True, eq=False)
class IntegralAction:
    """The integrals sigma_i' = z_i - r_i of some outputs, which extend (30) to

        e_i^(mu_i) = -K_i0 sigma_i - K_i1 e_i - ... - K_i mu_i e_i^(mu_i - 1),

    so that an output has mu_i + 1 poles in place of mu_i. If mu_i = 0 it is the integral of a
    measured force: ubar_i = r_i - K_i0 int (z_i - r_i) dt. With a constant model error, e_i tends
    to zero.
    """

    outputs: tuple[int, ...]
    degrees: tuple[int, ...]
    signals: tuple[Signal, ...]
    symbol: ca.SX

    @classmethod
    def of(
        cls,
        system: DaeSystem,
        degrees: Sequence[int],
        names: Sequence[str],
        measured: ForceMeasurement | None,
    ) -> "IntegralAction":
        known, integrated = [signal.name for signal in system.output_signals], list[int]()
        for name in names:
            if name not in known:
                raise GainError(f"integral: {unknown_name('output', name, known)}")
            i = known.index(name)
            if i in integrated:
                raise GainError(f"integral: '{name}' occurs twice")
            if degrees[i] == 0 and (measured is None or i not in measured.rows):
                raise GainError(
                    f"integral: by the model the law attains '{name}' without delay, so there is "
                    "no error to integrate; make the law with measured_force=True, and integrate "
                    "a constraint input or a combination of some"
                )
            integrated.append(i)
        chosen = tuple(sorted(integrated))
        of = [system.output_signals[i] for i in chosen]
        signals = tuple(Signal(f"integral of {s.name}", f"{s.unit or '1'} s") for s in of)
        return cls(chosen, tuple(degrees), signals, ca.SX.sym("integral", len(chosen)))

    @property
    def all_degrees(self) -> tuple[int, ...]:
        """The number of poles of each output."""
        return tuple(degree + (i in self.outputs) for i, degree in enumerate(self.degrees))

    def coordinates(self, errors: ca.SX) -> ca.SX:
        """Returns the error coordinates, with the integrals among them."""
        starts, rows = DerivativeLayout(self.degrees).starts.tolist(), []
        for i, degree in enumerate(self.degrees):
            if i in self.outputs:
                rows.append(self.symbol[self.outputs.index(i)])
            rows.append(errors[starts[i] : starts[i] + degree, :])
        return ca.vertcat(ca.SX(0, 1), *rows)

    def rate(self, chain: ca.SX, values: ca.SX, measured: ForceMeasurement | None) -> ca.SX:
        """Returns sigma' = z - r of these outputs, shape (k, 1)."""
        starts, rows = DerivativeLayout(self.degrees).starts.tolist(), [ca.SX(0, 1)]
        for i in self.outputs:
            if self.degrees[i]:
                rows.append(chain[starts[i]] - values[i])
            elif measured is not None:
                rows.append(measured.value(i) - values[i])
        return ca.vertcat(*rows)


@dataclass(frozen=True, eq=False)
class Deflection:
    """The motion of compliant contacts, lambda = -k phi, that a wanted force lambda_d needs.

    A law that keeps phi'' + c phi' = 0 leaves phi'' + c phi' = A (lambda - lambda_d) there: a step
    of lambda_d makes the contact oscillate with sqrt(A k). With phi_d = -lambda_d / k and

        phi'' - phi_d'' + c (phi' - phi_d') = 0,    so    u for lambda_d + A^-1 (c lambda_d' +
                                                          lambda_d'') / k,

    the error e = phi - phi_d obeys e'' + c e' + A k e = 0 for any reference that is twice
    differentiable. A stiffness that is wrong by a factor s leaves |1 - s| of the oscillation.
    """

    stiffness: float
    damping: ca.DM
    inputs: dict[int, int]
    matrix: ca.SX
    more: tuple[int, ...]

    @classmethod
    def of(
        cls, structure: Structure, stiffness: float, damping: GainDesign | FeedbackGains | None
    ) -> "Deflection":
        system, size = structure.system, structure.system.num_constraints
        inputs = _force_outputs(system)[1]
        degrees = [structure.output_degrees[i] for i in inputs]
        if sorted(inputs.values()) != list(range(size)) or any(degrees) or not size:
            raise ModelError(
                f"{system.name}: a contact_stiffness is for robots with rigid joints whose "
                "constraint forces are all outputs; leave it out"
            )
        if any(degree != 2 for degree in structure.constraint_degrees):
            raise ModelError(
                f"{system.name}: a contact_stiffness is for contacts, and a constraint is on "
                "velocities; leave it out"
            )
        c = np.zeros((size, size))
        if damping is not None:
            c = damping_gains(structure, damping).matrix
        matrix = structure.elimination.constraint_matrix
        more = tuple(2 if i in inputs else 0 for i in range(system.num_outputs))
        return cls(positive("contact_stiffness", stiffness), ca.DM(c), inputs, matrix, more)

    def force(self, reference: ca.SX, layout: DerivativeLayout) -> ca.SX:
        """A^-1 (c lambda_d' + lambda_d'') / k of each output, shape (p, 1)."""
        rates = [ca.SX.zeros(len(self.inputs)) for _ in range(2)]
        for i, j in self.inputs.items():
            for order, rate in enumerate(rates, 1):
                rate[j] = reference[int(layout.lowest[i]) + order]
        push = ca.mtimes(self.damping, rates[0]) + rates[1]
        forces = Factorization(self.matrix).solve(push) / self.stiffness
        result = ca.SX.zeros(len(layout.degrees))
        for i, j in self.inputs.items():
            result[i] = forces[j]
        return result
