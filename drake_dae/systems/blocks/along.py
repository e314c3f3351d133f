"""What ports showed in a run, from what was logged of it: nothing is computed twice in the run."""

from collections.abc import Callable, Mapping
from contextlib import suppress

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.errors import DrakeDaeError
from drake_dae.trace.functions import TracedFunction


def function_along(
    function: TracedFunction,
    given: Mapping[str, FloatArray],
    otherwise: Callable[[tuple[FloatArray, ...]], tuple[FloatArray, ...] | None] | None = None,
) -> FloatArray:
    """The first value of a function at each moment; nan where it has none.

    Args:
        function: The function.
        given: Name of an input -> its values, one row for each moment; more than the function
            takes do no harm.
        otherwise: What may know the values, of such inputs, where the function has none.

    Returns:
        One row for each moment.
    """
    arguments = [given[name] for name in function.input_names]
    rows = np.full((len(arguments[0]), function.nowhere()[0].size), np.nan)
    evaluate = function.evaluate
    for row, moment in zip(rows, zip(*arguments, strict=True), strict=True):
        values: tuple[FloatArray, ...] | None = evaluate(*moment)
        if not function.is_valid:
            values = otherwise(moment) if otherwise else None
        if values is not None:
            row[:] = values[0]
    return rows


def signal_along(signal: Callable[[float], FloatArray], size: int, times: FloatArray) -> FloatArray:
    """A function of time at each moment; nan where it fails.

    Args:
        signal: Time in s -> values, such as `ReferenceGenerator.reference`.
        size: How many values it has.
        times: The moments, in s.

    Returns:
        One row for each moment.
    """
    rows = np.full((times.size, size), np.nan)
    for row, time in zip(rows, times.tolist(), strict=True):
        with suppress(DrakeDaeError):
            row[:] = signal(time)
    return rows
