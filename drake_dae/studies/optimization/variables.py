"""The numbers of a diagram that an optimization may change, by name."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from pydrake.systems.framework import System

from drake_dae.arrays import FloatArray, number, unknown_name
from drake_dae.compiler.compiled import CompiledDiagram
from drake_dae.dae.system.signals import Parameter
from drake_dae.errors import ModelError

START, PLANT, LAW = "start.", "plant.", "law."
"""How names begin: of a state's entry, and of a number in the plant alone, or elsewhere alone."""

Bounds = tuple[float | None, float | None]
"""The least and the largest value; None for no bound."""

_ENTRY = re.compile(r"(.+)\[(\d+)\]")


@dataclass(frozen=True)
class Variable:
    """A number that an optimization changes.

    Attributes:
        name: Its name, with its entry if the parameter has several.
        unit: Its unit, as far as it is known.
        places: Where it stands among the parameters of the diagram; it is the same at all of them.
        state: Where it stands in the start; -1 for a parameter.
        lowest: The least value that makes sense; None for any.
        strict: Whether it must be above that.
        start, low, high: The value to begin with, and the bounds, infinite where there are none.
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
        """How large its changes are: the width of its range, or else its value."""
        width = self.high - self.low
        return width if np.isfinite(width) else abs(self.start) or 1.0


def chosen_variables(
    compiled: CompiledDiagram,
    start: FloatArray,
    parameters: FloatArray,
    free: Mapping[str, Bounds],
) -> list[Variable]:
    """The variables of names, with bounds and the values to begin with.

    Args:
        compiled: The diagram.
        start, parameters: As of `start_values`.
        free: Name of a parameter or of one entry of it, "wall.position[0]" -> bounds, for all of
            its entries.

    Raises:
        ModelError: There is no such name, it has other values in plant and law, it is named twice,
            or bounds make no sense.
    """
    if not free:
        raise ModelError('free must name a variable, as {"link1.mass": (5.0, 20.0)}')
    known = _by_name(compiled)
    found: list[Variable] = []
    for name, bounds in free.items():
        for one in _entries(name, known):
            found.append(_bounded(one, start, parameters, bounds))
    taken: dict[tuple[bool, int], Variable] = {}
    for one in found:
        for place in one.places or (one.state,):
            other = taken.setdefault((one.state >= 0, place), one)
            if other is not one:
                raise ModelError(f"free names one number twice, as '{other.name}' and '{one.name}'")
    return found


def _bounded(one: Variable, start: FloatArray, parameters: FloatArray, bounds: Bounds) -> Variable:
    values = start[[one.state]] if one.state >= 0 else parameters[list(one.places)]
    if np.ptp(values):
        raise ModelError(
            f"'{one.name}' has different values in the plant and in the law, {values.min():g} and "
            f"{values.max():g}: name '{PLANT}{one.name}' or '{LAW}{one.name}'"
        )
    if len(bounds) != 2:
        raise ModelError(
            f"the bounds of '{one.name}' must be two numbers, or None for no bound, got {bounds!r}"
        )
    low, high = (
        unbounded if bound is None else number(f"a bound of '{one.name}'", bound)
        for bound, unbounded in zip(bounds, (-np.inf, np.inf), strict=True)
    )
    if one.lowest is not None:
        if bounds[0] is None:
            low = one.lowest
        if low < one.lowest or (one.strict and low <= one.lowest):
            raise ModelError(
                f"'{one.name}' must be {'above' if one.strict else 'at least'} {one.lowest:g}: "
                "give it such a lower bound"
            )
    value = float(values[0])
    if not low < high:
        raise ModelError(
            f"the bounds of '{one.name}' must be a lower and a larger number, got {low:g} and "
            f"{high:g}"
        )
    if not low <= value <= high:
        raise ModelError(
            f"'{one.name}' begins with {value:g}, outside of its bounds {low:g} and {high:g}: give "
            "it another value in the context, or other bounds"
        )
    return replace(one, start=value, low=low, high=high)


def _entries(name: str, known: Mapping[str, Sequence[Variable]]) -> Sequence[Variable]:
    """The entries of a name."""
    if name in known:
        return known[name]
    match = _ENTRY.fullmatch(name)
    if match is None or match[1] not in known:
        raise ModelError(unknown_name("number to optimize", name, known))
    entries = known[match[1]]
    if int(match[2]) >= len(entries) or len(entries) == 1:
        raise ModelError(
            f"'{match[1]}' has {len(entries)} entries, counted from 0, and no entry {match[2]}"
            if len(entries) > 1
            else f"'{match[1]}' is one number: name it without [{match[2]}]"
        )
    return [entries[int(match[2])]]


def _by_name(compiled: CompiledDiagram) -> dict[str, list[Variable]]:
    """All numbers of a diagram: name -> its entries.

    A number that plant and law both have is one under its own name, and two under the names with
    "plant." and "law.".
    """
    found: dict[str, dict[int, Variable]] = {}

    def add(name: str, entry: int, variable: Variable, count: int) -> None:
        own = found.setdefault(name, {})
        label = name if count == 1 else f"{name}[{entry}]"
        before = own.get(entry, replace(variable, places=()))
        own[entry] = replace(before, name=label, places=(*before.places, *variable.places))

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
    found |= {name: {0: variable} for name, variable in _states(compiled)}
    return {name: [entries[i] for i in sorted(entries)] for name, entries in found.items()}


def _states(compiled: CompiledDiagram) -> Iterator[tuple[str, Variable]]:
    """The entries of the states of plants, in the start."""
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
    """The numeric parameters of a system: name, number of entries, entry, place, and the variable.

    Those of models, gains and references have names; others have the name of the system.
    """
    named = set[int]()
    for parameter, first in _parameters(system):
        lowest = 0.0 if parameter.positive or parameter.nonnegative else None
        variable = Variable("", parameter.unit, lowest=lowest, strict=parameter.positive)
        count = parameter.value.size
        for entry in range(count):
            named.add(first + entry)
            yield parameter.name, count, entry, first + entry, variable
    for name, places in _gains(system).items():
        for entry, (place, is_own) in enumerate(places):
            named.add(place)
            # Without it the error dynamics (30) are not Hurwitz.
            lowest = 0.0 if is_own else None
            yield name, len(places), entry, place, Variable("", lowest=lowest)
    for place in range(size):
        if place not in named:
            yield str(system.get_name()), size, place, place, Variable("")


def _parameters(system: Any) -> Iterator[tuple[Parameter, int]]:
    """The parameters of a system that have names, and where they begin."""
    if (dae := getattr(system, "dae", None)) is not None:
        for parameter in dae.parameters:
            yield parameter, dae.parameter_slice(parameter.name).start
    for name, (signal, place) in getattr(system, "further_parameters", {}).items():
        positive = name in ("plant.stiffness", "plant.radius")
        one = Parameter(name, np.ones(1), signal.unit, positive, nonnegative=not positive)
        yield one, place
    first = 0
    for name, value in getattr(system, "reference_parameters", {}).items():
        yield Parameter(name, value), first
        first += value.size


def _gains(system: Any) -> dict[str, list[tuple[int, bool]]]:
    """Name of the gains of an output -> where the nonzero entries of its row of K stand.

    With each stands whether it acts on the output's own error.
    """
    gains = getattr(getattr(system, "law", None), "gains", None)
    dae = getattr(system, "dae", None)
    if gains is None or dae is None:
        return {}
    pattern = ca.sparsify(ca.DM(gains.matrix)).sparsity()
    first, owners = dae.parameter_values.size, gains.layout.owners
    found = dict[str, list[tuple[int, bool]]]()
    for place, (row, column) in enumerate(zip(pattern.row(), pattern.get_col(), strict=True)):
        entries = found.setdefault(f"gains.{gains.names[row]}", [])
        entries.append((first + place, bool(owners[column] == row)))
    return found
