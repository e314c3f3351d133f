"""Callbacks that let Python free a LeafSystem that is written in Python."""

from collections.abc import Callable
from functools import partial
from types import MethodType
from typing import Any
from weakref import proxy

SHARED_DICTIONARY: tuple[str, ...] = ()
"""The `__slots__` of classes below LeafSystem: instances use the dictionary of Drake's class.

Otherwise a Python class adds a second reference to the same dictionary. CPython 3.11 then counts
its references twice, and never frees an object that is part of a cycle, as every system of a
diagram is.
"""


def weakly(method: Callable[..., Any], *first: Any) -> Callable[..., Any]:
    """A callback by a bound method, which Drake stores in C++ without keeping its system alive."""
    weak = MethodType(method.__func__, proxy(method.__self__))  # type: ignore[attr-defined]
    return partial(weak, *first) if first else weak
