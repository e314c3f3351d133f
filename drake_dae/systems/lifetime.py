"""What lets Python free a LeafSystem that is written in Python, and with it what it holds."""

from collections.abc import Callable
from typing import Any
from weakref import ref

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
    owner, function = ref(method.__self__), method.__func__  # type: ignore[attr-defined]

    def call(*others: Any) -> Any:
        return function(owner(), *first, *others)

    return call
