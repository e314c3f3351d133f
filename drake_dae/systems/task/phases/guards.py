"""What a phase may not exceed."""

from dataclasses import dataclass
from typing import Literal

from drake_dae.arguments import checked
from drake_dae.arrays import positive
from drake_dae.errors import ModelError

Watched = Literal["force", "time", "work", "control", "speed", "travel"]

UNITS = {"force": "N", "time": "s", "work": "J", "control": "", "speed": "m/s", "travel": "m"}
"""Names of what a guard watches -> units; a control has its own."""


@checked(ModelError)
@dataclass(frozen=True)
class PhaseGuard:
    """A phase has failed where one of these is at its largest value or above:

    - force: the measured force of the contact, in N;
    - time: since the phase began, in s;
    - speed: the root of the sum of squares of the rates of all outputs in m and of the distance,
      in m/s; the speed of the tool where these are its coordinates;
    - travel: how far these are from where they were when the phase began, in m;
    - work: the force of the contact times the way of the tool, the integral of F ds since the phase
      began, in J, by sums over samples;
    - control: the largest |u|, in its unit, N m of joints.

    Attributes:
        of: What it watches: "force", "time", "work", "control", "speed" or "travel".
        most: The largest value, in N, s, J, m/s or m, or in the unit of the control.
        samples: In so many consecutive samples it has to be there, so that noise does not count;
            only a sampled task can count more than one.

    Raises:
        ModelError: The value is not positive, or the count is below 1.
    """

    of: Watched
    most: float
    samples: int = 1

    def __post_init__(self) -> None:
        positive(f"PhaseGuard: most, of the {self.of},", self.most)
        if self.samples < 1:
            raise ModelError(f"PhaseGuard: samples must be 1 or more, got {self.samples}")

    def tripped(self, value: float) -> str:
        """Why the phase has failed, in words."""
        unit = f" {UNITS[self.of]}".rstrip()
        over = f", in {self.samples} samples" if self.samples > 1 else ""
        return f"a {self.of} of {value:.4g}{unit}, where its guard has {self.most:g}{unit}{over}"
