"""The search for operations that have no derivative."""

import casadi as ca

from drake_dae.trace.smoothness import find_flaw


def test_a_kink_counts_only_in_the_variable():
    x, other = ca.SX.sym("x"), ca.SX.sym("other")
    flaw = find_flaw(x * ca.fabs(x + other), x, other)
    assert flaw is not None
    assert flaw.operation == "fabs"
    assert find_flaw(x * ca.fabs(other), x, other) is None


def test_constants_have_to_be_finite():
    x, other = ca.SX.sym("x"), ca.SX.sym("other")
    flaw = find_flaw(x + other + ca.inf, x, other)
    assert flaw is not None
    assert flaw.constant == float("inf")
