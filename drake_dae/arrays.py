"""Arrays of numbers: how arguments are checked, and how messages show them."""

from collections.abc import Iterable
from difflib import get_close_matches
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drake_dae.errors import ModelError

FloatArray = np.typing.NDArray[np.float64]

Booleans = np.typing.NDArray[np.bool_]


def numbers(what: str, value: Any, error: type[Exception] = ModelError) -> FloatArray:
    """Real numbers as a new array; they need not be finite.

    Args:
        what: How a message calls them.
        value: The numbers, in any shape.
        error: The class of exception to raise.

    Raises:
        ModelError: The value holds something else, or rows of different lengths.
    """
    try:
        if np.iscomplexobj(value):  # NumPy would drop the imaginary parts.
            raise TypeError
        return np.array(value, dtype=float)
    except (TypeError, ValueError):
        raise error(f"{what} must be real numbers, got {value!r}") from None


def vector(
    what: str, value: Any, size: int | None, error: type[Exception] = ModelError
) -> FloatArray:
    """Finite real numbers as a new array of shape (size,), or of any length if size is None.

    Raises:
        ModelError: The numbers have another shape, or one of them is not finite.
    """
    array = numbers(what, value, error)
    if array.ndim != 1 or size not in (None, array.size) or not np.all(np.isfinite(array)):
        expected = "one-dimensional" if size is None else f"of shape ({size},)"
        got = f"shape {array.shape}" if array.shape != (size,) else show(array)
        raise error(f"{what} must be finite and {expected}, got {got}")
    return array


def check_whole_number(what: str, value: Any, least: int) -> None:
    """Refuses what is no whole number that is at least `least`.

    Raises:
        ModelError: The value is too small, or no whole number.
    """
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ModelError(f"{what} must be a whole number from {least}, got {value!r}")


def check_axes(name: str, axes: str) -> None:
    """Refuses what is not distinct letters of "xyz".

    Raises:
        ModelError: A letter is another one, or stands twice, or there is none.
    """
    if not axes or any(a not in "xyz" for a in axes) or len(set(axes)) != len(axes):
        raise ModelError(f"{name} must be distinct letters of x, y, z, got '{axes}'")


def unknown_name(kind: str, name: str, known: Iterable[str]) -> str:
    """What a message says of a name that is not among those that are known.

    Args:
        kind: What the name should belong to, for example "frame".
        name: The one that was given.
        known: Those that would do.

    Returns:
        A text such as "no frame 'tol'; did you mean 'tool'? there are base, tool".
    """
    names = list(known)
    near = get_close_matches(str(name), names, n=1)
    hint = f"did you mean '{near[0]}'? " if near else ""
    return f"no {kind} '{name}'; {hint}there are {', '.join(names) or 'none'}"


def show(array: ArrayLike) -> str:
    """An array in a message: four digits, in one line."""
    return np.array2string(
        np.asarray(array), precision=4, separator=", ", max_line_width=10**6, threshold=40
    )
