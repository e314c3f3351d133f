"""Checks the arguments of public functions and classes by their annotations."""

import inspect
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import reduce, wraps
from math import isfinite
from numbers import Complex, Integral, Real
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_dae.arrays import all_finite, brief, numbers

F = TypeVar("F", bound=Callable[..., Any])


class _Rule(NamedTuple):
    """The condition that an annotation imposes on a value.

    Attributes:
        words: The condition in words, after "must be".
        holds: Whether a value satisfies it, regardless of the parts of a container.
        inside: (place, value, rule) of the parts of a container.
        is_of_type: Whether the condition depends only on the type of the value.
    """

    words: str
    holds: Callable[[Any], bool]
    inside: Callable[[str, Any], Iterator[tuple[str, Any, "_Rule"]]] | None = None
    is_of_type: bool = False


def checked(error: Callable[[str], Exception]) -> Callable[[F], F]:
    """Decorates a function so that arguments which do not match their annotations raise an error.

    Of a class, the constructor and the public methods are decorated. A number must be finite and
    not a bool, arrays must consist of such numbers, text is no list of letters, and the entries of
    lists and mappings are checked as well. Shapes and ranges are left to the function. The default
    of an argument is always accepted.

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
            elif name[0].islower() and isinstance(member, (classmethod, staticmethod)):
                inner = _checked(member.__func__, error, f"{target.__name__}.{name}")
                setattr(target, name, type(member)(inner))
            elif name[0].islower() and inspect.isfunction(member):
                setattr(target, name, _checked(member, error, f"{target.__name__}.{name}"))
        return target

    return decorate


def _checked(function: F, error: Callable[[str], Exception], owner: str) -> F:
    rules: list[tuple[str, _Rule, Any]] = []
    named: dict[str, tuple[str, _Rule, Any]] = {}
    rest: list[tuple[str, _Rule, Any]] = []

    def read() -> None:
        """Reads the annotations when they are needed, since they may refer to later definitions."""
        hints = get_type_hints(function)
        for name, parameter in inspect.signature(function).parameters.items():
            entry = (name, _rule(hints.get(name, Any)), parameter.default)
            if parameter.kind is parameter.VAR_POSITIONAL:
                rest.append(entry)
            elif parameter.kind is not parameter.VAR_KEYWORD:
                named[name] = entry
                if parameter.kind is not parameter.KEYWORD_ONLY:
                    rules.append(entry)

    valid: set[tuple[str, type]] = set()  # Arguments with types that are known to be valid.

    def check(entry: tuple[str, _Rule, Any], value: Any) -> None:
        name, rule, default = entry
        if value is default or (name, type(value)) in valid:
            return
        wrong = _wrong(name, value, rule)
        if wrong:
            raise error(f"{owner}: {wrong}")
        if rule.is_of_type:
            valid.add((name, type(value)))

    @wraps(function)
    def call(*arguments: Any, **options: Any) -> Any:
        if not named:
            read()
        for entry, value in zip(rules, arguments, strict=False):
            if (entry[0], type(value)) not in valid:  # As `check` does, without a call.
                check(entry, value)
        for entry in rest:
            for value in arguments[len(rules) :]:
                check(entry, value)
        for name, value in options.items():
            if name in named:
                check(named[name], value)
        return function(*arguments, **options)

    return call  # type: ignore[return-value]


def _wrong(what: str, value: Any, rule: _Rule) -> str:
    """A text on what is wrong with a value; empty if it is valid."""
    if not rule.holds(value):
        return f"{what} must be {rule.words}, got {brief(value)}{_hint(value, rule)}"
    for place, part, inner in rule.inside(what, value) if rule.inside else ():
        wrong = _wrong(place, part, inner)
        if wrong:
            return wrong
    return ""


def _hint(value: Any, rule: _Rule) -> str:
    """A hint if an attribute of the value would be valid; otherwise empty."""
    names = ("dae", "system", "model", "diagram", "links")
    parts = vars(value) if hasattr(value, "__dict__") and not inspect.isclass(value) else {}
    valid = [name for name in names if name in parts and rule.holds(parts[name])]
    return f"; pass its .{valid[0]}" if valid else ""


_ARRAY = set(get_args(ArrayLike)) or {ArrayLike}  # A union, or in newer NumPy an alias.


def _rule(hint: Any) -> _Rule:
    """The rule of an annotation."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _rule(arguments[0])
    if origin is Literal:
        return _Rule(
            " or ".join(map(repr, arguments)),
            lambda value: isinstance(value, str) and value in arguments,
        )
    if origin in (Union, UnionType):
        return _any_of(set(arguments), arguments)
    if hint is ArrayLike:
        return _ARRAYS
    if hint in _PLAIN:
        return _PLAIN[hint]
    if origin is np.ndarray or origin is NDArray:
        return _NUMBERS
    if origin is tuple and arguments[1:] != (...,):
        return _tuple(arguments)
    if inspect.isclass(origin) and issubclass(origin, Mapping):
        return _mapping(_rule(arguments[0]), _rule(arguments[1]))
    if inspect.isclass(origin) and issubclass(origin, Collection):
        return _list(_rule(arguments[0]))
    if origin is not None and hint is not Any and origin in (Callable, _CALLABLE):
        return _Rule("a function", callable)
    if getattr(hint, "_is_protocol", False):
        return _protocol(hint)
    if inspect.isclass(hint) and hint is not Any:
        return _Rule(_article(hint.__name__), lambda value: isinstance(value, hint), None, True)
    return _Rule("anything", lambda value: True, None, True)


_CALLABLE = get_origin(Callable[[], None])


def _any_of(members: set[Any], order: Sequence[Any]) -> _Rule:
    """The rule of a Union: at least one of several rules holds."""
    rules = []
    if members >= _ARRAY:
        rules.append(_ARRAYS)
        members = members - _ARRAY
    rules += [_rule(member) for member in order if member in members]
    words = " or ".join(dict.fromkeys(rule.words for rule in rules))

    def inside(what: str, value: Any) -> Iterator[tuple[str, Any, _Rule]]:
        fits = [rule for rule in rules if rule.holds(value)]
        if all(_wrong(what, value, rule) for rule in fits):
            yield what, value, fits[0]

    has_parts = any(rule.inside for rule in rules)

    is_of_type = all(rule.is_of_type for rule in rules)
    holds = reduce(_either, [rule.holds for rule in rules])
    return _Rule(words, holds, inside if has_parts else None, is_of_type)


def _either(first: Callable[[Any], bool], second: Callable[[Any], bool]) -> Callable[[Any], bool]:
    """Whether one of two holds; thrice as fast as any() of a generator."""
    return lambda value: first(value) or second(value)


def _list(entry: _Rule) -> _Rule:
    def inside(what: str, value: Any) -> Iterator[tuple[str, Any, _Rule]]:
        return ((f"{what}[{index}]", part, entry) for index, part in enumerate(value))

    # Also sets and views of dictionaries; not generators, which can be read only once.
    return _Rule(
        "a list",
        lambda value: (
            isinstance(value, (Collection, np.ndarray))
            and not isinstance(value, (str, bytes, Mapping))
            and np.ndim(value if isinstance(value, np.ndarray) else [0]) > 0
        ),
        inside,
    )


def _tuple(entries: tuple[Any, ...]) -> _Rule:
    if set(entries) == {float}:
        count = {2: "two", 3: "three"}.get(len(entries), len(entries))
        words = f"{count} finite numbers"
        return _Rule(words, lambda value: _is_array(value) and np.shape(value) == (len(entries),))
    rules = [_rule(entry) for entry in entries]
    words = f"({', '.join(rule.words for rule in rules)})"

    def inside(what: str, value: Any) -> Iterator[tuple[str, Any, _Rule]]:
        parts = enumerate(zip(value, rules, strict=True))
        return ((f"{what}[{index}]", part, rule) for index, (part, rule) in parts)

    return _Rule(
        words, lambda value: isinstance(value, (list, tuple)) and len(value) == len(rules), inside
    )


def _mapping(key: _Rule, entry: _Rule) -> _Rule:
    def inside(what: str, value: Any) -> Iterator[tuple[str, Any, _Rule]]:
        for name, part in value.items():
            yield f"a key of {what}", name, key
            if _wrong(what, part, entry):
                yield f"{what}[{brief(name)}]", part, entry

    return _Rule("a dictionary", lambda value: isinstance(value, Mapping), inside)


def _protocol(protocol: Any) -> _Rule:
    """The rule that a value has the members of a protocol."""
    bases = [base for base in protocol.__mro__ if getattr(base, "_is_protocol", False)]
    members = {
        name
        for base in bases
        for name in (*vars(base), *vars(base).get("__annotations__", {}))
        if not name.startswith("_")
    }

    def holds(value: Any) -> bool:
        if inspect.isclass(value):
            return False
        return all(
            inspect.getattr_static(value, name, None) is not None or hasattr(value, name)
            for name in members
        )

    return _Rule(_article(protocol.__name__), holds)


def _article(name: str) -> str:
    return f"{'an' if name[0] in 'AEIOU' and not name.startswith('Uni') else 'a'} {name}"


def _is_bool(value: Any) -> bool:
    return isinstance(value, (bool, np.bool_))


def _is_array(value: Any, finite: bool = True) -> bool:
    if type(value) is np.ndarray and value.dtype.kind == "f":  # The most frequent, at once.
        return not finite or all_finite(value)
    try:
        array = numbers("", value, ValueError)
    except ValueError:
        return False
    return not finite or bool(np.isfinite(array).all())


def _is_real(value: Any) -> bool:
    if not isinstance(value, Real) or _is_bool(value):
        return False
    try:
        return isfinite(value)
    except OverflowError:  # An int above 1e308.
        return False


def _is_whole(value: Any) -> bool:
    # Those that a float represents exactly; loops over larger ones would not end.
    return isinstance(value, Integral) and not _is_bool(value) and abs(int(value)) <= 2**53


def _is_expression(value: Any) -> bool:
    return isinstance(value, (ca.SX, ca.DM)) or _is_array(value, finite=False)


_NUMBERS = _Rule(
    "numbers",
    lambda value: (
        value.dtype.kind in "biufc" if type(value) is np.ndarray else _is_array(value, finite=False)
    ),
)
_ARRAYS = _Rule("finite real numbers", _is_array)
_PLAIN = {
    float: _Rule("a finite number", _is_real),
    int: _Rule("a whole number", _is_whole),
    bool: _Rule("True or False", _is_bool, None, True),
    complex: _Rule(
        "a finite number",
        lambda value: (
            _is_real(value)
            if isinstance(value, Real)
            else isinstance(value, Complex) and isfinite(abs(complex(value)))
        ),
    ),
    str: _Rule("text", lambda value: isinstance(value, str), None, True),
    NoneType: _Rule("None", lambda value: value is None, None, True),
    ca.SX: _Rule("a CasADi SX expression", _is_expression),
}
