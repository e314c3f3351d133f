"""The values of output ports after a run, computed from its log."""

from collections.abc import Callable, Mapping
from contextlib import suppress

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.errors import DrakeDaeError
from drake_dae.trace.functions import TracedFunction


def function_along(function: TracedFunction, given: Mapping[str, FloatArray]) -> FloatArray:
    """The first value of a function at each time, one row each; nan without a value.

    Args:
        function: The function.
        given: Name of an input -> its values, one row for each time; further names are ignored.
    """
    arguments = [given[name] for name in function.input_names]
    rows = np.full((len(arguments[0]), function.nowhere()[0].size), np.nan)
    evaluate = function.evaluate
    for row, inputs in zip(rows, zip(*arguments, strict=True), strict=True):
        values = evaluate(*inputs)
        if function.is_valid:
            row[:] = values[0]
    return rows


def signal_along(signal: Callable[[float], FloatArray], size: int, times: FloatArray) -> FloatArray:
    """A function of time at each time, one row each; nan where it fails.

    Args:
        signal: Time in s -> values, such as `ReferenceGenerator.reference`.
        size: The number of values.
        times: The times, in s.
    """
    rows = np.full((times.size, size), np.nan)
    for row, time in zip(rows, times.tolist(), strict=True):
        with suppress(DrakeDaeError):
            row[:] = signal(time)
    return rows
