"""The program of a rollout: a compiled diagram, and the signals of its record."""

import ctypes
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from threading import RLock
from typing import Any, TypeVar

import numpy as np
from pydrake.systems.framework import Diagram

from drake_dae.blocks.computations import NOISE
from drake_dae.compiler.compile import compile_diagram, with_twins
from drake_dae.compiler.compiled import CompiledDiagram
from drake_dae.dae import Signal
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.record import Record
from drake_dae.errors import ModelError
from drake_dae.trace.compiled import Compiled

T = TypeVar("T")

MAKING = RLock()
"""What is made once is made by one thread; expressions of CasADi cannot be shared by several."""


@dataclass(eq=False)
class RolloutProgram:
    """A diagram as a rollout steps it.

    Attributes:
        compiled: Its functions.
        signals: The columns of a row: name of a signal -> names and units of its entries.
        complete: Adds derived signals to a record.
        name: Its name in messages.
        choice: Whether it becomes machine code by default.
        ends_updated: Whether the last row comes after the updates of its time: as in Drake's logs
            of each step, but not in those of the steps of a discrete plant.
        library: Its machine code; None if there is none yet.
    """

    compiled: CompiledDiagram
    signals: Mapping[str, Sequence[Signal]]
    complete: Callable[[Record], Record]
    name: str
    choice: Compiled = "auto"
    ends_updated: bool = True
    library: ctypes.CDLL | None = None
    _made: dict[str, Any] = field(default_factory=dict, repr=False)

    def kept(self, name: str, make: Callable[[], T]) -> T:
        """Returns the value of a function that is called once; later the same value."""
        with MAKING:
            if name not in self._made:
                self._made[name] = make()
        value: T = self._made[name]
        return value

    @property
    def twins(self) -> "RolloutProgram":
        """The program of runs in which the plant and the law of a model have equal numbers."""

        def make() -> RolloutProgram:
            compiled = with_twins(self.compiled)
            if compiled is self.compiled:
                return self
            return replace(self, compiled=compiled, library=None, _made={})

        return self.kept("twins", make)

    @property
    def plant(self) -> slice:
        """The place of the plant's states; all states if there is no plant."""
        compiled = self.compiled
        parts = [part for each, part in compiled.states if compiled.blocks[each].check_start]
        return parts[0] if parts else slice(0, self.size)

    @property
    def size(self) -> int:
        """The number of continuous states."""
        return self.compiled.sizes["state"]

    @property
    def width(self) -> int:
        """The number of columns of a row."""
        return sum(map(len, self.signals.values()))

    @cached_property
    def kept_places(self) -> np.ndarray:
        """The places of the held values that a start contains: all except random numbers."""
        drawn = np.zeros(self.compiled.sizes["held"], dtype=bool)
        for system, part in self.compiled.held:
            updates = self.compiled.blocks[system].updates
            drawn[part] = any(NOISE in update.computation.sources for update in updates)
        return np.flatnonzero(~drawn)

    @property
    def num_operations(self) -> int:
        """The number of operations of all functions together."""
        return sum(int(each.n_instructions()) for each in self.compiled.staged.values())


def program_of(loop: ClosedLoop | Diagram) -> RolloutProgram:
    """Returns the program of a closed loop or of any diagram, which is made once.

    Raises:
        ModelError: A block cannot be traced, with its name and the reason; or a diagram has no
            output port with a vector.
    """
    with MAKING:
        if isinstance(loop, Diagram):
            return _of_diagram(loop)
        if "program" not in loop.memory:
            loop.memory["program"] = RolloutProgram(
                compile_diagram(loop.diagram, list(loop.signals)),
                loop.signals,
                loop.with_errors,
                loop.plant.get_name(),
                loop.plant.dae.compiled,
                ends_updated=not loop.plant.time_step,
            )
        program: RolloutProgram = loop.memory["program"]
    return program


@lru_cache(maxsize=4)
def _of_diagram(diagram: Diagram) -> RolloutProgram:
    compiled = compile_diagram(diagram)
    if not compiled.outputs:
        raise ModelError(
            "the diagram has no output port with a vector, so that a rollout has nothing to "
            "record: export one, builder.ExportOutput(system.GetOutputPort(...), name)"
        )
    name = diagram.get_name() or "the diagram"
    return RolloutProgram(compiled, compiled.signals, lambda record: record, name)
