"""A plate on legs, of which three hold it."""

import casadi as ca
import numpy as np

from drake_dae import DaeSystem

TABLE = [(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)]


def plate(rows, **fields):
    """A plate (z, a, b) on legs at the corners r: heights z + a r_x + b r_y = 0, forces by J^T."""
    jacobian = np.array([[1.0, x, y] for x, y in rows])
    mass = np.diag([4.0, 0.5, 0.25])
    q, v, names = slice(0, 3), slice(3, 6), [f"leg{i}" for i in range(len(rows))]
    return DaeSystem.from_functions(
        ["z", "a", "b", "vz", "va", "vb", "s"],
        f=lambda x: ca.vertcat(x[v], -9.81 * 4.0, 0.3, -0.2, 0),
        g=lambda x: ca.vertcat(ca.SX(3, len(rows)), jacobian.T, ca.SX(1, len(rows))),
        h=lambda x: ca.vertcat(ca.SX(6, 1), 1),
        k=lambda x: ca.mtimes(ca.SX(jacobian), x[q]),
        l=lambda x: [x[6]],
        m=lambda x: ca.SX(1, len(rows)),
        mass_matrix=np.block(
            [
                [np.eye(3), np.zeros((3, 4))],
                [np.zeros((3, 3)), mass, np.zeros((3, 1))],
                [np.zeros((1, 6)), np.ones((1, 1))],
            ]
        ),
        constraint_output_signals=names,
        **fields,
    )
