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

_FUNCTIONS: dict[str, tuple[int, Callable[..., ca.SX]]] = {
    **{
        name: (1, getattr(ca, name))
        for name in (
            *("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh"),
            *("asinh", "acosh", "atanh", "exp", "log", "sqrt", "erf"),
        )
    },
    "atan2": (2, ca.atan2),
}
"""Name -> number of arguments, and the function."""

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
    formula = _FormulaReader(" ".join(text.split()), symbols)
    if not formula.text:
        raise ModelError("the formula is empty; write one such as z - 0.1*sin(x)")
    try:
        tree = ast.parse(formula.text, mode="eval")
    except SyntaxError as error:
        place = (error.offset or 1) - 1
        rest = _short(formula.text[place:], 20) or "its end"
        raise formula.error(f"it cannot be read at '{rest}'", place) from None
    except (ValueError, RecursionError, MemoryError):
        raise ModelError("the formula holds a null letter, or too many brackets") from None
    try:
        return formula.value(tree.body)
    except RecursionError:
        raise ModelError("the formula holds too many brackets") from None


def check_names(names: Mapping[str, object], taken: tuple[str, ...]) -> None:
    """Checks that a formula can use names of parameters."""
    for name in names:
        if not name.isidentifier():
            raise ModelError(f"parameter '{name}': a name is a word such as r_1")
        if name in taken or name in CONSTANTS or name in _FUNCTIONS or name in _ROUGH:
            raise ModelError(f"parameter '{name}': in a formula this means something else")


class _FormulaReader:
    """A formula on one line, with the expressions of its names."""

    def __init__(self, text: str, symbols: Mapping[str, ca.SX]) -> None:
        self.text = text
        self._names = {**CONSTANTS, **symbols}

    def error(self, what: str, place: int) -> ModelError:
        """Returns an error at a position of the text, counted from 0."""
        return ModelError(f"formula '{_short(self.text)}', column {place + 1}: {what}")

    def value(self, node: ast.expr) -> ca.SX:
        """Returns the expression of a part of the text."""
        if isinstance(node, ast.Constant) and type(node.value) in (int, float):
            return self._number(node)
        if isinstance(node, ast.Name):
            if node.id not in self._names:
                raise self._wrong(node, self._unknown(node.id))
            return ca.SX(self._names[node.id])
        if isinstance(node, ast.BinOp) and type(node.op) in _OPERATORS:
            return _OPERATORS[type(node.op)](self.value(node.left), self.value(node.right))
        if isinstance(node, ast.UnaryOp) and type(node.op) in _OPERATORS:
            return _OPERATORS[type(node.op)](self.value(node.operand))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            return self._call(node, node.func.id)
        raise self._wrong(node, f"'{self._piece(node)}' {self._remedy(node)}")

    def _number(self, node: ast.Constant) -> ca.SX:
        # Python also accepts 1_000 and 0x10, and makes numbers that are too large infinite.
        number = number_in(ast.get_source_segment(self.text, node) or "")
        if number is None:
            raise self._wrong(node, f"{self._piece(node)} is no number, or is too large a number")
        return ca.SX(number)

    def _call(self, node: ast.Call, name: str) -> ca.SX:
        if name in _ROUGH:
            raise self._wrong(node, f"'{self._piece(node)}' {_SMOOTH_INSTEAD}")
        if name not in _FUNCTIONS:
            raise self._wrong(node, unknown_name("function", name, _FUNCTIONS))
        count, function = _FUNCTIONS[name]
        if len(node.args) != count or node.keywords:
            words = "one value" if count == 1 else f"{count} values"
            raise self._wrong(node, f"{name} takes {words}, got '{self._piece(node)}'")
        return function(*(self.value(argument) for argument in node.args))

    def _unknown(self, name: str) -> str:
        if name in _FUNCTIONS:
            return f"'{name}' is a function and takes brackets, {name}(x)"
        return unknown_name("name", name, self._names)

    def _wrong(self, node: ast.expr, what: str) -> ModelError:
        return self.error(what, len(self.text.encode()[: node.col_offset].decode()))

    def _piece(self, node: ast.expr) -> str:
        return _short(ast.get_source_segment(self.text, node) or "")

    @staticmethod
    def _remedy(node: ast.expr) -> str:
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.BitXor):
            return "has ^; a power is x**2"
        if isinstance(node, (ast.Compare, ast.IfExp, ast.BoolOp)):
            return _SMOOTH_INSTEAD
        return "is not allowed; a formula has numbers, names, + - * / **, brackets and functions"


def _short(text: str, letters: int = 60) -> str:
    return text if len(text) <= letters else f"{text[: letters - 3]}..."
