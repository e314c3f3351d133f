"""Guards: limits at which a phase fails."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Literal

import casadi as ca

from drake_dae.arguments import checked
from drake_dae.arrays import positive
from drake_dae.errors import ModelError

Watched = Literal["force", "time", "work", "control", "speed", "travel", "eccentricity"]

UNITS = {
    "force": "N",
    "time": "s",
    "work": "J",
    "control": "",
    "speed": "m/s",
    "travel": "m",
    "eccentricity": "",
}
"""Watched quantity -> its unit; a control has its own."""


@checked(ModelError)
@dataclass(frozen=True)
class PhaseGuard:
    """A limit at which a phase fails, on one of these quantities:

    - force: the measured force of the contact, in N;
    - time: the time since the phase began, in s;
    - speed: the norm of the rates of all outputs in m and of the distance, in m/s; the speed of the
      tool if these are its coordinates;
    - travel: the norm of the change of these outputs since the phase began, in m;
    - work: the integral of F ds since the phase began, with the contact force F and the path s of
      the tool, in J, as a sum over samples;
    - control: the largest |u|, in its unit, N m for joints;
    - eccentricity: of a face of k points 1 - k min lambda_i / sum lambda_i, which is 0 where all
      forces are equal, and 1 where a point has no force: then the center of pressure is on an edge
      of the face, and it tips.

    Attributes:
        of: The watched quantity: "force", "time", "work", "control", "speed", "travel" or
            "eccentricity".
        most: The limit, in N, s, J, m/s or m, in the unit of the control, or a pure number.
        samples: The number of consecutive samples at or above the limit, so that noise does not
            count; more than one only in a sampled task.

    Raises:
        ModelError: The limit is not positive, or the number of samples is below 1.
    """

    of: Watched
    most: float
    samples: int = 1

    def __post_init__(self) -> None:
        positive(f"PhaseGuard: most, of the {self.of},", self.most)
        if self.samples < 1:
            raise ModelError(f"PhaseGuard: samples must be 1 or more, got {self.samples}")

    def tripped(self, value: float) -> str:
        """The reason of a failure in words."""
        unit = f" {UNITS[self.of]}".rstrip()
        over = f", in {self.samples} samples" if self.samples > 1 else ""
        which = "an eccentricity" if self.of == "eccentricity" else f"a {self.of}"
        return f"{which} of {value:.4g}{unit}, where its guard has {self.most:g}{unit}{over}"


def eccentricity(forces: Sequence[float], contact_force: float) -> float:
    """The distance of the center of pressure from the center of a face of k points.

    1 - k min lambda_i / sum lambda_i is 1 where it is on an edge of the triangle of three points,
    and one of them has no force. It is 0 where the sum is below contact_force.

    Args:
        forces: lambda, in N, as numbers or expressions.
        contact_force: As of a `Task`.
    """
    if len(forces) == 1:
        return 0.0
    total = sum(forces)
    off: float = 1.0 - len(forces) * reduce(ca.fmin, forces) / ca.fmax(total, contact_force)
    eccentric: float = ca.if_else(total < contact_force, 0.0, off)
    return eccentric
