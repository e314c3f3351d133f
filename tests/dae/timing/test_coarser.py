"""Longer pieces of a table of polynomials."""

from itertools import pairwise

import numpy as np

from drake_dae.dae.references.pieces import PiecewisePolynomials
from drake_dae.dae.timing.coarser import coarser


def test_pieces_of_one_polynomial_become_one_piece():
    """Wherever they begin; a force that is no polynomial of five keeps its accuracy of 5e-4."""
    breaks = np.linspace(7.0, 8.0, 9)
    motion = np.polynomial.Polynomial([0.1, 0.4, -0.3, 0.2, 0.5, -0.1])
    factors = np.zeros((8, 2, 6))
    for i, (begin, end) in enumerate(pairwise(breaks)):
        piece = motion(np.polynomial.Polynomial([begin - 7.0, end - begin]))
        factors[i, 0] = piece.coef
        force = 20.0 + np.sin(np.array([begin, end]))
        factors[i, 1, :2] = force[0], force[1] - force[0]
    table = PiecewisePolynomials(breaks, factors)
    longer = coarser(table, np.array([0]))
    assert len(longer.factors) == 1
    for time in np.linspace(7.0, 8.0, 23):
        position, force = longer.at(time)
        assert abs(position - motion(time - 7.0)) < 1e-12
        assert abs(force - 20.0 - np.sin(time)) < 5e-4 * 21.0
