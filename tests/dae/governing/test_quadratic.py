"""Small quadratic programs as expressions, against Drake's solvers."""

import casadi as ca
import numpy as np
import pytest
from pydrake.solvers import ClarabelSolver, MathematicalProgram

from drake_dae.dae.governing.quadratic import nearest_within


@pytest.mark.parametrize(("size", "count"), [(2, 1), (7, 2)])
def test_it_is_the_optimum_of_clarabel(size, count):
    shapes = {"H": (size, size), "g": (size, 1), "A": (count, size), "b": (count, 1)}
    symbols = [ca.SX.sym(name, *shape) for name, shape in shapes.items()]
    function = ca.Function("nearest", symbols, [nearest_within(*symbols, 1e-8)])
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
        assert np.max(rows @ found - bounds) <= 1e-6
        # Clarabel stops at 1e-8 of the cost, so that x is known to its root.
        wanted = result.GetSolution(x)
        np.testing.assert_allclose(found, wanted, atol=3e-4)
        costs = [(one - goal) @ metric @ (one - goal) for one in (found, wanted)]
        assert costs[0] <= costs[1] + 1e-6
    assert tried > 30
