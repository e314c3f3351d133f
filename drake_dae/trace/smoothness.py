"""Whether an expression may be differentiated as often as the theory does."""

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


def length_of(vector: ca.SX) -> ca.SX:
    """The length of a column, with derivatives of all orders wherever it is not zero.

    Of a column with one entry e CasADi makes sqrt(e^2) = fabs(e), which it differentiates but once.
    That entry is here turned into a plane: e^2 = (0.6 e)^2 + (0.8 e)^2.
    """
    entries = [entry for entry in ca.vertsplit(vector) if not entry.is_zero()]
    if len(entries) == 1:
        return ca.norm_2(ca.vertcat(0.6 * entries[0], 0.8 * entries[0]))
    return ca.norm_2(vector)


@dataclass(frozen=True)
class Flaw:
    """What keeps an expression from being differentiated.

    Attributes:
        operation: One that is not smooth in the variable; empty if a constant is to blame.
        constant: A constant that is not finite; 0 if the operation is to blame.
    """

    operation: str
    constant: float = 0.0

    def describe(self, variable: str) -> str:
        """What to say of the expression, and what to write instead.

        Args:
            variable: How a message calls what the expression must be smooth in.
        """
        if self.operation:
            return (
                f"is not smooth: it takes {self.operation} of {variable}. Derivatives would be "
                "those of one side without notice; write the one side that is needed, or a "
                "smooth function such as tanh(x / e) or sqrt(x**2 + e**2)"
            )
        hint = "; math.sin of a symbol is nan, use casadi.sin" if np.isnan(self.constant) else ""
        return f"holds a constant that is not finite, {self.constant}{hint}"


def find_flaw(expression: ca.SX, variable: ca.SX, other: ca.SX) -> Flaw | None:
    """Finds a constant that is not finite, or an operation on a variable that is not smooth.

    Args:
        expression: A function of the variable and of others.
        variable: Symbols, in which it shall be smooth.
        other: All other symbols, below each other.

    Returns:
        The first flaw; None if there is none.
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
                return Flaw("", value)
        elif operation == ca.OP_INPUT:
            moves = inputs[0] == 0
        else:
            moves = any(moving[place] for place in inputs)
            if moves and operation in _KINKS:
                return Flaw(_KINKS[operation])
        moving[function.instruction_output(i)[0]] = moves
    return None
