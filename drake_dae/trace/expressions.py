"""Expressions: whether they are smooth, since the theory differentiates, and functions of users."""

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from drake_dae.arrays import brief
from drake_dae.errors import DrakeDaeError, ModelError

# Operations of CasADi that are not smooth.
KINKS = {
    ca.OP_FABS: "fabs",
    ca.OP_SIGN: "sign",
    ca.OP_COPYSIGN: "copysign",
    ca.OP_FMIN: "fmin",
    ca.OP_FMAX: "fmax",
    ca.OP_FLOOR: "floor",
    ca.OP_CEIL: "ceil",
    ca.OP_FMOD: "fmod",
    ca.OP_REMAINDER: "remainder",
    ca.OP_IF_ELSE_ZERO: "if_else",
    **dict.fromkeys((ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE), "a comparison"),
}
LARGE = 2.0**200


def length_of(vector: ca.SX) -> ca.SX:
    """Returns the Euclidean norm of a column vector, smooth wherever it is not zero.

    For a single entry e CasADi simplifies sqrt(e^2) to fabs(e), whose higher derivatives are wrong.
    Here that entry is split in two: e^2 = (0.6 e)^2 + (0.8 e)^2.
    """
    entries = [entry for entry in ca.vertsplit(vector) if not entry.is_zero()]
    if len(entries) == 1:
        return ca.norm_2(ca.vertcat(0.6 * entries[0], 0.8 * entries[0]))
    return ca.norm_2(vector)


def as_constant(expression: ca.SX) -> ca.SX:
    """Returns the same numbers, to 2^-200, with zero derivatives.

    CasADi takes floor(x) for a constant, and so large a multiple of a number is a whole one.
    """
    return ca.floor(expression * LARGE) / LARGE


def find_flaw(expression: ca.SX, variable: ca.SX, other: ca.SX, name: str = "a variable") -> str:
    """Returns why an expression cannot be differentiated by the variable; "" if it can."""
    function = ca.Function("f", [variable, other], [expression])
    instructions = [function.instruction_id(i) for i in range(function.n_instructions())]
    places = [i for i, operation in enumerate(instructions) if operation == ca.OP_CONST]
    constants = [function.instruction_constant(i) for i in places]
    if KINKS.keys().isdisjoint(instructions) and np.all(np.isfinite(constants)):
        return ""  # Most have neither.
    moving: dict[int, bool] = {}  # Whether an entry of the work vector depends on the variable.
    for i, operation in enumerate(instructions):
        if operation == ca.OP_OUTPUT:
            continue
        inputs = function.instruction_input(i)
        moves = False
        if operation == ca.OP_CONST:
            value = function.instruction_constant(i)
            if not np.isfinite(value):
                hint = "; math.sin of a symbol is nan, use casadi.sin" if np.isnan(value) else ""
                return f"holds a constant that is not finite, {value}{hint}"
        elif operation == ca.OP_INPUT:
            moves = inputs[0] == 0
        else:
            moves = any(moving[i] for i in inputs)
            if moves and operation in KINKS:
                return (
                    f"is not smooth: it takes {KINKS[operation]} of {name}. Derivatives would be "
                    "those of one side without notice; write the one side that is needed, or a "
                    "smooth function such as tanh(x / e) or sqrt(x**2 + e**2)"
                )
        moving.update(dict.fromkeys(function.instruction_output(i), moves))
    return ""


def result_of(
    what: str,
    function: Callable[..., Any],
    *arguments: Any,
    error: Callable[[str], Exception] = ModelError,
) -> Any:
    """Calls a user's function; a failure is raised as an error of the argument."""
    try:
        return function(*arguments)
    except DrakeDaeError:
        raise
    except Exception as failure:
        text = f"{what} failed: {type(failure).__name__}: {brief(str(failure))}"
        raise error(text) from failure
