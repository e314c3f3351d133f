"""Bases of the tangent space of a manifold that is given by the gradients of its constraints."""

import numpy as np
import scipy.linalg

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.layout import Indices
from drake_dae.trace.round_off import unit_rows


def tangent(gradients: FloatArray, scale: FloatArray) -> FloatArray:
    """Returns a basis T of the tangent space, orthonormal in scaled states, shape (n, n - k)."""
    rows = unit_rows(gradients * scale)
    return scale[:, None] * np.linalg.svd(rows)[2][len(rows) :].T


def coordinates(gradients: FloatArray, scale: FloatArray) -> tuple[Indices, FloatArray]:
    """Returns n - k states that are coordinates, and the derivatives of all states by them.

    Unlike an orthonormal basis this one leaves a triangular system triangular. The arguments are
    those of `tangent`.
    """
    basis = tangent(gradients, scale) / scale[:, None]
    count = basis.shape[1]
    free = np.sort(scipy.linalg.qr(basis.T, mode="r", pivoting=True)[1][:count])
    rest = np.setdiff1d(np.arange(scale.size), free)
    rows = unit_rows(gradients * scale)
    moved = np.zeros(basis.shape)
    moved[free] = np.eye(count)
    moved[rest] = -np.linalg.solve(rows[:, rest], rows[:, free])
    return free, scale[:, None] * moved / scale[free]
