"""Pegs and holes, written down by hand: a planar peg on a gantry, and one that turns in space."""

import casadi as ca
import numpy as np

from drake_dae import Hole, LinkExpressions, Peg, Plate, PointOnSurface, RobotModel

# The mass in kg and the moment of inertia in kg m^2 of a peg, and the distance of its end from the
# center of mass, in m.
MASS, INERTIA, ARM = 2.0, 0.01, 0.05
HOLE = 0.005
"""The radius of the hole, m."""


def peg_of(clearance):
    return Peg("wall", HOLE - clearance, 0.02, axis=(0.0, 0.0, -1.0))


def plate_of(chamfer):
    return Plate(
        (0.0, 0.0, 0.0),
        (0.0, 0.0, 1.0),
        (0.06, 0.06),
        thickness=0.03,
        hole=Hole(HOLE, (0, 0), chamfer),
    )


def planar_peg(chamfer=0.001, gravity=9.81, driven=True, **friction):
    """A peg in the x-z plane: x and z of its center of mass, and its angle about y.

    Its end is at (x - ARM sin(angle), z - ARM cos(angle)).
    """
    q, v = ca.SX.sym("q", 3), ca.SX.sym("v", 3)
    c, s = ca.cos(q[2]), ca.sin(q[2])
    turned = ca.vertcat(ca.horzcat(c, 0, s), ca.horzcat(0, 1, 0), ca.horzcat(-s, 0, c))
    links = LinkExpressions(
        q,
        v,
        ca.diag(ca.SX([MASS, MASS, INERTIA])),
        ca.SX([0.0, MASS * gravity, 0.0]),
        {"peg": (turned, ca.vertcat(q[0], 0, q[1]))},
        actuation_matrix=np.eye(3)[:, : 3 if driven else 0],
        default_positions=np.array([0.0, ARM + 0.01, 0.0]),
    )
    wall = PointOnSurface("peg", plate_of(chamfer), (0.0, 0.0, -ARM), "wall", **friction)
    return RobotModel(links, [wall], [], forces=[])


def upright_peg(chamfer=0.001, exogenous=(), **options):
    """A peg in space that does not turn: x, y, z of its end; nothing drives it, and no gravity."""
    q, v = ca.SX.sym("q", 3), ca.SX.sym("v", 3)
    links = LinkExpressions(
        q,
        v,
        MASS * ca.SX.eye(3),
        ca.SX(3, 1),
        {"peg": (ca.SX.eye(3), q)},
        actuation_matrix=np.zeros((3, 0)),
    )
    wall = PointOnSurface("peg", plate_of(chamfer), (0.0, 0.0, 0.0), "wall", **options)
    return RobotModel(links, [wall], [], forces=[], exogenous=exogenous)
