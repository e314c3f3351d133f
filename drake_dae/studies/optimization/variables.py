"""The parameters and initial states of a diagram that an optimization may change, by name."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from pydrake.systems.framework import System

from drake_dae.arrays import FloatArray, number
from drake_dae.compiler.compiled import CompiledDiagram
from drake_dae.dae.system.signals import Parameter
from drake_dae.errors import ModelError
from drake_dae.studies.identification.unknowns import model_parameters, named_entries

START, PLANT, LAW = "start.", "plant.", "law."
"""Prefixes of names: an entry of the initial state, a number only of the plant, or only of the
law."""

Bounds = tuple[float | None, float | None]
"""(least, largest) value; None for no bound."""


@dataclass(frozen=True)
class Variable:
    """A number that an optimization changes.

    Attributes:
        name: The name, with the index of the entry if the parameter has several.
        unit: The unit; empty if it is unknown.
        places: The indices of the number among the parameters of the diagram; all have its value.
        state: The index of the number in the initial state; -1 for a parameter.
        lowest: The least value that is valid; None for none.
        strict: Whether the number must be above `lowest`.
        start: The initial guess.
        low, high: The bounds, infinite for none.
    """

    name: str
    unit: str = ""
    places: tuple[int, ...] = ()
    state: int = -1
    lowest: float | None = None
    strict: bool = False
    start: float = 0.0
    low: float = -np.inf
    high: float = np.inf

    @property
    def size(self) -> float:
        """The scale of the variable: the width of its range if finite, otherwise its value."""
        width = self.high - self.low
        return width if np.isfinite(width) else abs(self.start) or 1.0


def chosen_variables(
    compiled: CompiledDiagram,
    start: FloatArray,
    parameters: FloatArray,
    free: Mapping[str, Bounds],
) -> list[Variable]:
    """Finds the variables by their names, with bounds and initial guess.

    Args:
        compiled: The diagram.
        start, parameters: The initial state and the parameters, from `start_values`.
        free: Name of a parameter, or of an entry such as "wall.position[0]" -> bounds of all its
            entries.

    Raises:
        ModelError: There is no such name, it has different values in plant and law, it is named
            twice, or bounds contradict each other.
    """
    if not free:
        raise ModelError('free must name a variable, as {"link1.mass": (5.0, 20.0)}')
    available = _by_name(compiled)
    variables = [
        _bounded(entry, start, parameters, bounds)
        for name, bounds in free.items()
        for entry in named_entries(name, available, "number to optimize")
    ]
    taken: dict[tuple[bool, int], Variable] = {}
    for variable in variables:
        for place in variable.places or (variable.state,):
            other = taken.setdefault((variable.state >= 0, place), variable)
            if other is not variable:
                raise ModelError(
                    f"free names one number twice, as '{other.name}' and '{variable.name}'"
                )
    return variables


def _bounded(
    variable: Variable, start: FloatArray, parameters: FloatArray, bounds: Bounds
) -> Variable:
    """Returns a variable with its bounds and initial guess, after checks."""
    values = start[[variable.state]] if variable.state >= 0 else parameters[list(variable.places)]
    if np.ptp(values):
        raise ModelError(
            f"'{variable.name}' has different values in the plant and in the law, "
            f"{values.min():g} and {values.max():g}: name '{PLANT}{variable.name}' or "
            f"'{LAW}{variable.name}'"
        )
    if len(bounds) != 2:
        raise ModelError(
            f"the bounds of '{variable.name}' must be two numbers, or None for no bound, "
            f"got {bounds!r}"
        )
    low, high = (
        unbounded if bound is None else number(f"a bound of '{variable.name}'", bound)
        for bound, unbounded in zip(bounds, (-np.inf, np.inf), strict=True)
    )
    if variable.lowest is not None:
        if bounds[0] is None:
            low = variable.lowest
        if low < variable.lowest or (variable.strict and low <= variable.lowest):
            relation = "above" if variable.strict else "at least"
            raise ModelError(
                f"'{variable.name}' must be {relation} {variable.lowest:g}: give it such a lower "
                "bound"
            )
    value = float(values[0])
    if not low < high:
        raise ModelError(
            f"the bounds of '{variable.name}' must be a lower and a larger number, got {low:g} and "
            f"{high:g}"
        )
    if not low <= value <= high:
        raise ModelError(
            f"'{variable.name}' begins with {value:g}, outside of its bounds {low:g} and "
            f"{high:g}: give it another value in the context, or other bounds"
        )
    return replace(variable, start=value, low=low, high=high)


def _by_name(compiled: CompiledDiagram) -> dict[str, list[Variable]]:
    """All numbers of a diagram: name -> entries.

    A number of both plant and law is one variable under its own name, and one variable each with
    the prefixes "plant." and "law.".
    """
    variables: dict[str, dict[int, Variable]] = {}

    def add(name: str, entry: int, variable: Variable, count: int) -> None:
        entries = variables.setdefault(name, {})
        label = name if count == 1 else f"{name}[{entry}]"
        before = entries.get(entry, replace(variable, places=()))
        entries[entry] = replace(before, name=label, places=(*before.places, *variable.places))

    moving = {
        part.start + place
        for system, part in compiled.parameters
        for place in compiled.blocks[system].moving
    }
    for system, part in compiled.parameters:
        is_plant = compiled.blocks[system].check_start is not None
        is_model = getattr(system, "dae", None) is not None
        for name, count, entry, place, variable in _named(system, part.stop - part.start):
            if part.start + place in moving:
                continue
            variable = replace(variable, places=(part.start + place,))
            add(name, entry, variable, count)
            if is_model and not name.startswith((PLANT, LAW)):
                add((PLANT if is_plant else LAW) + name, entry, variable, count)
    variables |= {name: {0: variable} for name, variable in _states(compiled)}
    return {name: [entries[i] for i in sorted(entries)] for name, entries in variables.items()}


def _states(compiled: CompiledDiagram) -> Iterator[tuple[str, Variable]]:
    """The entries of the initial states of plants, by name."""
    size, first = compiled.sizes["state"], 0
    places = [(system, part.start) for system, part in compiled.states]
    for system, part in compiled.held:
        block = compiled.blocks[system]
        if not block.draws:
            places.append((system, size + first))
            first += part.stop - part.start
    for system, place in places:
        dae = getattr(system, "dae", None)
        if dae is None or compiled.blocks[system].check_start is None:
            continue
        for entry, signal in enumerate(dae.state_signals):
            name = START + signal.name
            yield name, Variable(name, signal.unit, state=place + entry)


def _named(system: System, size: int) -> Iterator[tuple[str, int, int, int, Variable]]:
    """Yields the numeric parameters of a system: name, number of entries, entry, index, variable.

    Parameters of models, gains and references have names; others have the name of the system.
    """
    named = set[int]()
    for parameter, first in [*model_parameters(system), *_reference_parameters(system)]:
        lowest = 0.0 if parameter.positive or parameter.nonnegative else None
        variable = Variable("", parameter.unit, lowest=lowest, strict=parameter.positive)
        count = parameter.value.size
        for entry in range(count):
            named.add(first + entry)
            yield parameter.name, count, entry, first + entry, variable
    for name, places in _gains(system).items():
        for entry, (place, is_diagonal) in enumerate(places):
            named.add(place)
            # Negative gains of an output's own error are never Hurwitz, see (30).
            lowest = 0.0 if is_diagonal else None
            yield name, len(places), entry, place, Variable("", lowest=lowest)
    for place in range(size):
        if place not in named:
            yield str(system.get_name()), size, place, place, Variable("")


def _reference_parameters(system: Any) -> Iterable[tuple[Parameter, int]]:
    """The parameters of references, with the index of their first entries."""
    first = 0
    for name, value in getattr(system, "reference_parameters", {}).items():
        yield Parameter(name, value), first
        first += value.size


def _gains(system: Any) -> dict[str, list[tuple[int, bool]]]:
    """The nonzero gains of each output: "gains." + output -> (index, whether on its own error)."""
    gains = getattr(getattr(system, "law", None), "gains", None)
    dae = getattr(system, "dae", None)
    if gains is None or dae is None:
        return {}
    pattern = ca.sparsify(ca.DM(gains.matrix)).sparsity()
    first, owners = dae.parameter_values.size, gains.layout.owners
    by_output = dict[str, list[tuple[int, bool]]]()
    for place, (row, column) in enumerate(zip(pattern.row(), pattern.get_col(), strict=True)):
        entries = by_output.setdefault(f"gains.{gains.names[row]}", [])
        entries.append((first + place, bool(owners[column] == row)))
    return by_output
