"""Checks the arguments of public functions and constructors by their annotations."""

import inspect
from collections.abc import Callable, Collection, Mapping
from functools import wraps
from numbers import Complex
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydantic import BeforeValidator, TypeAdapter, ValidationError

from drake_dae.arrays import all_finite, brief, number, numbers

F = TypeVar("F", bound=Callable[..., Any])

_ARRAY = set(get_args(ArrayLike)) or {ArrayLike}  # A union, or in newer NumPy an alias.


def checked(error: Callable[[str], Exception]) -> Callable[[F], F]:
    """Decorates a public name so that arguments which do not match their annotations raise.

    Of a class, the constructor and the class methods are decorated. A number must be finite and not
    a bool, arrays must consist of such numbers, text is no list of letters, and the entries of
    lists and dictionaries are checked as well. Shapes and ranges are left to the function. A
    default is always accepted. A check takes some 20 us: nothing that is called in a loop has one.

    Args:
        error: The exception, or a function that makes it of a text "<function>: <argument> must be
            <condition>, got <value>".
    """

    def decorate(target: F) -> F:
        if not inspect.isclass(target):
            return _checked(target, error, target.__qualname__)
        for name, member in list(vars(target).items()):
            if name == "__init__":
                setattr(target, name, _checked(member, error, target.__name__))
            elif name[0] != "_" and isinstance(member, (classmethod, staticmethod)):
                inner = _checked(member.__func__, error, f"{target.__name__}.{name}")
                setattr(target, name, type(member)(inner))
        return target

    return decorate


def _checked(function: F, error: Callable[[str], Exception], owner: str) -> F:
    parameters = inspect.signature(function).parameters
    checks: dict[str, Callable[[Any], Any]] = {}

    @wraps(function)
    def call(*arguments: Any, **options: Any) -> Any:
        if not checks:  # Not earlier, since annotations may refer to later definitions.
            hints = get_type_hints(function)
            for name, parameter in parameters.items():
                if parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
                    checks[name] = TypeAdapter(_type(hints.get(name, Any))).validate_python
        for name, value in (*zip(checks, arguments, strict=False), *options.items()):
            if name not in checks or value is parameters[name].default:
                continue
            try:
                checks[name](value)
            except ValidationError as wrong:
                raise error(f"{owner}: {name}{_in_words(wrong, value)}") from None
        return function(*arguments, **options)

    return call  # type: ignore[return-value]


def _in_words(wrong: ValidationError, value: Any) -> str:
    """The place of the first wrong entry, what would be right there, and what it is."""
    problems = wrong.errors(include_url=False)
    deepest = max(len(problem["loc"]) for problem in problems)
    problems = [problem for problem in problems if len(problem["loc"]) == deepest]
    # Besides the indices and keys there are the names of the members of a union.
    known = [str(key) for key in value] if isinstance(value, Mapping) else []
    parts = (part for part in problems[0]["loc"] if isinstance(part, int) or part in known)
    place = "".join(f"[{part!r}]" for part in parts)
    texts = (problem["msg"] for problem in problems)
    needed = (t.removeprefix("Value error, ").removeprefix("Input should be ") for t in texts)
    return (
        f"{place} must be {' or '.join(dict.fromkeys(needed))}, got {brief(problems[0]['input'])}"
    )


def _type(hint: Any) -> Any:
    """The type by which pydantic validates what has an annotation."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _type(parts[0])
    if hint in _NUMBERS:
        return _NUMBERS[hint]
    if origin in (Union, UnionType):
        arrays = _ARRAY if set(parts) >= _ARRAY else set()
        kinds = [ArrayLike] * bool(arrays) + [part for part in parts if part not in arrays]
        return Union[tuple(map(_type, kinds))]  # noqa: UP007 (it is made of a tuple)
    if origin is np.ndarray:
        return _such("an array of numbers", lambda v: np.asarray(v).dtype.kind in "biufc")
    if origin is tuple and set(parts) == {float}:
        return _such(f"{len(parts)} finite numbers", lambda v: _finite(v).shape == (len(parts),))
    if origin is tuple and parts[1:] != (...,):
        return tuple.__class_getitem__(tuple(map(_type, parts)))
    if inspect.isclass(origin) and issubclass(origin, Mapping):
        key, value = map(_type, parts)
        return _of(Mapping, "a dictionary", dict, dict[key, value])  # type: ignore[valid-type]
    if inspect.isclass(origin) and issubclass(origin, Collection):
        (entry,) = map(_type, parts[:1])
        return _of(Collection, "a list", list, list[entry])  # type: ignore[valid-type]
    if origin is Literal or hint is type(None):
        return hint
    if origin is Callable:
        return _such("a function", callable)
    is_untold = getattr(hint, "_is_protocol", False) and not hint._is_runtime_protocol
    if hint is Any or not inspect.isclass(hint) or is_untold:
        return Any
    article = "an" if hint.__name__[0] in "AEIO" else "a"
    name = {str: "text", bool: "True or False"}.get(hint, f"{article} {hint.__name__}")
    return _such(name, lambda value: isinstance(value, hint))


def _such(words: str, holds: Callable[[Any], object]) -> Any:
    """The type of values for which a condition holds."""

    def check(value: Any) -> Any:
        try:
            if holds(value):
                return value
        except (ValueError, TypeError, OverflowError, RuntimeError):
            pass
        raise ValueError(words)

    return Annotated[Any, BeforeValidator(check)]


def _of(kind: type, words: str, convert: Callable[[Any], Any], entries: Any) -> Any:
    """The type of a container; text is no list, and a generator can be read only once."""

    def check(value: Any) -> Any:
        refused = () if kind is Mapping else (str, bytes, Mapping)
        if isinstance(value, kind) and not isinstance(value, refused):
            return convert(value)
        raise ValueError(words)

    return Annotated[entries, BeforeValidator(check)]


def _finite(value: Any) -> np.ndarray:
    array = numbers("", value, ValueError)
    if not all_finite(array):
        raise ValueError
    return array


_NUMBERS = {
    ArrayLike: _such("finite real numbers", lambda v: _finite(v) is not None),
    float: _such("a finite number", lambda v: number("", v, ValueError) is not None),
    # Those that a float represents exactly; loops over larger ones would not end.
    int: _such(
        "a whole number",
        lambda v: isinstance(v, (int, np.integer)) and type(v) is not bool and abs(int(v)) <= 2**53,
    ),
    complex: _such("a finite number", lambda v: isinstance(v, Complex) and np.isfinite(complex(v))),
    ca.SX: _such(
        "a CasADi SX expression",
        lambda v: isinstance(v, (ca.SX, ca.DM)) or numbers("", v, ValueError) is not None,
    ),
}
"""Types of numbers and arrays: those of NumPy and CasADi are none of pydantic's."""
