"""Arrays of numbers, and the checks that everything shares."""

from collections.abc import Iterable
from difflib import get_close_matches
from typing import Any

import numpy as np

from drake_dae.errors import ModelError

FloatArray = np.typing.NDArray[np.float64]


def numbers(what: str, value: Any) -> FloatArray:
    """Real numbers as a new array.

    Raises:
        ModelError: What is something else.
    """
    try:
        if np.iscomplexobj(value):  # NumPy would drop the imaginary parts.
            raise TypeError
        return np.array(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise ModelError(f"{what} must be real numbers, got {value!r}") from error


def check_whole_number(what: str, value: Any, least: int) -> None:
    """Refuses what is no whole number from a least one.

    Raises:
        ModelError: So.
    """
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ModelError(f"{what} must be a whole number from {least}, got {value!r}")


Booleans = np.typing.NDArray[np.bool_]


def show(state: FloatArray) -> str:
    """A state in a message."""
    return np.array2string(state, precision=4, separator=", ", max_line_width=10**6)


def check_axes(name: str, axes: str) -> None:
    """Refuses what is not distinct letters of "xyz".

    Raises:
        ModelError: So.
    """
    if not axes or any(a not in "xyz" for a in axes) or len(set(axes)) != len(axes):
        raise ModelError(f"{name} must be distinct letters of x, y, z, got '{axes}'")


def unknown_name(kind: str, name: str, known: Iterable[str]) -> str:
    """A message about a name that nothing bears: what is near it, and what there is.

    Args:
        kind: What the name should be of, as "frame".
        name: The unknown name.
        known: Names that exist.
    """
    names = list(known)
    near = get_close_matches(name, names, n=1)
    hint = f"did you mean '{near[0]}'? " if near else ""
    return f"no {kind} '{name}'; {hint}there are {', '.join(names) or 'none'}"
