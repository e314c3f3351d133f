"""Arrays of numbers: checks of arguments, which raise ModelError, and formatting for messages."""

import re
from collections.abc import Iterable
from difflib import get_close_matches
from numbers import Integral, Real
from reprlib import Repr
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drake_dae.errors import ModelError

FloatArray = np.typing.NDArray[np.float64]

Booleans = np.typing.NDArray[np.bool_]

MEANINGFUL = 1e12
"""The largest meaningful number in a state, in any units."""


def all_finite(array: np.ndarray) -> bool:
    """Returns whether all numbers are finite; of a few, in less time than NumPy's `all`."""
    return bool(np.count_nonzero(np.isfinite(array)) == array.size)


def numbers(what: str, value: Any, error: type[Exception] = ModelError) -> FloatArray:
    """Converts real numbers to a new array; refuses text and masked entries, not nan and inf."""
    if type(value) is np.ndarray and value.dtype == np.float64:
        return value.copy()
    try:
        if np.ma.is_masked(value):
            raise error(f"{what} must be real numbers, and some entries are masked")
        # NumPy would read text, count True as 1, and drop imaginary parts.
        array = np.array(value)
        is_real = array.dtype.kind in "iuf" or (
            array.dtype.kind == "O"
            and all(isinstance(entry, Real) and not isinstance(entry, bool) for entry in array.flat)
        )
        if is_real:
            return array.astype(float, copy=False)
    except (TypeError, ValueError, OverflowError, RuntimeError, NotImplementedError):
        pass
    raise error(f"{what} must be real numbers, got {brief(value)}") from None


def number_in(text: str) -> float | None:
    """Returns the finite number that a text contains, as in JSON or with a sign; else None."""
    # Python's float also accepts "1_0", "nan" and digits of other alphabets.
    if not _NUMBER.fullmatch(text.strip(" \t")):
        return None
    value = float(text)
    return value if np.isfinite(value) else None


_NUMBER = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?")


def can_be_written(text: str) -> bool:
    """Returns whether a text can be written to a file: it must not contain a lone surrogate."""
    return text.isascii() or not any("\ud800" <= letter <= "\udfff" for letter in text)


def number(what: str, value: Any, error: type[Exception] = ModelError) -> float:
    """Converts a finite real number to a float."""
    array = numbers(what, value, error)
    if array.shape != () or not np.isfinite(array):
        raise error(f"{what} must be a finite number, got {brief(value)}")
    return float(array)


def positive(what: str, value: Any, error: type[Exception] = ModelError) -> float:
    """Converts a finite real number above 0 to a float."""
    checked = number(what, value, error)
    if checked <= 0.0:
        raise error(f"{what} must be positive, got {brief(value)}")
    return checked


def vector(
    what: str, value: Any, size: int | None, error: type[Exception] = ModelError
) -> FloatArray:
    """Converts finite real numbers to shape (size,); of any length if size is None."""
    array = numbers(what, value, error)
    if array.ndim != 1 or size not in (None, array.size) or not all_finite(array):
        expected = "one-dimensional" if size is None else f"of shape ({size},)"
        got = f"shape {array.shape}" if array.shape != (size,) else show(array)
        raise error(f"{what} must be finite and {expected}, got {got}")
    return array


def each(what: str, value: Any, size: int) -> FloatArray:
    """Converts finite numbers, one for each of `size` items or one for all, to shape (size,)."""
    array = numbers(what, value)
    if array.shape not in ((), (size,)) or not all_finite(array):
        raise ModelError(f"{what} must be a finite number or shape ({size},), got {brief(value)}")
    return np.broadcast_to(array, (size,)).copy()


def check_whole_number(what: str, value: Any, least: int) -> None:
    """Checks that a value is a whole number of at least `least`."""
    if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
        raise ModelError(f"{what} must be a whole number from {least}, got {brief(value)}")


def check_axes(name: str, axes: str, letters: str = "xyz") -> None:
    """Checks that a text has at least one letter, each once; ModelError if not."""
    if not axes or not set(axes) <= set(letters) or len(set(axes)) != len(axes):
        raise ModelError(f"{name} must be distinct letters of {', '.join(letters)}, got '{axes}'")


def unknown_name(kind: str, name: str, known: Iterable[str]) -> str:
    """A text such as "no frame 'tol'; did you mean 'tool'? there are base, tool"."""
    names = list(known)
    near = get_close_matches(str(name), names, n=1)
    hint = f"did you mean '{near[0]}'? " if near else ""
    return f"no {kind} '{name}'; {hint}there are {', '.join(names) or 'none'}"


def listed(names: Iterable[str], most: int = 8) -> str:
    """Formats names as "[a, b]"; a long list is cut, with the number of omitted names."""
    every = list(names)
    more = [f"... {len(every) - most} more"] if len(every) > most else []
    return f"[{', '.join([*every[:most], *more])}]"


_BRIEF = Repr()
_BRIEF.maxlevel, _BRIEF.maxlist, _BRIEF.maxtuple, _BRIEF.maxdict, _BRIEF.maxset = 3, 6, 6, 4, 4
_BRIEF.maxstring = _BRIEF.maxother = _BRIEF.maxlong = 60


def brief(value: Any) -> str:
    """Formats any value in one short line."""
    try:
        text = " ".join(_BRIEF.repr(value).split())
    except Exception:  # From a __repr__ of others.
        text = f"a {type(value).__name__}"
    if text.startswith("<"):  # A default __repr__, with the address only.
        return f"a {type(value).__name__}"
    return text if len(text) <= 200 else f"{text[:197]}..."


def show(array: ArrayLike) -> str:
    """Formats an array with four digits, in one line."""
    return np.array2string(
        np.asarray(array), precision=4, separator=", ", max_line_width=10**6, threshold=40
    )


def show_state(state: ArrayLike) -> str:
    """Formats a state: its numbers, or its largest magnitude if it has diverged."""
    values = np.asarray(state, dtype=float)
    largest = float(np.max(np.abs(values[np.isfinite(values)]), initial=0.0))
    return f"grown to {largest:.0e}" if largest > MEANINGFUL else show(values)


def by_columns(values: FloatArray) -> FloatArray:
    """Returns the columns of a table as contiguous rows, which NumPy sums many times faster."""
    return np.ascontiguousarray(values.T)
