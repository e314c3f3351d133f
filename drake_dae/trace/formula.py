"""Formulas as text: parsed, never executed as Python."""

import ast
import operator
from collections.abc import Callable, Mapping

import casadi as ca

from drake_dae.arrays import number_in, unknown_name
from drake_dae.errors import ModelError

MOST_LETTERS = 10_000

_OPERATORS: dict[type[ast.AST], Callable[..., ca.SX]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
}

_OF_ONE = (
    *("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh"),
    *("atanh", "exp", "log", "sqrt", "erf"),
)
# Name -> number of arguments, and the function.
_FUNCTIONS: dict[str, tuple[int, Callable[..., ca.SX]]] = {
    **{name: (1, getattr(ca, name)) for name in _OF_ONE},
    "atan2": (2, ca.atan2),
}
_ROUGH = ("abs", "fabs", "min", "max", "fmin", "fmax", "floor", "ceil", "round", "sign", "mod")
_SMOOTH_INSTEAD = (
    "is not smooth, and derivatives are needed: write the one side that is needed, or a smooth "
    "function such as sqrt(x**2 + 1e-6) for abs(x)"
)

CONSTANTS = {"pi": ca.pi}


def parse_formula(text: str, symbols: Mapping[str, ca.SX]) -> ca.SX:
    """Parses a text such as "z - 0.1*sin(x)**2" to an expression.

    It may have numbers, the symbols, pi, + - * / **, brackets, and sin, cos, tan, asin, acos, atan,
    atan2, sinh, cosh, tanh, asinh, acosh, atanh, exp, log, sqrt, erf.
    """
    if len(text) > MOST_LETTERS:
        raise ModelError(f"a formula has at most {MOST_LETTERS} letters, this one {len(text)}")
    text, names = " ".join(text.split()), {**CONSTANTS, **symbols}
    if not text:
        raise ModelError("the formula is empty; write one such as z - 0.1*sin(x)")

    def wrong(place: int, what: str) -> ModelError:
        return ModelError(f"formula '{_short(text)}', column {place + 1}: {what}")

    def value(node: ast.expr) -> ca.SX:
        piece = ast.get_source_segment(text, node) or ""
        match node:
            # Python also accepts 1_000 and 0x10, and makes numbers that are too large infinite.
            case ast.Constant() if (number := number_in(piece)) is not None:
                return ca.SX(number)
            case ast.Name(id=name) if name in names:
                return ca.SX(names[name])
            case ast.BinOp(left, op, right) if type(op) in _OPERATORS:
                return _OPERATORS[type(op)](value(left), value(right))
            case ast.UnaryOp(op, operand) if type(op) in _OPERATORS:
                return _OPERATORS[type(op)](value(operand))
            case ast.Call(ast.Name(id=name), arguments, []) if name in _FUNCTIONS:
                count, function = _FUNCTIONS[name]
                if len(arguments) == count:
                    return function(*map(value, arguments))
                why = f"{name} takes {count} value(s), got '{_short(piece)}'"
            case ast.Name(id=name):
                why = unknown_name("name", name, names)
            case ast.Call(ast.Name(id=name)) if name in _ROUGH:
                why = f"'{_short(piece)}' {_SMOOTH_INSTEAD}"
            case ast.Call(ast.Name(id=name)):
                why = unknown_name("function", name, _FUNCTIONS)
            case ast.Compare() | ast.IfExp() | ast.BoolOp():
                why = f"'{_short(piece)}' {_SMOOTH_INSTEAD}"
            case _:
                why = (
                    f"'{_short(piece)}' is not allowed; a formula has finite numbers, names, "
                    "+ - * / **, brackets and functions"
                )
        raise wrong(len(text.encode()[: node.col_offset].decode()), why)

    try:
        body = ast.parse(text, mode="eval").body
    except SyntaxError as error:
        place = (error.offset or 1) - 1
        raise wrong(place, f"it cannot be read at '{_short(text[place:], 20)}'") from None
    except (ValueError, RecursionError, MemoryError):
        raise ModelError("the formula holds a null letter, or too many brackets") from None
    try:
        return value(body)
    except RecursionError:
        raise ModelError("the formula holds too many brackets") from None


def check_names(names: Mapping[str, object], taken: tuple[str, ...]) -> None:
    """Checks that a formula can use names of parameters."""
    for name in names:
        if not name.isidentifier():
            raise ModelError(f"parameter '{name}': a name is a word such as r_1")
        if name in taken or name in CONSTANTS or name in _FUNCTIONS or name in _ROUGH:
            raise ModelError(f"parameter '{name}': in a formula this means something else")


def _short(text: str, letters: int = 60) -> str:
    return text if len(text) <= letters else f"{text[: letters - 3]}..."
