"""IPOPT, with the values and derivatives of functions of Python."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.errors import DrakeDaeError

TOLERANCE = 1e-6
"""Of optimality and of limits, in variables, cost and limits over their sizes."""

PUSHED = 1e-2
"""A variable that begins at a bound is moved by as much of its range, others by less or not."""

LEAST_PUSHED = 1e-6
"""A variable is moved by as much at least where it begins closer to a bound."""


@dataclass(frozen=True, eq=False)
class IpoptProblem:
    """min f(x) with low <= x <= high and lowest <= g(x) <= highest.

    Attributes:
        values: x -> f and g below each other, shape (1 + m,).
        slopes: x -> their derivatives, shape (1 + m, n).
        low, high: Shape (n,).
        lowest, highest: Shape (m,).
        is_over: Whether the search is to end.
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
    """How IPOPT ended.

    Attributes:
        x: Where, shape (n,).
        status: What it says.
        converged: Whether it converged.
        iterations: How many iterations it made.
    """

    x: FloatArray
    status: str
    converged: bool
    iterations: int


def solve(problem: IpoptProblem, start: FloatArray, iterations: int) -> IpoptResult:
    """Runs IPOPT (Waechter and Biegler, 2006), whose second derivatives are those of BFGS.

    A function that raises an error of this library has no value there, and IPOPT takes a shorter
    step; any other exception ends the search and is raised.

    Args:
        problem: The problem.
        start: x at the beginning.
        iterations: At most so many iterations.
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
    found = solver(
        x0=start, lbx=problem.low, ubx=problem.high, lbg=problem.lowest, ubg=problem.highest
    )
    if functions.errors:
        raise functions.errors[0]
    stats = solver.stats()
    return IpoptResult(
        found["x"].full()[:, 0],
        str(stats["return_status"]),
        bool(stats["success"]),
        int(stats["iter_count"]),
    )


class _PythonFunction(ca.Callback):
    """A function of Python for CasADi, which loses exceptions: they are kept in `errors`."""

    def __init__(self, name: str, problem: IpoptProblem, errors: list[BaseException]) -> None:
        super().__init__()
        self._problem, self._size, self.errors = problem, problem.low.size, errors
        self._count = 1 + problem.lowest.size
        self.construct(name, {})

    def get_n_in(self) -> int:
        return 1

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self._size, 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(*self._shape())

    def _shape(self) -> tuple[int, int]:
        return self._count, 1

    def _value(self, x: FloatArray) -> FloatArray:
        return self._problem.values(x)

    def eval(self, arguments: Any) -> list[ca.DM]:
        """The value; nan where there is none."""
        nothing = np.full(self._shape(), np.nan)
        if self.errors or self._problem.is_over():
            return [ca.DM(nothing)]
        try:
            return [ca.DM(self._value(arguments[0].full()[:, 0]).reshape(self._shape()))]
        except DrakeDaeError:
            return [ca.DM(nothing)]
        except BaseException as error:
            self.errors.append(error)
            return [ca.DM(nothing)]


class _Slopes(_PythonFunction):
    def get_n_in(self) -> int:
        return 2

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self._count if i else self._size, 1)

    def _shape(self) -> tuple[int, int]:
        return self._count, self._size

    def _value(self, x: FloatArray) -> FloatArray:
        return self._problem.slopes(x)


class _Values(_PythonFunction):
    def __init__(self, problem: IpoptProblem) -> None:
        super().__init__("values", problem, [])
        self._slopes: _Slopes | None = None  # CasADi does not keep it.

    def has_jacobian(self, *given: Any) -> bool:
        return True

    def get_jacobian(self, name: str, *given: Any) -> ca.Function:
        self._slopes = _Slopes(name, self._problem, self.errors)
        return self._slopes
