"""What the model of a law is for compliant contacts and sampled controls: damped, and late."""

from dataclasses import replace

import casadi as ca
import numpy as np

from drake_dae.dae.derivatives import Derivatives
from drake_dae.dae.elimination import eliminate
from drake_dae.dae.gains import FeedbackGains, GainDesign
from drake_dae.dae.signals import DerivativeLayout
from drake_dae.dae.structure import Structure
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import GainError, ModelError
from drake_dae.trace.expressions import result_of


def damped(
    structure: Structure, damping: GainDesign | FeedbackGains | None, latency: float = 0.0
) -> Structure:
    """Returns the structure of a law's model that demands, instead of y_i^(r_i) = 0,

        y_i^(r_i) + c_(r_i - 1) y_i^(r_i - 1) + ... + c_1 y_i' = 0,

    without a term in y_i itself, which would control the position of the surface instead of the
    force. On N* all y_i^(j) vanish, so that nothing changes there: alpha (13) becomes alpha - A^-1
    (sum_j c_j L_f^j k_i), beta (14), the degrees, A and B stay.

    If a force is an output of degree mu >= 1 (flexible joints, motors), the law differentiates
    alpha and takes the added term as constant: a compliant contact does not move as the model
    demands, so that the derivatives of the model would destabilize it (with force poles at -p and a
    contact of frequency w = sqrt(A k), for c > p already at mu = 1). Then for mu = 1 the contact is
    damped for all p; for mu = 2 and c from w to 2 w it is damped from about p = 2.5 w on, best near
    5 w. The force poles must be faster than the contact.
    """
    system = acting_late(structure.system, latency)
    if damping is None and system is structure.system:
        return structure
    layout = DerivativeLayout(structure.constraint_degrees)
    residual = structure.manifold.residual_expression
    force = ca.SX.zeros(len(structure.constraint_degrees))
    if damping is not None:
        gains = damping_gains(structure, damping)
        rates = residual[np.flatnonzero(layout.orders).tolist(), :]
        force = ca.mtimes(ca.sparsify(ca.DM(gains.matrix)), rates)
    derivatives = Derivatives(system, residual[layout.ends.tolist(), :], force)
    return _along(replace(structure, derivatives=derivatives), derivatives)


def damping_gains(structure: Structure, damping: GainDesign | FeedbackGains) -> FeedbackGains:
    """Returns the coefficients c of `damped`."""
    system = structure.system
    names = tuple(signal.name for signal in system.constraint_output_signals)
    degrees = tuple(degree - 1 for degree in structure.constraint_degrees)
    gains = damping
    if not isinstance(gains, FeedbackGains):
        gains = result_of("constraint_damping", gains, names, degrees, error=GainError)
    if not isinstance(gains, FeedbackGains) or (gains.names, gains.degrees) != (names, degrees):
        raise GainError(
            f"constraint_damping must be a design such as poles(-200.0) for the constraints "
            f"{', '.join(names) or 'none'} with r_i - 1 = {degrees} poles each"
        )
    return gains


def _along(structure: Structure, derivatives: Derivatives) -> Structure:
    """The output chains of known degrees along other derivatives."""
    system, degrees = structure.system, structure.output_degrees
    chains: list[list[ca.SX]] = [[] for _ in degrees]
    highest = ca.SX(len(degrees), 1)
    rows = list(range(len(degrees)))
    moving = system.outputs(derivatives.constraint_input)
    for order in range(max(degrees, default=0) + 1):
        values, _ = derivatives.by_control(moving)
        for row, i in enumerate(rows):
            if degrees[i] == order:
                highest[i] = moving[row]
            else:
                chains[i].append(values[row])
        remaining = [row for row, i in enumerate(rows) if degrees[i] > order]
        rows = [rows[row] for row in remaining]
        if rows:
            moving = derivatives.derivative(moving[remaining])
    drift, control_matrix = derivatives.by_control(highest)
    elimination = eliminate(derivatives)
    return replace(
        structure,
        elimination=replace(elimination, n_star=structure.elimination.n_star),
        output_chains=tuple(tuple(chain) for chain in chains),
        highest_derivatives=highest,
        drift=drift,
        control_matrix=control_matrix,
    )


def acting_late(system: DaeSystem, latency: float) -> DaeSystem:
    """The system as a sampled law sees it: its damping by the speed at which the control acts.

    A law compensates the damping -D v of its model with the measured v. A sampled control acts
    on average by the latency T later, delay + period / 2, when the speed is v + T v'. Hence

        M v' + D (v + T v') = u,    or    (M + T D) v' + D v = u,

    and the inertia M + T D takes the place of M. With M alone the joint moves as if it had M + T D
    while gains and integrals are computed for M: a light joint with T D / M = 30, as in the wrists
    of some arms, has errors that decay 30 times as slowly. Drake's discrete MultibodyPlant has the
    same matrix, with its step h in place of T, since its damping is implicit: it adds h / 2 to T.

    D is -df / dv without Coulomb friction at the nominal speeds, usually rest, and at any position:
    a contact with viscous friction damps several joints by one matrix J^T d J. v are the states
    that a force or a control drives. Those whose own damping, at the nominal state, is 0 or
    negative do not count.
    """
    if latency < 0.0:
        raise ModelError(f"the latency of a law must be 0 s or more, got {latency:g} s")
    damping = _viscous_damping(system) if latency else None
    if damping is None:
        return system
    added, inner = latency * damping, system.implicit

    def implicit(rate: ca.SX, constraint_input: ca.SX) -> tuple[ca.SX, ca.SX]:
        assert inner is not None
        balance, constraint_rate = inner(rate, constraint_input)
        return balance + ca.mtimes(added, rate), constraint_rate

    return replace(
        system,
        mass_matrix=system.mass_matrix + added,
        implicit=None if inner is None else implicit,
        state_scale=system.scale,
    )


def _viscous_damping(system: DaeSystem) -> ca.SX | None:
    """D of `acting_late`, shape (n, n); None if it is 0."""
    n, state, symbols = system.num_states, system.state, system.parameter_symbol
    driven = ca.horzcat(system.g, system.h, system.mass_matrix - ca.SX.eye(n))
    rows = [i for i in range(n) if ca.sparsify(driven[i, :]).nnz()]
    slopes = -ca.jacobian(system.f[rows, :], state[rows, :])
    dry = [parameter.symbol for parameter in system.parameters if parameter.name in system.dry]
    constants = ca.vertcat(state[rows, :], *dry)
    values = ca.vertcat(ca.DM(system.nominal_state[rows]), ca.DM.zeros(len(dry)))
    slopes = ca.sparsify(ca.substitute(slopes, constants, values))
    function = ca.Function("damping", [state, symbols], [ca.diag(slopes)])
    found = function(system.nominal_state, system.parameter_values).full().ravel()
    kept = np.flatnonzero(np.isfinite(found) & (found > 0.0)).tolist()
    if not kept:
        return None
    damping, places = ca.SX(n, n), [rows[i] for i in kept]
    damping[places, places] = slopes[kept, kept]
    return ca.sparsify(damping)
