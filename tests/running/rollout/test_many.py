"""A CasADi function at many moments against the function at each of them."""

import casadi as ca
import numpy as np
import pytest

from drake_dae.running.rollout.stepping.many import BLOCK, FEW, VectorizedFunction

X, P = ca.SX.sym("x", 3), ca.SX.sym("p", 2)
a, b, c = ca.vertsplit(X)
EXPRESSIONS = {
    "operations": [
        ca.vertcat(-a, ca.exp(a), ca.log(b), ca.sqrt(b), a**2, a + a, a**3, ca.fabs(a)),
        ca.vertcat(ca.sin(a), ca.cos(a), ca.tan(a), ca.asin(c), ca.acos(c), ca.atan(a)),
        ca.vertcat(ca.sinh(c), ca.cosh(c), ca.tanh(c), ca.sign(a), 1 / b, ca.floor(a), ca.ceil(a)),
        ca.vertcat(a + b, a - b, a * b, a / b, b**a, ca.fmin(a, b), ca.fmax(a, b)),
        ca.vertcat(a < b, a <= b, ca.eq(a, b), ca.ne(a, b), ca.atan2(a, b), ca.copysign(b, a)),
        ca.if_else(ca.logic_and(a > 0, ca.logic_or(b > 1, ca.logic_not(c > 0))), P[0] * b, P[1]),
        # Which is no number where it is not asked for.
        ca.if_else(a > 0, ca.sqrt(a), 0),
    ],
    "another operation": [ca.vertcat(ca.erf(a), a * P[0])],
    "constants": [ca.vertcat(3.0, a), ca.SX(2.0)],
}


@pytest.mark.parametrize("name", EXPRESSIONS)
@pytest.mark.parametrize("count", [1, FEW, BLOCK + 7])
def test_it_is_the_function_at_each_moment(name, count):
    """To two units in the last place: NumPy has a sin of its own."""
    function = ca.Function("f", [X, P], EXPRESSIONS[name], {"cse": False})
    random = np.random.default_rng(count)
    points = random.uniform([-2.0, 0.1, -0.9], [2.0, 2.0, 0.9], (count, 3))
    shared = np.array([1.5, -0.5])
    found = VectorizedFunction(function)(points, shared)
    for index in {0, count // 2, count - 1}:
        wanted = function.call([points[index], shared])
        for values, value in zip(found, wanted, strict=True):
            assert values.shape == (count, value.numel())
            np.testing.assert_allclose(values[index], value.full()[:, 0], rtol=5e-16, atol=1e-16)
