"""Least squares over a chain against one dense system of all unknowns."""

import numpy as np
import pytest

from drake_dae.studies.identification.chain import StateChain

STATES, COMMON, LAST = 3, 2, 5


def random_chain(seed, growth=1.0):
    random = np.random.default_rng(seed)
    own = random.normal(size=(LAST + 1, 7, STATES + COMMON + 1))
    moves = random.normal(size=(LAST, STATES, STATES + COMMON + 1))
    moves[:, :, :STATES] *= growth
    loose = np.array([0.1, 1.0, 0.3]) * random.uniform(0.5, 2.0, (LAST, 1))
    return own, moves, loose, np.array([1.0, 10.0, 2.0])


def dense(own, moves, loose, weak):
    """All rows over (dz_0, ..., dz_J, dtheta), and the right-hand side."""
    total = (LAST + 1) * STATES + COMMON
    rows = []
    for j, block in enumerate(own):
        row = np.zeros((len(block), total + 1))
        row[:, j * STATES : (j + 1) * STATES] = block[:, :STATES]
        row[:, -COMMON - 1 :] = block[:, STATES:]
        rows.append(row)
    for j, block in enumerate(moves):
        row = np.zeros((STATES, total + 1))
        row[:, j * STATES : (j + 1) * STATES] = block[:, :STATES]
        row[:, (j + 1) * STATES : (j + 2) * STATES] = -np.eye(STATES)
        row[:, -COMMON - 1 :] = block[:, STATES:]
        rows.append(row / loose[j][:, None])
    first = np.zeros((STATES, total + 1))
    first[:, :STATES] = np.diag(1.0 / weak)
    every = np.vstack([*rows, first])
    return every[:, :-1], -every[:, -1]


@pytest.mark.parametrize("growth", [1.0, 3.0])
def test_a_chain_gives_what_all_equations_together_give(growth):
    given = random_chain(0, growth)
    matrix, right = dense(*given)
    expected = np.linalg.lstsq(matrix, right, rcond=None)[0]
    chain = StateChain.of(*given)
    theta = np.linalg.solve(chain.common[:, :COMMON], -chain.common[:, COMMON])
    states, along = chain.states(theta)
    # Both are backward stable; the conditions are below 1e4.
    np.testing.assert_allclose(theta, expected[-COMMON:], rtol=1e-10)
    np.testing.assert_allclose(states.ravel(), expected[:-COMMON], rtol=1e-9, atol=1e-11)
    # The information about theta is that of the whole system, and states follow it as they must.
    covariance = np.linalg.inv(matrix.T @ matrix)[-COMMON:, -COMMON:]
    factor = chain.common[:, :COMMON]
    np.testing.assert_allclose(np.linalg.inv(factor.T @ factor), covariance, rtol=1e-8)
    ahead, _ = chain.states(theta + np.array([1.0, -2.0]))
    np.testing.assert_allclose(ahead - states, along @ np.array([1.0, -2.0]), atol=1e-9)


def test_states_that_nothing_is_known_about_do_no_harm():
    own, moves, loose, weak = random_chain(1)
    own[:, :, 1] = 0.0
    moves[:, :, 1] = 0.0
    matrix, right = dense(own, moves, loose, weak)
    expected = np.linalg.lstsq(matrix, right, rcond=None)[0]
    chain = StateChain.of(own, moves, loose, weak)
    theta = np.linalg.solve(chain.common[:, :COMMON], -chain.common[:, COMMON])
    np.testing.assert_allclose(theta, expected[-COMMON:], rtol=1e-9)
