"""What lets Python free a LeafSystem that is written in Python, and with it what it holds."""

from collections.abc import Callable
from functools import partial
from types import MethodType
from typing import Any
from weakref import proxy

SHARED_DICTIONARY: tuple[str, ...] = ()
"""The `__slots__` of classes below LeafSystem: instances have the dictionary of Drake's class.

A Python class adds one of its own otherwise, which is the same; CPython 3.11 then visits it twice
when it counts references, finds more than there are, and keeps for ever whatever is part of a
cycle, as every system of a diagram is.
"""


def weakly(method: Callable[..., Any], *first: Any) -> Callable[..., Any]:
    """A method for Drake to call, which does not keep its system alive.

    Drake holds what is declared in C++, where the garbage collector does not look: a bound method
    there would keep its system for ever.

    Args:
        method: Bound to its system.
        first: Its first arguments; Drake gives the others.
    """
    weak = MethodType(method.__func__, proxy(method.__self__))  # type: ignore[attr-defined]
    return partial(weak, *first) if first else weak
