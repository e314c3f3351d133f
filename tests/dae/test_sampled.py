"""The poles of sampled laws, against maps by hand."""

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose

from drake_dae import DaeSystem, TrackingLaw, poles
from drake_dae.dae import sampled_poles
from drake_dae.errors import ModelError

T = 0.05


def mass_on_a_spring(stiffness: float) -> DaeSystem:
    """x'' = -k x + u, z = x."""
    x, none = ca.SX.sym("x", 2), ca.SX(0, 1)
    f = ca.vertcat(x[1], -stiffness * x[0])
    return DaeSystem(x, f, ca.SX(2, 0), ca.SX([0, 1]), none, x[0], ca.SX(1, 0))


@pytest.mark.parametrize("delay", [0.0, 0.3 * T, T, 2.6 * T])
def test_poles_of_a_mass_are_those_of_the_map_by_hand(delay):
    """x'' = u: x_(k+1) is a polynomial of what is held, u = -w^2 x - 2 w x' of earlier samples."""
    w = 4.0
    late = int(delay / T + 1e-9)
    rest = delay - late * T
    gain = -np.array([w * w, 2.0 * w])
    matrix = np.zeros((2 * (late + 2), 2 * (late + 2)))
    matrix[2:, :-2] = np.eye(2 * (late + 1))
    matrix[:2, :2] = [[1.0, T], [0.0, 1.0]]
    newer = np.array([(T - rest) ** 2 / 2, T - rest])
    older = np.array([rest**2 / 2 + rest * (T - rest), rest])
    matrix[:2, 2 * late : 2 * late + 2] += np.outer(newer, gain)
    matrix[:2, 2 * late + 2 :] += np.outer(older, gain)
    found = sampled_poles(TrackingLaw(mass_on_a_spring(0.0), poles(-w)), np.zeros(3), T, delay)
    expected = np.linalg.eigvals(matrix)
    # A double pole moves by the root of round-off.
    assert_allclose(np.poly(found), np.poly(expected), atol=1e-12)


def test_laws_with_a_state_of_their_own_are_refused():
    system = mass_on_a_spring(0.0)
    chosen = TrackingLaw(system, poles(-4.0), integral=[system.output_signals[0].name])
    with pytest.raises(ModelError, match="integral"):
        sampled_poles(chosen, np.zeros(3), T)
    with pytest.raises(ModelError, match="delay"):
        sampled_poles(TrackingLaw(system, poles(-4.0)), np.zeros(3), T, -1.0)
