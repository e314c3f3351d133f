"""Functions from users: their failures are reported as errors of the argument."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

from drake_dae.arrays import brief
from drake_dae.errors import DrakeDaeError, ModelError


def result_of(
    what: str,
    function: Callable[..., Any],
    *arguments: Any,
    error: Callable[[str], Exception] = ModelError,
) -> Any:
    """Calls a user's function; a failure is raised as an error of the argument."""
    try:
        return function(*arguments)
    except DrakeDaeError:
        raise
    except Exception as failure:
        text = f"{what} failed: {type(failure).__name__}: {brief(str(failure))}"
        raise error(text) from failure


@contextmanager
def numpy_explained(what: str) -> Iterator[None]:
    """Replaces CasADi's long warning about NumPy functions of symbols by one line, once."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield
    for warning in caught:
        text = str(warning.message)
        if warning.category is FutureWarning and "casadi" in text and "numpy" in text:
            _warn(what)
        else:
            warnings.warn_explicit(
                warning.message, warning.category, warning.filename, warning.lineno
            )


@cache
def _warn(what: str) -> None:
    warnings.warn(
        f"{what} calls a function of NumPy on CasADi symbols; write casadi.sin for numpy.sin, and "
        "likewise for others: CasADi is about to change what NumPy's give",
        stacklevel=2,
    )
