"""The damping of a system under a control that acts later than its state was measured."""

from dataclasses import replace

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.system import DaeSystem
from drake_dae.errors import ModelError


def acting_late(system: DaeSystem, latency: float) -> DaeSystem:
    """The system as a sampled law sees it: its damping by the speed at which the control acts.

    A law compensates the damping -d v of its model with the measured v. A sampled control acts
    on average by the latency T later, delay + period / 2, when the speed is v + T v'. Hence

        M v' + d (v + T v') = u,    or    (M + T d) v' + d v = u,

    and the inertia M + T d takes the place of M. With M alone the joint moves as if it had M + T d
    while gains and integrals are computed for M: a light joint with T d / M = 30, as in the wrists
    of some arms, has errors that decay 30 times as slowly. Drake's discrete MultibodyPlant has the
    same matrix, with its step in place of T, since its damping is implicit.

    d_i is -df_i / dx_i at the nominal state, without Coulomb friction, of each state that a force
    or a control drives, and 0 where that is negative.

    Args:
        system: The system of a law.
        latency: T in s; 0 for a law that acts at once.

    Returns:
        The system with E + T diag(d) in place of E; itself if that is the same.

    Raises:
        ModelError: The latency is negative.
    """
    if latency < 0.0:
        raise ModelError(f"the latency of a law must be 0 s or more, got {latency:g} s")
    added = latency * _damping(system) if latency else np.zeros(system.num_states)
    if not added.any():
        return system
    inner = system.implicit

    def implicit(rate: ca.SX, constraint_input: ca.SX) -> tuple[ca.SX, ca.SX]:
        assert inner is not None
        balance, constraint_rate = inner(rate, constraint_input)
        return balance + ca.SX(added) * rate, constraint_rate

    return replace(
        system,
        mass_matrix=system.mass_matrix + ca.diag(ca.sparsify(ca.DM(added))),
        implicit=None if inner is None else implicit,
        factorize=None,
        state_scale=system.scale,
    )


def _damping(system: DaeSystem) -> FloatArray:
    """d of each state, shape (n,)."""
    n = system.num_states
    driven = ca.horzcat(system.g, system.h, system.mass_matrix - ca.SX.eye(n))
    rows = [i for i in range(n) if ca.sparsify(driven[i, :]).nnz()]
    slopes = ca.SX(n, 1)
    for i in rows:
        slopes[i] = -ca.gradient(system.f[i], system.state[i])
    values = {name: 0.0 for name in system.dry}
    parameters = system.with_values(values).parameter_values if values else system.parameter_values
    function = ca.Function("damping", [system.state, system.parameter_symbol], [slopes])
    found = function(system.nominal_state, parameters).full().ravel()
    return np.maximum(np.where(np.isfinite(found), found, 0.0), 0.0)
