"""What a rollout steps: a compiled diagram, and the names of what its rows have."""

import ctypes
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, TypeVar

import casadi as ca
import numpy as np
from pydrake.systems.framework import Context, Diagram

from drake_dae.compiler.compile import compile_diagram, with_twins
from drake_dae.compiler.compiled import CompiledDiagram
from drake_dae.dae.system.signals import Signal
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.simulation.records.record import Record
from drake_dae.trace.compiled import Compiled

T = TypeVar("T")


@dataclass(eq=False)
class RolloutProgram:
    """A diagram as a rollout steps it.

    Attributes:
        compiled: Its functions.
        signals: The columns of a row: name -> names and units.
        complete: A record with what follows from it; and from a context after the run, where
            blocks reacted to what happened.
        name: What messages call it.
        choice: Whether it becomes machine code, where nobody says otherwise.
        ends_updated: Whether the last row comes after the updates of its time: as in Drake's logs
            of each step, but not in those of the steps of a discrete plant.
        library: Its machine code, if there is any by now.
    """

    compiled: CompiledDiagram
    signals: Mapping[str, Sequence[Signal]]
    complete: Callable[[Record, Context | None], Record]
    name: str
    choice: Compiled = "auto"
    ends_updated: bool = True
    library: ctypes.CDLL | None = None
    _made: dict[str, Any] = field(default_factory=dict, repr=False)

    def kept(self, name: str, make: Callable[[], T]) -> T:
        """What is made once."""
        if name not in self._made:
            self._made[name] = make()
        found: T = self._made[name]
        return found

    @property
    def twins(self) -> "RolloutProgram":
        """The same where plants and laws of one model have the same numbers."""

        def make() -> RolloutProgram:
            found = with_twins(self.compiled)
            if found is self.compiled:
                return self
            return replace(self, compiled=found, library=None, _made={})

        return self.kept("twins", make)

    @property
    def plant(self) -> slice:
        """Which states are those of the first block that is not content with any; all if none."""
        compiled = self.compiled
        found = [part for each, part in compiled.states if compiled.blocks[each].check_start]
        return found[0] if found else slice(0, self.size)

    @property
    def size(self) -> int:
        """How many states there are."""
        return self.compiled.sizes["state"]

    @property
    def width(self) -> int:
        """How many numbers a row has."""
        return sum(map(len, self.signals.values()))

    @cached_property
    def kept_places(self) -> np.ndarray:
        """Which entries of what is held a start has: all but random numbers."""
        drawn = np.zeros(self.compiled.sizes["held"], dtype=bool)
        for system, part in self.compiled.held:
            drawn[part] = self.compiled.blocks[system].draws
        return np.flatnonzero(~drawn)

    @cached_property
    def functions(self) -> dict[str, ca.Function]:
        """Name -> function, of all that machine code is made of."""
        return dict(self.compiled.staged)

    @property
    def num_operations(self) -> int:
        """How many operations all functions have together."""
        return sum(int(function.n_instructions()) for function in self.functions.values())


def program_of(loop: ClosedLoop | Diagram) -> RolloutProgram:
    """The program of a closed loop or of any diagram, made once.

    Raises:
        ModelError: Something in it cannot be traced, its name and why; or a diagram has no output.
    """
    if isinstance(loop, Diagram):
        compiled = compile_diagram(loop)
        if not compiled.outputs:
            raise ModelError(
                "the diagram has no output port with a vector, so that a rollout has nothing to "
                "record: export one, builder.ExportOutput(system.GetOutputPort(...), name)"
            )
        name = loop.get_name() or "the diagram"
        return RolloutProgram(compiled, compiled.signals, lambda record, context: record, name)
    if "program" not in loop.memory:
        compiled = compile_diagram(loop.diagram, list(loop.signals))
        name, choice = loop.plant.get_name(), loop.plant.dae.compiled
        complete = partial(_completed, loop)
        ends_updated = not loop.plant.time_step
        given = compiled, loop.signals, complete, name, choice, ends_updated
        loop.memory["program"] = RolloutProgram(*given)
    found: RolloutProgram = loop.memory["program"]
    return found


def _completed(loop: ClosedLoop, record: Record, context: Context | None) -> Record:
    """A record of a loop with errors, and with what happened to contacts."""
    found = loop.with_errors(record, context)
    if context is None or not found.time.size:
        return found
    events = loop.plant.events(loop.plant.GetMyContextFromRoot(context))
    return replace(found, events=tuple(one for one in events if one.time <= found.time[-1]))
