"""Expressions: whether they are smooth, functions of users, and formulas as text."""

import ast
import operator
from collections.abc import Callable, Mapping
from typing import Any

import casadi as ca
import numpy as np

from drake_dae.arrays import brief, number_in, unknown_name
from drake_dae.errors import DrakeDaeError, ModelError

# Operations of CasADi that are not smooth; the theory differentiates.
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
SMOOTH = "write the one side that is needed, or a smooth function such as sqrt(x**2 + 1e-6) for |x|"
OPERATORS: dict[type[ast.AST], Callable[..., ca.SX]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
}
# The functions of formulas; atan2 takes two numbers, the others one.
FUNCTIONS = (
    *("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh"),
    *("atanh", "exp", "log", "sqrt", "erf", "atan2"),
)


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
        inputs, moves = function.instruction_input(i), False
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
                f"is not smooth: it takes {KINKS[operation]} of {name}. Derivatives would be those "
                "of one side without notice; write the one side that is needed, or a smooth "
                "function such as tanh(x / e) or sqrt(x**2 + e**2)"
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


def parse_formula(text: str, symbols: Mapping[str, ca.SX]) -> ca.SX:
    """Parses a text such as "z - 0.1*sin(x)**2", never executed as Python, to an expression.

    It may have numbers, the symbols, pi, + - * / **, brackets, and `FUNCTIONS`.
    """
    text, names = " ".join(text.split()), {"pi": ca.SX(ca.pi), **symbols}
    if not text:
        raise ModelError("the formula is empty; write one such as z - 0.1*sin(x)")

    def wrong(node: ast.expr, what: str) -> ModelError:
        place = len(text.encode()[: node.col_offset].decode()) + 1
        return ModelError(f"formula '{_short(text)}', column {place}: {what}")

    def value(node: ast.expr) -> ca.SX:
        piece = ast.get_source_segment(text, node) or ""
        match node:
            # Python also accepts 1_000 and 0x10, and makes numbers that are too large infinite.
            case ast.Constant() if (number := number_in(piece)) is not None:
                return ca.SX(number)
            case ast.Name(id=name) if name in names:
                return ca.SX(names[name])
            case ast.BinOp(left, op, right) if type(op) in OPERATORS:
                return OPERATORS[type(op)](value(left), value(right))
            case ast.UnaryOp(op, operand) if type(op) in OPERATORS:
                return OPERATORS[type(op)](value(operand))
            case ast.Call(ast.Name(id=name), arguments, []) if name in FUNCTIONS:
                if len(arguments) == 1 + (name == "atan2"):
                    return getattr(ca, name)(*map(value, arguments))
            case ast.Name(id=name):
                raise wrong(node, unknown_name("name", name, names))
        raise wrong(
            node,
            f"'{_short(piece)}' is not allowed; a formula has finite numbers, names, + - * / **, "
            f"brackets and {', '.join(FUNCTIONS)}; {SMOOTH}",
        )

    try:
        return value(ast.parse(text, mode="eval").body)
    except ModelError:
        raise
    except SyntaxError as error:
        place = error.offset or 1
        read = f"it cannot be read at '{_short(text[place - 1 :], 20)}'"
        raise ModelError(f"formula '{_short(text)}', column {place}: {read}") from None
    except (ValueError, RecursionError, MemoryError):
        raise ModelError("the formula holds a null letter, or is too long") from None


def check_names(names: Mapping[str, object], taken: tuple[str, ...]) -> None:
    """Checks that a formula can use names of parameters."""
    for name in names:
        if not name.isidentifier():
            raise ModelError(f"parameter '{name}': a name is a word such as r_1")
        if name in (*taken, "pi", *FUNCTIONS):
            raise ModelError(f"parameter '{name}': in a formula this means something else")


def _short(text: str, letters: int = 60) -> str:
    return text if len(text) <= letters else f"{text[: letters - 3]}..."
