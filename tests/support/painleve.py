"""Painleve's rod: uniform, of length 2 l and mass m, one end on a rough floor, at an angle a to it.

With the friction of an end that slides toward -x, J M^-1 J^T = (1 + 3 cos^2 a) / m and
J M^-1 J_t^T = -3 sin a cos a / m, so that m A = 1 + 3 cos^2 a - 3 mu sin a cos a.
"""

import casadi as ca
import numpy as np

from drake_dae import JointPositions, LinkExpressions, Plane, PointOnSurface, RobotModel

MASS, HALF, GRAVITY, SPEED = 1.3, 0.5, 9.81, 1e-3


def rod(friction, angle=1.0):
    """A rod in the x-z plane with positions (x, z, angle), moved by a force and a torque."""
    q, v = ca.SX.sym("q", 3), ca.SX.sym("v", 3)
    c, s = ca.cos(q[2]), ca.sin(q[2])
    turned = ca.vertcat(ca.horzcat(c, 0, -s), ca.horzcat(0, 1, 0), ca.horzcat(s, 0, c))
    links = LinkExpressions(
        q,
        v,
        ca.diag(ca.SX([MASS, MASS, MASS * HALF**2 / 3.0])),
        ca.SX([0.0, MASS * GRAVITY, 0.0]),
        frames={"rod": (turned, ca.vertcat(q[0], 0.0, q[1]))},
    )
    floor = PointOnSurface(
        "rod", Plane((0, 0, 0), (0, 0, 1)), (-HALF, 0, 0), "floor", None, friction, SPEED
    )
    nominal = [0.0, HALF * np.sin(angle), angle]
    outputs = [JointPositions(["q0", "q2"])]
    return RobotModel(links, [floor], outputs, nominal)


def sliding(angle, turn=0.0):
    """The rod's state, its end on the floor."""
    height, rise = HALF * np.sin(angle), HALF * np.cos(angle) * turn
    return np.array([0.0, height, angle, -2.0 - HALF * np.sin(angle) * turn, rise, turn])


def critical(angle):
    return (1.0 + 3.0 * np.cos(angle) ** 2) / (3.0 * np.sin(angle) * np.cos(angle))
