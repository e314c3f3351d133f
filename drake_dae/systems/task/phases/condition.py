"""Conditions that end a phase of a task."""

from dataclasses import dataclass
from math import isfinite
from typing import Literal

from drake_dae.arguments import checked
from drake_dae.errors import ModelError

Watched = Literal["force", "time", "distance", "travel", "control", "signal"]

UNITS = {"force": "N", "time": "s", "distance": "m", "travel": "m", "control": "", "signal": ""}
"""Watched quantity -> its unit; a control has its own."""


@checked(ModelError)
@dataclass(frozen=True)
class Condition:
    """A measured quantity above or below a limit:

    - force: the measured force of the contact, in N;
    - time: the time since the phase began, in s;
    - distance: the distance from the surface by the law's model, in m;
    - travel: the norm of the change of all outputs in m, and of the distance, since the phase
      began, in m; the way of the tool if these are its coordinates;
    - control: |u| of a control, or the largest of all, in its unit, N m for joints;
    - signal: the value of the input signal_<name>, in a scenario one of task.signals.

    Attributes:
        of: The watched quantity: "force", "time", "distance", "travel", "control" or "signal".
        above: It holds at or above this value.
        below: It holds at or below this value. Either this or `above` is given.
        name: The name of the signal or of the control; of the largest control if empty.

    Raises:
        ModelError: Not exactly one limit is given, it is not finite, or a name is missing.
    """

    of: Watched
    above: float | None = None
    below: float | None = None
    name: str = ""

    def __post_init__(self) -> None:
        if (self.above is None) == (self.below is None):
            raise ModelError(f"Condition of the {self.of}: give either above or below")
        if not isfinite(self.limit):
            raise ModelError(f"Condition of the {self.of}: {self.limit} is not finite")
        if (self.of == "signal") != bool(self.name) and self.of != "control":
            raise ModelError(
                f"Condition of the {self.of}: name: a signal needs one, and only a control has one "
                f"besides, got '{self.name}'"
            )

    @property
    def limit(self) -> float:
        """The limit."""
        return self.above if self.above is not None else self.below or 0.0

    @property
    def watched(self) -> str:
        """The quantity in words: "force", or "signal ready"."""
        return f"{self.of} {self.name}".rstrip()

    def __str__(self) -> str:
        side = "above" if self.above is not None else "below"
        return f"a {self.watched} {side} {self.limit:g} {UNITS[self.of]}".rstrip()
