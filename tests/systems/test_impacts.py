"""Which contacts push: complementarity by its own conditions, and what impacts do to energy."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from drake_dae.systems.unilateral.impacts import (
    Touch,
    complementary,
    is_p_matrix,
    rows_of,
    stopping,
)


def rows(*numbers):
    return np.array(numbers, dtype=int)


TOUCHES = [Touch(i, rows(i)) for i in range(1, 5)]


@pytest.mark.parametrize("seed", range(20))
def test_what_fits_is_complementary(seed):
    """Row 0 is kept, the others are contacts."""
    random = np.random.default_rng(seed)
    root, b = random.standard_normal((5, 7)), random.standard_normal(5)
    A = root @ root.T
    fit = complementary(A, b, rows(0), TOUCHES)
    w = A @ fit.values + b
    assert abs(w[0]) < 1e-10
    for place, touch in enumerate(TOUCHES):
        if place in fit.pushing:
            assert fit.values[touch.normal] > 0.0
            assert_allclose(w[touch.rows], 0.0, atol=1e-10)
        else:
            assert w[touch.normal] > 0.0
            assert_allclose(fit.values[touch.rows], 0.0, atol=0.0)


@pytest.mark.parametrize("seed", range(20))
def test_an_impact_gains_no_energy_and_pierces_nothing(seed):
    """c+ = c- + A Lambda with coefficients of restitution of each contact; it changes by
    Lambda . (c- + c+) / 2. Four contacts of three freedoms depend on each other."""
    random = np.random.default_rng(seed)
    J = np.column_stack([np.ones(4), random.uniform(-1.0, 1.0, (4, 2))])
    before = J @ np.array([-1.0, *random.uniform(-0.5, 0.5, 2)])
    e = random.uniform(0.0, 1.0, 4)
    fit = complementary(J @ J.T, (1.0 + e) * before, rows(), [Touch(i, rows(i)) for i in range(4)])
    after = before + J @ J.T @ fit.values
    assert np.all(after >= -1e-10)
    assert fit.values @ (before + after) <= 1e-12


def test_of_a_table_with_four_feet_two_carry_it_and_it_comes_to_rest():
    """A body on feet at (+-1, +-1): any three normals are independent, all four are not."""
    feet = np.array([[1.0, x, y] for x in (-1.0, 1.0) for y in (-1.0, 1.0)])
    A = feet @ feet.T
    touches = [Touch(i, rows(i)) for i in range(4)]
    fit = complementary(A, np.full(4, -1.0), rows(), touches)
    assert_allclose(A @ fit.values, 1.0, rtol=1e-14)
    assert len(fit.pushing) == 2
    assert rows_of(A, rows(), touches) is None
    assert rows_of(A, rows(), touches[:3]).tolist() == [0, 1, 2]
    # Two feet that stick need one of their tangential rows.
    J = np.array([[1.0, -1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    pair = [Touch(0, rows(0, 1)), Touch(2, rows(2, 3))]
    assert rows_of(J @ J.T, rows(), pair).tolist() == [0, 2, 1]
    stopped = stopping(J @ J.T, np.array([-1.0, 0.3, -1.0, 0.3]), rows(0, 1, 2, 3))
    assert_allclose(J @ J.T @ stopped, [1.0, -0.3, 1.0, -0.3], atol=1e-14)


def test_friction_may_leave_none_or_two():
    turned, smooth = np.diag([-1.0, 2.0]), np.diag([1.0, 2.0])
    assert is_p_matrix(smooth, smooth, [0, 1])
    assert not is_p_matrix(turned, smooth, [0, 1])
    assert complementary(turned, np.array([-1.0, 1.0]), rows(), TOUCHES[:0]) is not None
    touches = [Touch(0, rows(0)), Touch(1, rows(1))]
    assert complementary(turned, np.array([-1.0, 1.0]), rows(), touches) is None
