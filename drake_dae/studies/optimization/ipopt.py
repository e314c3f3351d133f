"""IPOPT for functions that Python evaluates, with their derivatives."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.errors import DrakeDaeError

TOLERANCE = 1e-6
"""The tolerance of optimality and of limits, for scaled variables, cost and limits."""

PUSHED = 1e-2
"""The largest distance that IPOPT moves the initial guess away from a bound, in ranges."""

LEAST_PUSHED = 1e-6
"""The least distance that IPOPT moves an initial guess that is closer to a bound."""


@dataclass(frozen=True, eq=False)
class IpoptProblem:
    """min f(x) with low <= x <= high and lowest <= g(x) <= highest.

    Attributes:
        values: x -> [f, g], shape (1 + m,).
        slopes: x -> the derivatives of [f, g], shape (1 + m, n).
        low, high: The bounds of x, shape (n,).
        lowest, highest: The bounds of g, shape (m,).
        is_over: Returns whether the search must end.
    """

    values: Callable[[FloatArray], FloatArray]
    slopes: Callable[[FloatArray], FloatArray]
    low: FloatArray
    high: FloatArray
    lowest: FloatArray
    highest: FloatArray
    is_over: Callable[[], bool]


@dataclass(frozen=True)
class IpoptResult:
    """The result of IPOPT.

    Attributes:
        x: The last x, shape (n,).
        status: IPOPT's return status.
        converged: Whether IPOPT converged.
        iterations: The number of iterations.
    """

    x: FloatArray
    status: str
    converged: bool
    iterations: int


def solve(problem: IpoptProblem, start: FloatArray, iterations: int) -> IpoptResult:
    """Runs IPOPT (Waechter and Biegler, 2006) with second derivatives by BFGS.

    If a function raises an error of this library, its value is nan, and IPOPT takes a shorter step.
    Any other exception ends the search and is raised again.

    Args:
        problem: The problem.
        start: The initial x, shape (n,).
        iterations: The largest number of iterations.
    """
    functions = _Values(problem)
    room = np.minimum(start - problem.low, problem.high - start)
    pushed = max(LEAST_PUSHED, min([PUSHED, *room[room > 0.0].tolist()]))
    x = ca.MX.sym("x", start.size)
    both = functions(x)
    options = {
        "print_time": False,
        "error_on_fail": False,
        "show_eval_warnings": False,
        "ipopt": {
            "hessian_approximation": "limited-memory",
            "limited_memory_max_history": 20,
            "max_iter": iterations,
            "tol": TOLERANCE,
            "constr_viol_tol": TOLERANCE,
            "acceptable_iter": 0,
            "bound_relax_factor": 0.0,
            "bound_push": pushed,
            "bound_frac": pushed,
            "print_level": 0,
            "sb": "yes",
        },
    }
    solver = ca.nlpsol("solver", "ipopt", {"x": x, "f": both[0], "g": both[1:]}, options)
    solution = solver(
        x0=start, lbx=problem.low, ubx=problem.high, lbg=problem.lowest, ubg=problem.highest
    )
    if functions.errors:
        raise functions.errors[0]
    stats = solver.stats()
    return IpoptResult(
        solution["x"].full()[:, 0],
        str(stats["return_status"]),
        bool(stats["success"]),
        int(stats["iter_count"]),
    )


class _PythonFunction(ca.Callback):
    """A Python function for CasADi, with one result; CasADi loses exceptions, `errors` has them."""

    def __init__(
        self,
        name: str,
        problem: IpoptProblem,
        errors: list[BaseException],
        function: Callable[[FloatArray], FloatArray],
        inputs: list[int],
        columns: int,
    ) -> None:
        super().__init__()
        self._problem, self.errors, self._function = problem, errors, function
        self._inputs, self._shape = inputs, (1 + problem.lowest.size, columns)
        self.construct(name, {})

    def get_n_in(self) -> int:
        return len(self._inputs)

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self._inputs[i], 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(*self._shape)

    def eval(self, arguments: Any) -> list[ca.DM]:
        """The value of the function; nan if it fails or the search is over."""
        if not (self.errors or self._problem.is_over()):
            try:
                return [ca.DM(self._function(arguments[0].full()[:, 0]).reshape(self._shape))]
            except DrakeDaeError:
                pass
            except BaseException as error:
                self.errors.append(error)
        return [ca.DM(np.full(self._shape, np.nan))]


class _Values(_PythonFunction):
    """x -> [f, g], with the Jacobian of the problem."""

    def __init__(self, problem: IpoptProblem) -> None:
        super().__init__("values", problem, [], problem.values, [problem.low.size], 1)
        self._slopes: _PythonFunction | None = None  # CasADi keeps no reference to it.

    def has_jacobian(self, *_: Any) -> bool:
        return True

    def get_jacobian(self, name: str, *_: Any) -> ca.Function:
        problem, n = self._problem, self._problem.low.size
        inputs = [n, 1 + problem.lowest.size]  # x, and the value at x, which is not needed.
        self._slopes = _PythonFunction(name, problem, self.errors, problem.slopes, inputs, n)
        return self._slopes
