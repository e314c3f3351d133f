"""References that a problem can follow, and its closed loop without the library's plant."""

from collections.abc import Callable

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp

from drake_dae.dae import TrackingLaw
from problems.problem import Array, Problem


def reference_at(problem: Problem, time: float) -> Array:
    """R(t) of start + slope t + amplitude sin(1.3 t + i), with derivatives, output-major."""
    values = []
    for i, ((start, slope, amplitude), degree) in enumerate(
        zip(problem.reference, problem.output_degrees, strict=True)
    ):
        for order in range(degree + 1):
            line = (start + slope * time, slope)[order] if order < 2 else 0.0
            phase = 1.3 * time + i + order * np.pi / 2
            values.append(line + amplitude * 1.3**order * np.sin(phase))
    return np.array(values)


def wanted_outputs(problem: Problem, times: Array) -> Array:
    """r_i(t) without derivatives, shape (k, p)."""
    starts = np.cumsum([0, *(degree + 1 for degree in problem.output_degrees[:-1])])
    return np.array([reference_at(problem, time)[starts] for time in times])


def integrated(rate: Callable[[float, Array], Array], start: Array, times: Array) -> Array:
    """The states of x' = rate(t, x), shape (k, n), by SciPy's DOP853 with tolerances of 1e-11."""
    solution = solve_ivp(
        rate, (times[0], times[-1]), start, method="DOP853", t_eval=times, rtol=1e-11, atol=1e-12
    )
    assert solution.success, solution.message
    return solution.y.T


def closed_loop_outputs(
    problem: Problem, law: TrackingLaw, start: Array, times: Array
) -> tuple[Array, Array]:
    """Outputs and states of x' = f + g v + h u with v = alpha + beta u by hand and u of the law.

    An integrator and an elimination that the library does not know.

    Returns:
        z, shape (k, p), and x, shape (k, n).
    """
    system = problem.system
    numbers = ca.Function(
        "numbers",
        [system.state, system.parameter_symbol],
        [ca.densify(e) for e in (system.f, system.g, system.h, system.l, system.m)],
    )

    def at(time: float, x: Array) -> tuple[Array, Array]:
        f, g, h, el, em = (np.array(e) for e in numbers(x, system.parameter_values))
        closed_form = problem.known(x)
        u = law.control(x, reference_at(problem, time))
        v = closed_form.alpha + closed_form.beta @ u
        return f[:, 0] + g @ v + h @ u, el[:, 0] + em @ v

    states = integrated(lambda t, x: at(t, x)[0], start, times)
    return np.array([at(t, x)[1] for t, x in zip(times, states, strict=True)]), states
