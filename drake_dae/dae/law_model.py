"""What a law has besides (28): damped and late models, measured forces, integrals, deflection."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import islice

import casadi as ca
import numpy as np

from drake_dae.arrays import positive
from drake_dae.dae.derivatives import Derivatives, eliminate
from drake_dae.dae.gains import FeedbackGains, GainDesign, designed
from drake_dae.dae.signals import DerivativeLayout, Signal, places_of
from drake_dae.dae.structure import Structure
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import GainError, ModelError


def law_structure(
    structure: Structure,
    damping: GainDesign | FeedbackGains | None,
    latency: float = 0.0,
    deflection: "Deflection | None" = None,
) -> Structure:
    """Returns the structure of a law's model that demands, instead of y_i^(r_i) = 0,

        y_i^(r_i) + c_(r_i - 1) y_i^(r_i - 1) + ... + c_1 y_i' = 0, or the symbol of a deflection,

    without a term in y_i itself, which would control the position of the surface instead of the
    force. On N* nothing changes: alpha (13) becomes alpha - A^-1 (sum_j c_j L_f^j k_i), and beta
    (14), the degrees, A and B stay. For a force of degree mu >= 1 the added term is taken as
    constant: its derivatives would destabilize a compliant contact, which moves otherwise.
    """
    system = acting_late(structure.system, latency)
    if damping is None and deflection is None and system is structure.system:
        return structure
    layout = DerivativeLayout(structure.constraint_degrees)
    residual = structure.manifold.residual_expression
    force = ca.SX.zeros(len(structure.constraint_degrees))
    if damping is not None:
        rates = residual[np.flatnonzero(layout.orders).tolist(), :]
        force = ca.mtimes(ca.sparsify(ca.DM(damping_gains(structure, damping).matrix)), rates)
    if deflection is not None:
        force = force - deflection.symbol
    derivatives = Derivatives(system, residual[layout.ends.tolist(), :], force)
    # The output chains of the same degrees along these derivatives.
    highest, moving = list[ca.SX](), [ca.SX(0, 1)]
    outputs = system.outputs(derivatives.constraint_input)
    for row, degree in zip(ca.vertsplit(outputs), structure.output_degrees, strict=True):
        for _ in range(degree):
            moving.append(row)
            row = derivatives.derivative(row)
        highest.append(row)
    values = iter(ca.vertsplit(derivatives.by_control(ca.vertcat(*moving))[0]))
    chains = tuple(tuple(islice(values, degree)) for degree in structure.output_degrees)
    drift, control_matrix = derivatives.by_control(ca.vertcat(*highest))
    return replace(
        structure,
        derivatives=derivatives,
        elimination=replace(eliminate(derivatives), n_star=structure.elimination.n_star),
        output_chains=chains,
        highest_derivatives=ca.vertcat(*highest),
        drift=drift,
        control_matrix=control_matrix,
    )


def damping_gains(structure: Structure, damping: GainDesign | FeedbackGains) -> FeedbackGains:
    """Returns the coefficients c of `law_structure`: r_i - 1 poles for each constraint."""
    names = tuple(signal.name for signal in structure.system.constraint_output_signals)
    degrees = tuple(degree - 1 for degree in structure.constraint_degrees)
    return designed("constraint_damping", damping, names, degrees)


def acting_late(system: DaeSystem, latency: float) -> DaeSystem:
    """The system as a sampled law sees it: its damping by the speed at which the control acts.

    A sampled control acts on average by the latency T later, delay + (period + step) / 2 with the
    step of a plant, when the speed is v + T v'. Hence the damping -D v of the model, which a law
    compensates with the measured v, is

        M v' + D (v + T v') = u,    or    (M + T D) v' + D v = u.

    With M alone the errors of a light joint with T D / M = 30, as in the wrists of some arms, decay
    30 times as slowly as designed. D is -df / dv without Coulomb friction at the nominal speeds, at
    any position; v are the states that a force or a control drives, with a positive damping there.
    """
    if latency < 0.0:
        raise ModelError(f"the latency of a law must be 0 s or more, got {latency:g} s")
    if not latency:
        return system
    n, state = system.num_states, system.state
    driven = ca.horzcat(system.g, system.h, system.mass_matrix - ca.SX.eye(n))
    rows = [i for i in range(n) if ca.sparsify(driven[i, :]).nnz()]
    slopes = -ca.jacobian(system.f[rows, :], state[rows, :])
    dry = [parameter.symbol for parameter in system.parameters if parameter.name in system.dry]
    constants = ca.vertcat(state[rows, :], *dry)
    values = ca.vertcat(ca.DM(system.nominal_state[rows]), ca.DM.zeros(len(dry)))
    slopes = ca.sparsify(ca.substitute(slopes, constants, values))
    function = ca.Function("damping", [state, system.parameter_symbol], [ca.diag(slopes)])
    found = function(system.nominal_state, system.parameter_values).full().ravel()
    kept = np.flatnonzero(np.isfinite(found) & (found > 0.0)).tolist()
    if not kept:
        return system
    damping, places = ca.SX(n, n), [rows[i] for i in kept]
    damping[places, places] = slopes[kept, kept]
    added = latency * ca.sparsify(damping)
    return replace(
        system,
        mass_matrix=system.mass_matrix + added,
        implicit=system.implicit_with(lambda rate: ca.mtimes(added, rate)),
        state_scale=system.scale,
    )


class ForceMeasurement:
    """The measurement of v in the law (28), for outputs z_i that are one v_j or combinations m_i v:

    mu_i = 0:  ubar_i = r_i - Gbar (z_i - r_i), the term J^T Gbar (lambda - r_2) of (59). The
        force error of a wrong model shrinks to 1 / (1 + Gbar).
    mu_i >= 1: z_i takes the place of the model's l*_i, as (71) and (81) allow.
    """

    def __init__(self, system: DaeSystem, layout: DerivativeLayout, gain: float) -> None:
        if system.sharing is not None:
            raise ModelError(
                f"{system.name}: measured_force is not supported for redundant constraints that "
                "share their forces; leave them out with `drop_constraints`, or use the law's "
                "own force"
            )
        if not gain >= 0.0:
            raise GainError(
                "force_gain, Gbar of (59), must be 0 or more: a negative one feeds the force error "
                f"back with the wrong sign, got {gain:g}"
            )
        self.layout, self.gain, self.rows = layout, gain, _force_outputs(system)
        self.symbol = ca.SX.sym("v", system.num_constraints)
        late = [system.output_signals[i].name for i in self.rows if layout.degrees[i]]
        if late and gain:
            raise GainError(
                f"force_gain is for outputs of degree 0; {', '.join(late)} take the measured "
                "force itself. Leave it 0"
            )

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
        """Returns the highest derivatives of the reference, less Gbar (z - r) where mu_i = 0."""
        result = ca.SX(highest)
        for i in self.rows:
            if not self.layout.degrees[i]:
                result[i] -= self.gain * (self.value(i) - values[i])  # (59)
        return result


def _force_outputs(system: DaeSystem) -> dict[int, ca.SX]:
    """The outputs z_i = m_i v, as i -> m_i."""
    rows = {i: ca.sparsify(system.m[i, :]) for i in range(system.num_outputs)}
    found = {i: row for i, row in rows.items() if row.nnz() and system.l[i].is_zero()}
    if not found:
        raise ModelError(
            f"{system.name}: measured_force needs an output that is a constraint input or a "
            "combination of some"
        )
    return found


class IntegralAction:
    """The integrals sigma_i' = z_i - r_i of some outputs, which extend (30) to

        e_i^(mu_i) = -K_i0 sigma_i - K_i1 e_i - ... - K_i mu_i e_i^(mu_i - 1),

    so that an output has mu_i + 1 poles in place of mu_i. If mu_i = 0 it is the integral of a
    measured force: ubar_i = r_i - K_i0 int (z_i - r_i) dt. With a constant model error, e_i tends
    to zero.
    """

    def __init__(
        self,
        system: DaeSystem,
        degrees: Sequence[int],
        names: Sequence[str],
        measured: ForceMeasurement | None,
    ) -> None:
        chosen = places_of("output", names, system.output_signals, "integral: ")
        for i, name in zip(chosen, names, strict=True):
            if chosen.count(i) > 1:
                raise GainError(f"integral: '{name}' occurs twice")
            if degrees[i] == 0 and (measured is None or i not in measured.rows):
                raise GainError(
                    f"integral: by the model the law attains '{name}' without delay, so there is "
                    "no error to integrate; make the law with measured_force=True, and integrate "
                    "a constraint input or a combination of some"
                )
        self.outputs, self.degrees, self._measured = sorted(chosen), degrees, measured
        self._starts = DerivativeLayout(degrees).starts.tolist()
        signals = [system.output_signals[i] for i in self.outputs]
        named = [Signal(f"integral of {s.name}", f"{s.unit or '1'} s") for s in signals]
        self.signals = tuple(named)
        self.symbol = ca.SX.sym("integral", len(self.outputs))

    def coordinates(self, errors: ca.SX) -> ca.SX:
        """Returns the error coordinates, with the integrals among them."""
        rows = [ca.SX(0, 1)]
        for i, (start, degree) in enumerate(zip(self._starts, self.degrees, strict=True)):
            if i in self.outputs:
                rows.append(self.symbol[self.outputs.index(i)])
            rows.append(errors[start : start + degree, :])
        return ca.vertcat(*rows)

    def rate(self, chain: ca.SX, values: ca.SX) -> ca.SX:
        """Returns sigma' = z - r of these outputs, shape (k, 1)."""
        rows = [ca.SX(0, 1)]
        for i in self.outputs:
            if self.degrees[i]:
                rows.append(chain[self._starts[i]] - values[i])
            elif self._measured is not None:
                rows.append(self._measured.value(i) - values[i])
        return ca.vertcat(*rows)


class Deflection:
    """The motion of compliant contacts, lambda = -k phi, that a wanted force lambda_d needs.

    A law that keeps phi'' + c phi' = 0 lets a step of lambda_d make the contact oscillate with
    sqrt(A k). With phi_d = -lambda_d / k its model demands instead

        phi'' + c phi' = phi_d'' + c phi_d' = -(lambda_d'' + c lambda_d') / k,

    so that e = phi - phi_d obeys e'' + c e' + A k e = 0, and friction is that of lambda_d. A
    stiffness that is wrong by a factor s leaves |1 - s| of the oscillation. `symbol` stands for the
    right side, and is zero on N*.
    """

    def __init__(
        self, structure: Structure, stiffness: float, damping: GainDesign | FeedbackGains | None
    ) -> None:
        system, size = structure.system, structure.system.num_constraints
        self.stiffness = positive("contact_stiffness", stiffness)
        # The outputs z_i = v_j, as i -> j.
        self.inputs = {
            i: columns[0]
            for i, row in _force_outputs(system).items()
            if len(columns := row.sparsity().get_triplet()[1]) == 1 and row[columns[0]].is_one()
        }
        degrees = [structure.output_degrees[i] for i in self.inputs]
        if sorted(self.inputs.values()) != list(range(size)) or any(degrees) or not size:
            raise ModelError(
                f"{system.name}: a contact_stiffness is for robots with rigid joints whose "
                "constraint forces are all outputs; leave it out"
            )
        if any(degree != 2 for degree in structure.constraint_degrees):
            raise ModelError(
                f"{system.name}: a contact_stiffness is for contacts, and a constraint is on "
                "velocities; leave it out"
            )
        c = np.zeros((size, size)) if damping is None else damping_gains(structure, damping).matrix
        self._damping, self.symbol = ca.DM(c), ca.SX.sym("deflection", size)

    def wanted(self, reference: ca.SX, layout: DerivativeLayout) -> ca.SX:
        """-(lambda_d'' + c lambda_d') / k of each constraint, shape (m, 1)."""
        places = layout.lowest[sorted(self.inputs, key=self.inputs.__getitem__)]
        first, second = reference[(places + 1).tolist()], reference[(places + 2).tolist()]
        return -(second + ca.mtimes(self._damping, first)) / self.stiffness
