"""References by the names of their outputs.

A name is that of an output, "tool.y"; or of all outputs with the same prefix, "tool", restricted to
those of the highest degree (positions rather than forces); or of some of these by their letters, in
that order, "tool.yz"; or a list of such names, "tool.y, joint3".
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.dae.references.formulas import ConstantReference
from drake_dae.dae.references.reference import Reference
from drake_dae.errors import ReferenceSignalError


@checked(ReferenceSignalError)
@dataclass(frozen=True, eq=False)
class ReferenceRows(Reference):
    """A reference that consists of some rows of another one, in any order.

    Attributes:
        reference: The reference.
        rows: The chosen rows, shape (k,).

    Raises:
        ReferenceSignalError: There is no such row, a row occurs twice, or no row is given.
    """

    reference: Reference
    rows: tuple[int, ...]

    def __post_init__(self) -> None:
        all_rows = range(self.reference.size)
        if not self.rows or len(set(self.rows) & set(all_rows)) != len(self.rows):
            raise ReferenceSignalError(
                f"rows must be distinct ones of 0 to {all_rows[-1]}, got {self.rows}"
            )

    @property
    def size(self) -> int:
        return len(self.rows)

    @property
    def repeats(self) -> float | None:
        return self.reference.repeats

    @property
    def parameters(self) -> Mapping[str, Any]:  # type: ignore[override]
        return self.reference.parameters

    def with_parameters(self, values: Mapping[str, Any]) -> Reference:
        return ReferenceRows(self.reference.with_parameters(values), self.rows)

    def derivatives(self, degrees: Sequence[int]) -> Callable[[float], FloatArray]:
        needed = self._needed(degrees)
        function, places = self.reference.derivatives(needed), self._places(needed)
        return lambda time: function(time)[places]

    def expression(self, degrees: Sequence[int], time: ca.SX) -> ca.SX | None:
        needed = self._needed(degrees)
        value = self.reference.expression(needed, time)
        return None if value is None else value[self._places(needed)]

    def _needed(self, degrees: Sequence[int]) -> list[int]:
        """The degree of each row of the whole reference."""
        degree_of = dict(zip(self.rows, degrees, strict=True))
        return [degree_of.get(row, 0) for row in range(self.reference.size)]

    def _places(self, degrees: Sequence[int]) -> list[int]:
        """Returns the indices of the selected rows' values among those of all rows."""
        first = np.cumsum([0, *[degree + 1 for degree in degrees]])
        return [int(first[row]) + k for row in self.rows for k in range(degrees[row] + 1)]


@dataclass(frozen=True)
class Assigned:
    """A reference with its name and the indices of its outputs."""

    name: str
    reference: Reference
    places: Sequence[int]


def assigned(
    name: str, reference: Reference | float, outputs: Sequence[str], degrees: Sequence[int]
) -> Assigned:
    """Assigns a reference to the outputs of a name; a number is a constant for each of them.

    Args:
        name: The name.
        reference: The reference, with one row for each output of the name.
        outputs: The names of all outputs.
        degrees: The degrees mu_1, ..., mu_p of the outputs.

    Raises:
        ReferenceSignalError: The name has no output, the number of rows differs, or the reference
            is not smooth enough.
    """
    places = meant(name, outputs, degrees)
    if not isinstance(reference, Reference):
        reference = ConstantReference([reference] * len(places))
    if reference.size != len(places):
        listed = ", ".join(outputs[i] for i in places)
        raise ReferenceSignalError(
            f"{reference.size} value{'s' * (reference.size > 1)} for {len(places)} "
            f"output{'s' * (len(places) > 1)}: {listed}"
        )
    reference.derivatives([degrees[i] for i in places])
    return Assigned(name, reference, places)


def in_order(references: Sequence[Assigned], outputs: Sequence[str]) -> list[Reference]:
    """Sorts references in the order of the outputs; each output needs one.

    Raises:
        ReferenceSignalError: An output has none, or two.
    """
    rows: dict[int, tuple[Assigned, int]] = {}
    for entry in references:
        for row, i in enumerate(entry.places):
            if i in rows:
                first = rows[i][0].name
                raise ReferenceSignalError(
                    f"'{outputs[i]}' has two, by '{first}' and '{entry.name}'"
                )
            rows[i] = entry, row
    missing = [name for i, name in enumerate(outputs) if i not in rows]
    if missing:
        raise ReferenceSignalError(
            f"missing: {', '.join(missing)}; references are needed for {', '.join(outputs)}"
        )
    return list(_runs([rows[i] for i in range(len(outputs))]))


@checked(ReferenceSignalError)
def references_by_name(
    references: Mapping[str, Reference | float], outputs: Sequence[str], degrees: Sequence[int]
) -> list[Reference]:
    """Returns references in the order of the outputs.

    Args:
        references: Name -> reference, or a number for a constant.
        outputs: The names of all outputs.
        degrees: The degrees mu_1, ..., mu_p of the outputs, `TrackingLaw.degrees`.

    Raises:
        ReferenceSignalError: A name has no output, an output has no reference or two, or a
            reference does not fit or is not smooth enough.
    """
    if len(degrees) != len(outputs):
        raise ReferenceSignalError(f"{len(outputs)} outputs have {len(degrees)} degrees")
    assignments = []
    for name, reference in references.items():
        try:
            assignments.append(assigned(name, reference, outputs, degrees))
        except ReferenceSignalError as error:
            raise ReferenceSignalError(f"reference '{name}': {error}") from error
    return in_order(assignments, outputs)


def meant(name: str, outputs: Sequence[str], degrees: Sequence[int]) -> list[int]:
    """Returns the indices of the outputs that a name denotes, shape (k,).

    Raises:
        ReferenceSignalError: It has none.
    """
    parts = [part.strip() for part in name.split(",")]
    return [i for part in parts for i in _meant(part, outputs, degrees)]


def _meant(name: str, outputs: Sequence[str], degrees: Sequence[int]) -> list[int]:
    """Returns the indices of the outputs that a name without commas denotes."""
    index = {output: i for i, output in enumerate(outputs)}
    if name in index:
        return [index[name]]
    group, _, letters = name.rpartition(".")
    chosen = [f"{group}.{letter}" for letter in letters]
    if len(set(chosen)) == len(chosen) > 1 and index.keys() >= set(chosen):
        return [index[output] for output in chosen]
    members = [i for output, i in index.items() if output.rpartition(".")[0] == name]
    if not name or not members:
        raise ReferenceSignalError(unknown_name("output", name, outputs))
    highest = max(degrees[i] for i in members)
    return [i for i in members if degrees[i] == highest]


def _runs(rows: Sequence[tuple[Assigned, int]]) -> Iterator[Reference]:
    """Generates references for rows; successive rows of one reference are joined."""
    first = 0
    while first < len(rows):
        entry, row = rows[first]
        last = first + 1
        while last < len(rows) and rows[last] == (entry, row + last - first):
            last += 1
        is_whole = last - first == entry.reference.size
        chosen = tuple(range(row, row + last - first))
        yield entry.reference if is_whole else ReferenceRows(entry.reference, chosen)
        first = last
