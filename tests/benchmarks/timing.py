"""Least times of calls, in turn; and of functions from Python, as machine code and in C."""

import timeit
from collections.abc import Callable
from contextlib import suppress

import casadi as ca
import numpy as np

from drake_dae.errors import MachineCodeError
from drake_dae.trace.compiled import find_compiler, generate, library, without_branches
from drake_dae.trace.functions import TracedFunction

STATES = 200


def race(functions: dict[str, Callable], rounds: int = 300, number: int = 20) -> dict[str, float]:
    """Least times of a call in s, each in turn, so that all meet the same moods of the machine.

    A turn is shorter than what a system lets run at once, so that one of them is undisturbed.
    """
    best = dict.fromkeys(functions, np.inf)
    for _ in range(rounds):
        for name, function in functions.items():
            best[name] = min(best[name], timeit.timeit(function, number=number) / number)
    return best


def has_compiler() -> bool:
    with suppress(MachineCodeError):
        return bool(find_compiler())
    return False


def prebound(function: ca.Function, *arguments) -> Callable:
    """A CasADi function as a call without arguments."""
    buffer, evaluate = function.buffer()
    arrays = [np.asfortranarray(np.array(value, dtype=float)) for value in arguments]
    results = [np.zeros(function.size_out(i), order="F") for i in range(function.n_out())]
    for i, array in enumerate(arrays):
        buffer.set_arg(i, array.reshape(-1, order="F").data)
    for i, array in enumerate(results):
        buffer.set_res(i, array.reshape(-1, order="F").data)
    return lambda: (evaluate(), arrays, results, buffer)[0]


def calls(functions: list[TracedFunction], *arguments) -> dict[str, Callable]:
    """A function called from Python, interpreted and as machine code; and a loop of it in C.

    Args:
        functions: The same with compiled=False and with compiled=True.
        arguments: Arrays that it is called with.
    """
    function, code = functions
    found = {"interpreted": lambda: function.evaluate(*arguments)}
    if has_compiler():
        code(*arguments)
        assert code.is_machine_code
        found["machine code"] = lambda: code.evaluate(*arguments)
        many = function.function.map(STATES)
        source = without_branches(generate(many))
        path = library(source, function.num_operations, True, True)
        columns = [np.tile(np.reshape(value, (-1, 1)), STATES) for value in arguments]
        found["in C"] = prebound(ca.external(many.name(), str(path)), *columns)
    return found


def times(found: dict[str, Callable]) -> dict[str, float]:
    """Their least times of a call, in s; of the loop in C that of one state."""
    many = {name: found.pop(name) for name in list(found) if name == "in C"}
    return race(found) | {name: took / STATES for name, took in race(many, number=1).items()}
