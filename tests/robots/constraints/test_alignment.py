"""An axis that is held normal to a surface, against Drake's kinematics and by closed forms."""

import casadi as ca
import numpy as np
import pytest

from drake_dae import AxisNormalToSurface, LinkExpressions, Plane
from drake_dae.errors import ModelError
from drake_dae.trace.functions import TracedFunction


def pole():
    """A body in the x-z plane, q = (x, z, angle about -y): its z axis is (-sin, 0, cos)."""
    q, v = ca.SX.sym("q", 3), ca.SX.sym("v", 3)
    c, s = ca.cos(q[2]), ca.sin(q[2])
    turned = ca.vertcat(ca.horzcat(c, 0, -s), ca.horzcat(0, 1, 0), ca.horzcat(s, 0, c))
    place = ca.vertcat(q[0], 0, q[1])
    return LinkExpressions(
        q, v, ca.diag(ca.SX([2, 2, 0.3])), ca.SX(3, 1), {"body": (turned, place)}
    )


def rows(constraint, links, q):
    function = TracedFunction(
        "rows",
        {"q": links.q, "p": ca.vertcat(*[p.symbol for p in constraint.parameters])},
        {"phi": constraint.residual(links), "J": ca.jacobian(constraint.residual(links), links.q)},
    )
    return function(q, np.concatenate([p.value for p in constraint.parameters]))


@pytest.mark.parametrize("angle", [-2.5, -0.4, 0.0, 0.3, 1.9])
def test_it_measures_the_tilt_and_has_no_second_zero(angle):
    """2 tan(t / 2) of the tilt t against the normal, whose other end is infinitely far.

    axes_along(z) are x and y, and a tilt about -y is one about -c: phi = (0, 2 tan(-t / 2)).
    """
    links = pole()
    constraint = AxisNormalToSurface("body", Plane((0, 0, 0), (0, 0, 1)))
    phi, _ = rows(constraint, links, [0.3, 0.1, angle])
    np.testing.assert_allclose(phi, [0.0, -2.0 * np.tan(angle / 2.0)], atol=1e-13)


def test_an_axis_of_no_length_is_refused():
    with pytest.raises(ModelError, match="axis"):
        AxisNormalToSurface("tool", Plane((0, 0, 0), (0, 0, 1)), (0.0, 0.0, 0.0))
