"""Checks that an expression is smooth, since the theory differentiates repeatedly."""

from dataclasses import dataclass

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

_LARGE = 2.0**200


def length_of(vector: ca.SX) -> ca.SX:
    """Returns the Euclidean norm of a column vector, smooth wherever it is not zero.

    For a single entry e CasADi simplifies sqrt(e^2) to fabs(e), whose higher derivatives are wrong.
    Here that entry is split in two: e^2 = (0.6 e)^2 + (0.8 e)^2.

    For a column with one entry e CasADi forms sqrt(e^2) = fabs(e), whose higher derivatives it
    loses. Here that entry is split in two: e^2 = (0.6 e)^2 + (0.8 e)^2.
    """
    entries = [entry for entry in ca.vertsplit(vector) if not entry.is_zero()]
    if len(entries) == 1:
        return ca.norm_2(ca.vertcat(0.6 * entries[0], 0.8 * entries[0]))
    return ca.norm_2(vector)


def as_constant(expression: ca.SX) -> ca.SX:
    """Returns the same numbers, to 2^-200, with zero derivatives.

    CasADi takes floor(x) for a constant, and so large a multiple of a number is a whole one.
    """
    return ca.floor(expression * _LARGE) / _LARGE


@dataclass(frozen=True)
class SmoothnessFlaw:
    """The reason why an expression cannot be differentiated."""

    operation: str
    constant: float = 0.0

    def describe(self, variable: str) -> str:
        """Returns the text for an error message: the non-smooth expression and how to repair it."""
        if self.operation:
            return (
                f"is not smooth: it takes {self.operation} of {variable}. Derivatives would be "
                "those of one side without notice; write the one side that is needed, or a "
                "smooth function such as tanh(x / e) or sqrt(x**2 + e**2)"
            )
        hint = "; math.sin of a symbol is nan, use casadi.sin" if np.isnan(self.constant) else ""
        return f"holds a constant that is not finite, {self.constant}{hint}"


def find_flaw(expression: ca.SX, variable: ca.SX, other: ca.SX) -> SmoothnessFlaw | None:
    """Returns a constant that is not finite or an operation that is not smooth, or None."""
    function = ca.Function("f", [variable, other], [expression])
    if not _may_have_flaw(function):
        return None
    moving: dict[int, bool] = {}  # Whether an entry of the work vector depends on the variable.
    for i in range(function.n_instructions()):
        operation = function.instruction_id(i)
        if operation == ca.OP_OUTPUT:
            continue
        inputs = function.instruction_input(i)
        moves = False
        if operation == ca.OP_CONST:
            value = function.instruction_constant(i)
            if not np.isfinite(value):
                return SmoothnessFlaw("", value)
        elif operation == ca.OP_INPUT:
            moves = inputs[0] == 0
        else:
            moves = any(moving[i] for i in inputs)
            if moves and operation in _KINKS:
                return SmoothnessFlaw(_KINKS[operation])
        moving.update(dict.fromkeys(function.instruction_output(i), moves))
    return None


def _may_have_flaw(function: ca.Function) -> bool:
    """Whether the function contains any operation or constant of a flaw. This test is quick."""
    operations = [function.instruction_id(i) for i in range(function.n_instructions())]
    if not _KINKS.keys().isdisjoint(operations):
        return True
    constants = [
        function.instruction_constant(i)
        for i, operation in enumerate(operations)
        if operation == ca.OP_CONST
    ]
    return not np.all(np.isfinite(constants))
