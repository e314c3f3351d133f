"""References by the names of their outputs.

A name is that of an output, "tool.y"; or of all outputs with the same prefix, "tool", restricted to
those of the highest degree (positions rather than forces); or of some of these by their letters, in
that order, "tool.yz"; or a list of such names, "tool.y, joint3".
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import NamedTuple

import casadi as ca
import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import unknown_name
from drake_dae.errors import ReferenceSignalError
from drake_dae.references.formulas import ConstantReference
from drake_dae.references.reference import Reference, expression_of


@checked(ReferenceSignalError)
@dataclass(frozen=True, eq=False)
class ReferenceRows(Reference):
    """A reference that consists of some rows of another one, in any order."""

    reference: Reference
    rows: tuple[int, ...]

    def __post_init__(self) -> None:
        most = self.reference.size - 1
        if not self.rows or len(set(self.rows) & set(range(most + 1))) != len(self.rows):
            raise ReferenceSignalError(
                f"rows must be distinct ones of 0 to {most}, got {self.rows}"
            )

    @property
    def size(self) -> int:
        return len(self.rows)

    @property
    def repeats(self) -> float | None:
        return self.reference.repeats

    def expression(self, degrees: Sequence[int], time: ca.SX) -> ca.SX:
        degree_of = dict(zip(self.rows, degrees, strict=True))
        needed = [degree_of.get(row, 0) for row in range(self.reference.size)]
        starts = np.cumsum([0, *(degree + 1 for degree in needed)]).tolist()
        value = expression_of(self.reference, needed, time)
        return ca.vertcat(*(value[starts[row] : starts[row + 1]] for row in self.rows))


class Assignment(NamedTuple):
    """A reference for the outputs that a name denotes, by their indices; it has a row for each."""

    name: str
    reference: Reference
    places: Sequence[int]


def assign(
    name: str, reference: Reference | float, outputs: Sequence[str], degrees: Sequence[int]
) -> Assignment:
    """Assigns a reference, or a constant, to the outputs of a name; refuses what does not fit."""
    places = denoted(name, outputs, degrees)
    if not isinstance(reference, Reference):
        reference = ConstantReference([reference] * len(places))
    if reference.size != len(places):
        listed = ", ".join(outputs[i] for i in places)
        raise ReferenceSignalError(
            f"{reference.size} value(s) for {len(places)} output(s): {listed}"
        )
    expression_of(reference, [degrees[i] for i in places], ca.SX.sym("t"))
    return Assignment(name, reference, places)


def in_order(assignments: Sequence[Assignment], outputs: Sequence[str]) -> list[Reference]:
    """Sorts references in the order of the outputs, each of which needs one."""
    rows: dict[int, tuple[Assignment, int]] = {}
    for assignment in assignments:
        for row, i in enumerate(assignment.places):
            if i in rows:
                names = f"'{rows[i][0].name}' and '{assignment.name}'"
                raise ReferenceSignalError(f"'{outputs[i]}' has two, by {names}")
            rows[i] = assignment, row
    missing = [name for i, name in enumerate(outputs) if i not in rows]
    if missing:
        raise ReferenceSignalError(
            f"missing: {', '.join(missing)}; references are needed for {', '.join(outputs)}"
        )
    # Successive rows of one reference stay together.
    ordered = []
    ordered_rows = [(i, *rows[i]) for i in range(len(outputs))]
    for _, run in groupby(ordered_rows, lambda each: (each[1].name, each[2] - each[0])):
        chosen = list(run)
        reference, kept = chosen[0][1].reference, tuple(row for _, _, row in chosen)
        ordered.append(reference if len(kept) == reference.size else ReferenceRows(reference, kept))
    return ordered


@checked(ReferenceSignalError)
def references_by_name(
    references: Mapping[str, Reference | float], outputs: Sequence[str], degrees: Sequence[int]
) -> list[Reference]:
    """Returns references in the order of the outputs."""
    outputs = list(outputs)
    if len(degrees) != len(outputs):
        raise ReferenceSignalError(f"{len(outputs)} outputs have {len(degrees)} degrees")
    assignments = []
    for name, reference in references.items():
        try:
            assignments.append(assign(name, reference, outputs, degrees))
        except ReferenceSignalError as error:
            raise ReferenceSignalError(f"reference '{name}': {error}") from error
    return in_order(assignments, outputs)


def denoted(names: str, outputs: Sequence[str], degrees: Sequence[int]) -> list[int]:
    """Returns the indices of the outputs that a name, or a list of names, denotes."""
    places = []
    for name in map(str.strip, names.split(",")):
        group, _, letters = name.rpartition(".")
        chosen = [f"{group}.{letter}" for letter in letters]
        members = [i for i, output in enumerate(outputs) if output.rpartition(".")[0] == name]
        if name in outputs:
            places.append(outputs.index(name))
        elif len(set(chosen)) == len(chosen) > 1 and set(outputs) >= set(chosen):
            places += [outputs.index(output) for output in chosen]
        elif name and members:
            highest = max(degrees[i] for i in members)
            places += [i for i in members if degrees[i] == highest]
        else:
            raise ReferenceSignalError(unknown_name("output", name, outputs))
    return places
