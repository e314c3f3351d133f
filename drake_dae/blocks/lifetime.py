"""Callbacks that let Python free a LeafSystem that is written in Python."""

from collections.abc import Callable
from functools import partial
from types import MethodType
from typing import Any
from weakref import proxy

from pydrake.systems.framework import BasicVector, Context

SHARED_DICTIONARY: tuple[str, ...] = ()
"""The `__slots__` of classes below LeafSystem: instances use the dictionary of Drake's class.

Otherwise a Python class adds a second reference to the same dictionary. CPython 3.11 then counts
its references twice, and never frees an object that is part of a cycle, as every system of a
diagram is.
"""


def weakly(method: Callable[..., Any], *first: Any) -> Callable[..., Any]:
    """A callback for Drake that does not keep its system alive.

    Drake stores callbacks in C++, which the garbage collector does not see: a bound method there
    would keep its system forever.

    Args:
        method: A method bound to its system.
        first: Its first arguments; Drake gives the others.
    """
    weak = MethodType(method.__func__, proxy(method.__self__))  # type: ignore[attr-defined]
    return partial(weak, *first) if first else weak


def port_value(method: Callable[..., Any], *first: Any) -> Callable[[Context, BasicVector], None]:
    """The calculation of a vector output port by a method that returns its value.

    Args:
        method: A method bound to its system; its last argument is the context.
        first: Its other arguments.
    """
    value = weakly(method, *first)

    def calculate(context: Context, output: BasicVector) -> None:
        output.SetFromVector(value(context))

    return calculate
