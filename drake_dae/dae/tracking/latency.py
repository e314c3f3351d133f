"""The damping of a system under a control that acts later than its state was measured."""

from dataclasses import replace

import casadi as ca
import numpy as np

from drake_dae.dae.system.system import DaeSystem
from drake_dae.errors import ModelError


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
    damping = _damping(system) if latency else None
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
        factorize=None,
        state_scale=system.scale,
    )


def _damping(system: DaeSystem) -> ca.SX | None:
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
