"""The scenario's key in errors."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from drake_dae.errors import AssumptionError, DrakeDaeError, ScenarioError

T = TypeVar("T")
S = TypeVar("S")


@contextmanager
def at(key: str) -> Iterator[None]:
    """Converts errors in the block to a ScenarioError with the key of the scenario."""
    try:
        yield
    except ScenarioError:
        raise  # It has a key already.
    except DrakeDaeError as error:
        raise ScenarioError((key, str(error))) from error


def each(key: str, items: Iterable[S], make: Callable[[S], T]) -> list[T]:
    """Applies a function to each item; errors get the key with the index of the item."""
    results = []
    for index, item in enumerate(items):
        with at(f"{key}.{index}"):
            results.append(make(item))
    return results


def violated(error: AssumptionError) -> ScenarioError:
    """The exception to raise for a scenario whose robot violates an assumption of the theory."""
    key = "constraints" if error.assumption <= 3 else "outputs"
    hint = "" if error.state is None else "; start.positions choose another start"
    return ScenarioError((key, f"{error}{hint}"))
