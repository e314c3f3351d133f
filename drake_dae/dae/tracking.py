"""The tracking law, with or without measured force.            (28), (29), (59), (71), (81)"""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arrays import FloatArray
from drake_dae.dae.gains import FeedbackGains, GainDesign
from drake_dae.dae.structure import Structure, find_structure
from drake_dae.dae.system import DaeSystem, check_is_system
from drake_dae.errors import GainError, ModelError
from drake_dae.trace.factorization import Factorization
from drake_dae.trace.functions import TracedFunction


class TrackingLaw:
    """The law (28), which makes the controlled outputs follow a reference:

        u(x, R) = B(x)^-1 (-a(x) + ubar),
        ubar_i = r_i^(mu_i) - sum_j K_ij (L_f*^(j-1) l*_i - r_i^(j-1)),

    with ubar_i = r_i where mu_i = 0. In closed loop the errors e_i = z_i - r_i (29) obey (30), (31)
    exactly. The law needs the state x; it needs no measurement of the constraint inputs.

    The reference is output-major: r_1, r_1', ..., r_1^(mu_1), r_2, ...; it holds sum (mu_i + 1)
    numbers.

    With measured force, outputs z_i = v_j are fed back from a measurement of v as well:

        mu_i = 0: r_2 - Gbar (v - r_2) takes the place of r_2, which is the term J^T Gbar
            (lambda - r_2) of (59). The force error of a wrong model shrinks to 1 / (1 + Gbar).
        mu_i >= 1: v takes the place of the model's l*_i, as (71) and (81) allow.

    In a diagram the measurement needs a sensor with state where mu_i = 0; see `ForceSensor`.

    Args:
        system: (1)-(3).
        gains: A design such as `poles(-4.0)`, or finished gains.
        structure: If it is known already; found otherwise.
        measured_force: Whether the law takes a measurement of v.
        force_gain: Gbar of (59) for the outputs with mu_i = 0, a number or shape (m, m), positive
            semidefinite; only with measured_force.

    Raises:
        AssumptionError: The system violates an assumption of the theory.
        GainError: The gains do not fit, or are not Hurwitz.
        ModelError: No DaeSystem; the structure is that of another system; or measured force, and
            no output is a constraint input.
    """

    def __init__(
        self,
        system: DaeSystem,
        gains: GainDesign | FeedbackGains,
        structure: Structure | None = None,
        measured_force: bool = False,
        force_gain: ArrayLike = 0.0,
    ) -> None:
        check_is_system(system, "TrackingLaw")
        self.system = system
        self.structure = structure or find_structure(system)
        if self.structure.system is not system:
            raise ModelError(
                f"{system.name}: the given structure is that of another system, "
                f"{self.structure.system.name}; find it for this one"
            )
        degrees = self.structure.output_degrees
        names = tuple(signal.name for signal in system.output_signals)
        if not (isinstance(gains, FeedbackGains) or callable(gains)):
            raise GainError(f"gains must be a design such as poles(-4.0), got {gains!r}")
        self.gains = gains if isinstance(gains, FeedbackGains) else gains(names, degrees)
        if (self.gains.names, self.gains.degrees) != (names, degrees):
            raise GainError(
                f"the gains are for the outputs {', '.join(self.gains.names)} with degrees "
                f"{self.gains.degrees}, the system has {', '.join(names)} with {degrees}"
            )
        self.reference_signals = tuple(
            signal.derivative(order)
            for signal, degree in zip(system.output_signals, degrees, strict=True)
            for order in range(degree + 1)
        )
        reference = ca.SX.sym("R", len(self.reference_signals))
        # Only where it is not zero: the errors of most outputs are not coupled.
        pattern = ca.sparsify(ca.DM(self.gains.matrix)).sparsity()
        gain = ca.SX.sym("K", pattern)
        starts = np.cumsum([0, *[degree + 1 for degree in degrees]])
        nominal = reference[starts[:-1].tolist()]
        highest = reference[(starts[1:] - 1).tolist()]
        chains = [list(chain) for chain in self.structure.output_chains]

        def errors() -> ca.SX:
            return ca.vertcat(
                ca.SX(0, 1),
                *[
                    element - reference[start + j]
                    for chain, start in zip(chains, starts, strict=False)
                    for j, element in enumerate(chain)
                ],
            )

        coordinates = errors()
        self.measured_force = measured_force
        self.force_gain = _force_gain(force_gain, system.num_constraints)
        if self.force_gain.any() and not measured_force:
            raise GainError("force_gain needs measured_force=True")
        measurement = ca.SX.sym("v", system.num_constraints if measured_force else 0)
        if measured_force:
            forces = _force_outputs(system)
            missing = ca.SX(measurement.numel(), 1)
            for i, j in forces.items():
                missing[j] = measurement[j] - nominal[i]
            for i, j in forces.items():
                if degrees[i] and self.force_gain[j].any():
                    raise GainError(
                        f"force_gain is for outputs that the law meets at once; '{names[i]}' has "
                        f"degree {degrees[i]} and takes the measured force itself. Leave it 0"
                    )
                if degrees[i]:
                    chains[i][0] = measurement[j]
                else:
                    highest[i] -= ca.mtimes(ca.DM(self.force_gain[j : j + 1]), missing)
        wanted = highest - ca.mtimes(gain, errors())
        found = self.structure.motion.inverse(self.structure.highest_derivatives, wanted)
        if found is None:  # L_h* of an output vanishes, but not by structure.
            factors = Factorization(self.structure.control_matrix)
            found = factors.solve(wanted - self.structure.drift), factors.pivot
        control, pivot = found
        if self.structure.chains_need_force:
            pivot = ca.fmin(pivot, self.structure.elimination.pivot)
        # What the control reaches at once is as wanted.
        output = ca.vertcat(
            *[
                chain[0] if chain else wanted[i]
                for i, chain in enumerate(self.structure.output_chains)
            ]
        )
        inputs = {
            "state": system.state,
            "reference": reference,
            "measured_force": measurement,
            "parameters": ca.vertcat(system.parameter_symbol, *gain.nonzeros()),
        }
        if not measured_force:
            del inputs["measured_force"]
        self.function = TracedFunction(
            f"{system.name} tracking law",
            inputs,
            {
                "control": control,
                "tracking_error": output - nominal,
                "pivot": pivot,
            },
        )
        self._coordinates = TracedFunction(
            f"{system.name} error coordinates",
            {
                "state": system.state,
                "reference": reference,
                "parameters": system.parameter_symbol,
            },
            {"coordinates": coordinates},
            often=False,
        )

    @property
    def degrees(self) -> tuple[int, ...]:
        """mu_1, ..., mu_p: how many derivatives of each reference the law needs."""
        return self.structure.output_degrees

    def control(
        self,
        state: ArrayLike,
        reference: ArrayLike,
        parameters: ArrayLike | None = None,
        measured_force: ArrayLike | None = None,
    ) -> FloatArray:
        """u(x, R) of (28).

        Args:
            state: x, shape (n,).
            reference: R, shape (sum (mu_i + 1),), output-major.
            parameters: Values of all parameters; the defaults if None.
            measured_force: v, shape (m,); exactly where the law takes it.

        Returns:
            Shape (p,).
        """
        measured = [] if measured_force is None else [measured_force]
        return self.function(state, reference, *measured, self.parameter_values(parameters))[0]

    def parameter_values(self, parameters: ArrayLike | None = None) -> FloatArray:
        """What `function` takes: all parameters of the system, then K's nonzeros by columns."""
        values = self.system.parameter_values if parameters is None else parameters
        gains = self.gains.matrix.T
        return np.concatenate([np.asarray(values, float), gains[gains != 0.0]])

    def error_coordinates(
        self, state: ArrayLike, reference: ArrayLike, parameters: ArrayLike | None = None
    ) -> FloatArray:
        """(e_1, e_1', ..., e_p^(mu_p - 1)), shape (sum mu_i,): the initial value of (30)."""
        values = self.system.parameter_values if parameters is None else parameters
        return self._coordinates(state, reference, values)[0]

    def predicted_error(
        self,
        times: ArrayLike,
        state: ArrayLike,
        reference: ArrayLike,
        parameters: ArrayLike | None = None,
    ) -> FloatArray:
        """The error that theory predicts after a start from a state, shape (k, p).

        Args:
            times: In s after the start, shape (k,).
            state: At the start, shape (n,).
            reference: R at the start.
            parameters: Values of all parameters; the defaults if None.
        """
        return self.gains.error_response(
            np.asarray(times, dtype=float), self.error_coordinates(state, reference, parameters)
        )


def _force_gain(value: ArrayLike, size: int) -> FloatArray:
    """Gbar as a matrix that is positive semidefinite."""
    try:
        gain = np.array(value, dtype=float)
    except (TypeError, ValueError):
        raise GainError(f"force_gain must be numbers, got {value!r}") from None
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


def _force_outputs(system: DaeSystem) -> dict[int, int]:
    """Output index -> constraint input index, for the outputs z_i = v_j."""
    found = {}
    for i in range(system.num_controls):
        row = ca.sparsify(system.m[i, :])
        if row.nnz() == 1 and system.l[i].is_zero():
            j = row.sparsity().get_triplet()[1][0]
            if row[j].is_one():
                found[i] = j
    if not found:
        raise ModelError(
            f"{system.name}: measured_force needs an output that is a constraint input, z_i = v_j"
        )
    return found
