"""A start is made consistent with the least kinetic energy, whatever the units."""

import casadi as ca
import numpy as np
import pytest

from drake_dae.dae import DaeSystem, Manifold, find_constraint_structure


def rod_between_masses(masses=(1.0, 1e4), lengths=(1.0, 1.0)) -> Manifold:
    """Two bodies in the plane at a fixed distance; lengths are the units of their coordinates."""
    x = ca.SX.sym("x", 8)
    q, v = x[:4], x[4:]
    first, second = lengths[0] * q[:2], lengths[1] * q[2:]
    k = ca.sumsqr(first - second) - 1.0
    units = np.repeat(lengths, 2)
    inertia = np.diag(np.repeat(masses, 2) * units**2)
    system = DaeSystem(
        state=x,
        mass_matrix=ca.diagcat(ca.SX.eye(4), ca.SX(inertia)),
        f=ca.vertcat(v, ca.SX(4, 1)),
        g=ca.vertcat(ca.SX(4, 1), ca.jacobian(k, q).T),
        h=ca.SX(8, 0),
        k=k,
        l=ca.SX(0, 1),
        m=ca.SX(0, 1),
        nominal_state=np.array([0.0, 0.0, 0.6, 0.8, 1.0, 2.0, 1.0, 2.0]) / np.tile(units, 2),
    )
    return find_constraint_structure(system).manifold


@pytest.mark.parametrize("lengths", [(1.0, 1.0), (1e-6, 1e2)])
def test_what_is_heavy_stays_in_any_units(lengths):
    """A rod that is too long by 2e-6 m: of it the body of 1 kg moves 1e4 times as far."""
    manifold = rod_between_masses(lengths=lengths)
    units = np.tile(np.repeat(lengths, 2), 2)
    along = np.array([0.6, 0.8])
    start = np.array(
        [0.0, 0.0, *((1.0 + 2e-6) * along), 1.0, 2.0, *(np.array([1, 2]) + 3e-6 * along)]
    )
    found = units * manifold.settle(start / units)
    share = 1e4 / (1.0 + 1e4)
    moved = np.array([*(2e-6 * share * along), *(-2e-6 * (1.0 - share) * along)])
    np.testing.assert_allclose(found[:4] - start[:4], moved, rtol=0, atol=1e-11)
    turned = np.array([*(3e-6 * share * along), *(-3e-6 * (1.0 - share) * along)])
    np.testing.assert_allclose(found[4:] - start[4:], turned, rtol=0, atol=1e-11)
    assert manifold.is_consistent(found / units)
    np.testing.assert_allclose(manifold.residual(found / units), 0.0, atol=1e-14)
