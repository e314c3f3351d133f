"""Long functions of C in pieces compute what they compute as a whole."""

import shutil

import casadi as ca
import numpy as np
import pytest
from runs import some

from drake_dae.pictures.page import in_pieces
from drake_dae.trace.compiled import generate, library, without_branches


def long_function(name, looks_up=False):
    """A recursion whose values are read many assignments after they are written.

    One that looks values up calls another function, which needs memory.
    """
    x, y = ca.SX.sym("x", 6), ca.SX.sym("y", 3)
    column = [x[i] for i in range(6)]
    for k in range(120):
        one, other, far = column[-1], column[-3], column[(7 * k) % len(column)]
        chosen = ca.if_else(one > y[k % 3], other, far)
        column.append(ca.sin(one + 0.1 * far) + ca.fmin(other, 0.3) * chosen)
    first = ca.vertcat(*column[20:30])
    if looks_up:
        table = ca.interpolant("table", "linear", [[0.0, 0.2, 1.0]], [1.0, 2.0, 0.5])
        first = first + sum(table(each) for each in column[30:40])
    return ca.Function(name, [x, y], [ca.cse(ca.vertcat(*column[-10:])), first])


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
@pytest.mark.parametrize("looks_up", some([False, True], first=1))
def test_pieces_compute_what_the_whole_does(looks_up):
    whole = long_function("long_one", looks_up)
    source = generate(whole)
    pieces = in_pieces(without_branches(source), 30)
    assert pieces.count("noinline") > 120 // 30
    own = ca.external("long_one", str(library(pieces, 0, True, True)))
    rng = np.random.default_rng(3)
    for _ in range(20):
        x, y = rng.normal(size=6), rng.normal(size=3)
        for found, wanted in zip(own(x, y), whole(x, y), strict=True):
            # sin may be that of another library, by one unit in the last place.
            np.testing.assert_allclose(found.full(), wanted.full(), rtol=1e-12, atol=1e-13)


def test_short_functions_stay_as_they_are():
    source = generate(long_function("long_one"))
    assert in_pieces(source) == source
