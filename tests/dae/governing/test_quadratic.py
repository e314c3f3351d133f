"""Small quadratic programs as expressions, against Drake's solvers."""

import casadi as ca
import numpy as np
import pytest
from pydrake.solvers import ClarabelSolver, MathematicalProgram

from drake_dae.dae.governing.quadratic import nearest_within


# Many bounds meet in sharper corners, where multipliers are some hundred.
@pytest.mark.parametrize(("size", "count", "excess"), [(2, 1, 1e-6), (7, 2, 1e-6), (7, 15, 1e-5)])
def test_it_is_the_optimum_of_clarabel(size, count, excess):
    shapes = {"H": (size, size), "g": (size, 1), "A": (count, size), "b": (count, 1)}
    symbols = [ca.SX.sym(name, *shape) for name, shape in shapes.items()]
    metric, goal, rows, bounds = symbols
    sides = ca.DM.eye(count)
    nearest = nearest_within(metric, goal, rows, sides, bounds, 1e-8)
    function = ca.Function("nearest", symbols, [nearest])
    random, tried = np.random.default_rng(0), 0
    for _ in range(60):
        root = random.normal(size=(size, size))
        metric = root @ root.T + 0.1 * np.eye(size)
        metric /= np.trace(metric) / size
        goal, bounds = 2.0 * random.normal(size=size), random.uniform(-0.3, 1.0, size=count)
        rows = random.normal(size=(count, size))
        rows /= np.linalg.norm(rows, axis=1)[:, None]
        program = MathematicalProgram()
        x = program.NewContinuousVariables(size)
        program.AddQuadraticCost(metric, -metric @ goal, x, is_convex=True)
        program.AddBoundingBoxConstraint(-1.0, 1.0, x)
        program.AddLinearConstraint(rows, np.full(count, -np.inf), bounds, x)
        result = ClarabelSolver().Solve(program)
        if not result.is_success():
            continue  # No x is within these bounds.
        tried += 1
        found = function(metric, goal, rows, bounds).full()[:, 0]
        assert np.abs(found).max() <= 1.0 + 1e-12
        # Soft bounds give way by 1e-8 times their multipliers.
        assert np.max(rows @ found - bounds) <= excess
        # Clarabel stops at 1e-8 of the cost, so that x is known to its root.
        wanted = result.GetSolution(x)
        np.testing.assert_allclose(found, wanted, atol=3e-4)
        costs = [(one - goal) @ metric @ (one - goal) for one in (found, wanted)]
        assert costs[0] <= costs[1] + 1e-6
    assert tried > 30


def test_a_row_with_two_bounds_is_that_row_twice():
    shapes = {"H": (3, 3), "g": (3, 1), "A": (2, 3), "b": (4, 1)}
    symbols = [ca.SX.sym(name, *shape) for name, shape in shapes.items()]
    metric, goal, rows, bounds = symbols
    sides = ca.DM([[1, 0], [-1, 0], [0, 1], [0, -1]])
    softness = [1e-8, 1e-8, 1e-6, 1e-6]
    both = nearest_within(metric, goal, rows, ca.sparsify(sides), bounds, softness)
    twice = ca.mtimes(sides, rows)
    each = nearest_within(metric, goal, twice, ca.DM.eye(4), bounds, softness)
    function, random = ca.Function("nearest", symbols, [both, each]), np.random.default_rng(3)
    for _ in range(20):
        root = random.normal(size=(3, 3))
        metric = root @ root.T + 0.1 * np.eye(3)
        rows, bounds = 0.5 * random.normal(size=(2, 3)), random.uniform(0.05, 0.5, size=4)
        found, wanted = function(metric, 2.0 * random.normal(size=3), rows, bounds)
        # The same steps, in another order of sums.
        np.testing.assert_allclose(found.full(), wanted.full(), atol=1e-7)
