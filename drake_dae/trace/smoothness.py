"""Whether an expression may be differentiated as often as the theory does."""

import casadi as ca
import numpy as np

_KINKS = {
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
"""Operations of CasADi that are not smooth."""


def flaw(expression: ca.SX, variable: ca.SX, other: ca.SX, name: str) -> str | None:
    """A constant that is not finite, or an operation on a variable that is not smooth.

    Args:
        expression: Of the variable and of others.
        variable: Symbols, in which it shall be smooth.
        other: All other symbols, below each other.
        name: Of the variable.

    Returns:
        What to say of the expression; None if all is well.
    """
    function = ca.Function("f", [variable, other], [expression])
    moving: dict[int, bool] = {}  # Whether what stands in a place of the work vector varies.
    for i in range(function.n_instructions()):
        operation = function.instruction_id(i)
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
            moves = any(moving[place] for place in inputs)
            if moves and operation in _KINKS:
                return (
                    f"is not smooth: it takes {_KINKS[operation]} of {name}. Derivatives would be "
                    "those of one side without notice; write the one side that is needed, or a "
                    "smooth function such as tanh(x / e) or sqrt(x**2 + e**2)"
                )
        moving[function.instruction_output(i)[0]] = moves
    return None
