"""Checks the arguments of public functions and constructors by their annotations."""

import gc
import inspect
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import ContextDecorator
from functools import cache, wraps
from threading import Lock, get_ident
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arrays import all_finite, brief, number, numbers

F = TypeVar("F", bound=Callable[..., Any])


class _Uncollected(ContextDecorator):
    """Meanwhile no thread collects garbage by itself.

    CasADi builds and frees expressions without Python's lock, and these share their constants: a
    collection in another thread, such as one of a notebook or of Dask, can break what is built.
    """

    def __init__(self) -> None:
        self._lock, self._depth, self._was = Lock(), 0, False
        self._collector: int | None = None  # The thread that collects now.
        gc.callbacks.append(self._watch)

    def _watch(self, phase: str, _: object) -> None:
        self._collector = get_ident() if phase == "start" else None

    def __enter__(self) -> None:
        with self._lock:
            self._depth += 1
            if self._depth == 1:
                self._was = gc.isenabled()
                gc.disable()
        try:
            while self._collector not in (None, get_ident()):
                time.sleep(1e-3)
        except BaseException:  # Ctrl-C: nobody calls __exit__.
            self.__exit__()
            raise

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._depth -= 1
            if self._depth == 0 and self._was:
                gc.enable()


uncollected = _Uncollected()


def checked(error: Callable[[str], Exception], lasts: bool = False) -> Callable[[F], F]:
    """Decorates a public name so that arguments which do not match their annotations raise `error`.

    Of a class, the constructor and the class methods are decorated; what it makes keeps copies of
    the caller's arrays. Numbers must be finite; entries of lists and dictionaries are checked as
    well; defaults are always accepted. A check takes some 10 us: nothing that is called in a loop
    has one. Meanwhile garbage is `uncollected`, unless the function `lasts`.
    """

    def decorate(target: F) -> F:
        if not inspect.isclass(target):
            return _checked(target if lasts else uncollected(target), error, target.__qualname__)
        for name, member in list(vars(target).items()):
            if name == "__init__":
                setattr(target, name, _checked(uncollected(member), error, target.__name__))
            elif name[0] != "_" and isinstance(member, (classmethod, staticmethod)):
                made = uncollected(member.__func__)
                inner = _checked(made, error, f"{target.__name__}.{name}")
                setattr(target, name, type(member)(inner))
        return target

    return decorate


def _checked(function: F, error: Callable[[str], Exception], owner: str) -> F:
    parameters = inspect.signature(function).parameters
    names = [name for name, p in parameters.items() if p.kind is p.POSITIONAL_OR_KEYWORD]
    hints = cache(lambda: get_type_hints(function))  # They may refer to later definitions.

    @wraps(function)
    def call(*arguments: Any, **options: Any) -> Any:
        for name, value in (*zip(names, arguments, strict=False), *options.items()):
            if name not in hints() or value is parameters[name].default:
                continue
            if problems := _problems(hints()[name], value):
                place, _, wrong = max(problems, key=lambda problem: len(problem[0]))
                wanted = dict.fromkeys(words for where, words, _ in problems if where == place)
                text = f"{name}{place} must be {' or '.join(wanted)}, got {brief(wrong)}"
                raise error(f"{owner}: {text}")
        if function.__name__ == "__init__":
            arguments = tuple(map(_own, arguments))
            options = {name: _own(value) for name, value in options.items()}
        return function(*arguments, **options)

    return call  # type: ignore[return-value]


def _own(value: Any) -> Any:
    return value.copy() if isinstance(value, np.ndarray) else value


def _problems(hint: Any, value: Any, place: str = "") -> list[tuple[str, str, Any]]:
    """Where a value is not what an annotation says, what would be right there, and what it is."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType) and hint != ArrayLike:
        if set(parts) >= _ARRAY:
            parts = (ArrayLike, *(part for part in parts if part not in _ARRAY))
        found = [_problems(part, value, place) for part in parts]
        return [problem for one in found for problem in one] if all(found) else []
    kind = origin if inspect.isclass(origin) else object
    if issubclass(kind, Mapping):
        if not isinstance(value, Mapping):
            return [(place, "a dictionary", value)]
        pairs = [(parts[k], pair[k], f"[{pair[0]!r}]") for pair in value.items() for k in (0, 1)]
    elif issubclass(kind, Collection) and kind is not np.ndarray:
        count = None if kind is not tuple or parts[1:] == (...,) else len(parts)
        is_list = isinstance(value, Collection) and not isinstance(value, (str, bytes, Mapping))
        if not is_list or count not in (None, len(value)):
            return [(place, "a list" if count is None else f"{count} entries", value)]
        hints = parts if count else [parts[0]] * len(value)
        pairs = [(hints[k], entry, f"[{k}]") for k, entry in enumerate(value)]
    else:
        wanted, holds = _rule(hint)
        try:
            return [] if holds(value) else [(place, wanted, value)]
        except (ValueError, TypeError, OverflowError, RuntimeError):
            return [(place, wanted, value)]
    return [p for of, entry, at in pairs for p in _problems(of, entry, place + at)]


def _rule(hint: Any) -> tuple[str, Callable[[Any], object]]:
    """What a single value with an annotation has to be, and whether it is."""
    for key in (hint, get_origin(hint)):
        if key in _RULES:
            return _RULES[key]
    if get_origin(hint) is Literal:
        words = get_args(hint)
        return " or ".join(map(repr, words)), lambda v: isinstance(v, str) and v in words
    if hint is Any or not inspect.isclass(hint):  # Any is a class, too.
        return "anything", lambda v: True
    return f"a {hint.__name__}", lambda v: isinstance(v, hint)


def _is_whole(value: Any) -> bool:
    """Whether a float holds it exactly, too: loops over larger numbers would not end."""
    is_integer = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    return is_integer and abs(int(value)) <= 2**53


_ARRAY = set(get_args(ArrayLike)) or {ArrayLike}  # A union, or in newer NumPy an alias.
_RULES: dict[Any, tuple[str, Callable[[Any], object]]] = {
    ArrayLike: ("finite real numbers", lambda v: all_finite(numbers("", v, ValueError))),
    np.ndarray: ("an array of numbers", lambda v: np.asarray(v).dtype.kind in "biufc"),
    float: ("a finite number", lambda v: number("", v, ValueError) is not None),
    int: ("a whole number", _is_whole),
    str: ("text", lambda v: isinstance(v, str)),
    bool: ("True or False", lambda v: isinstance(v, bool)),
    NoneType: ("None", lambda v: v is None),
    Callable: ("a function", callable),
    ca.SX: (
        "a CasADi SX expression",
        lambda v: isinstance(v, (ca.SX, ca.DM)) or numbers("", v, ValueError) is not None,
    ),
}
