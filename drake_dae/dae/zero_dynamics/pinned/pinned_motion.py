"""The motion with the outputs on a reference, and why it ends, as values."""

from dataclasses import dataclass
from enum import Enum

from drake_dae.arrays import FloatArray


class EndCause(Enum):
    """The causes for the end of a motion with pinned outputs; the enum value is a description."""

    NO_START = "no state has the outputs that the reference begins with"
    SINGULAR_START = "A(x) or B(x) is singular at the start, or the domain of the system ends"
    REFERENCE_NOT_FINITE = "the reference is not finite"
    UNBOUNDED = "the internal states grow without bound while the outputs follow"
    TOO_FAST = "the motion is too fast to be followed so far"
    NO_WAY_ON = (
        "no state that continues the motion is found: the reference jumps, or the domain of the "
        "system ends"
    )
    OUT_OF_REACH = "the reference leaves what the system can reach"
    SINGULAR = "the control would be unbounded. Lead the reference around"


@dataclass(frozen=True, eq=False)
class MotionEnd:
    """The end of a motion with pinned outputs: its cause, time and state.

    Attributes:
        cause: Why the motion ends.
        time: The end time, in s.
        state: The last state, shape (n,); None if there is none.
        matrix: The matrix that loses its rank, "A" or "B"; empty if none does.
        text: The same as a sentence.
    """

    cause: EndCause
    time: float
    text: str
    state: FloatArray | None = None
    matrix: str = ""

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True, eq=False)
class PinnedMotion:
    """The motion with the outputs on a reference, until the last time or until it ends.

    Attributes:
        times: The requested times that were reached, in s, shape (k,).
        states: x at these times, shape (k, n).
        controls: u at these times, shape (k, p).
        constraint_inputs: v at these times, shape (k, m).
        parameters: The values of all parameters at these times, shape (k, P).
        constraint_margins: The smallest singular value of A(x), shape (k,); infinite if m = 0.
        control_margins: The smallest singular value of B(x), shape (k,).
        ending: Why the last time was not reached; None if it was.
    """

    times: FloatArray
    states: FloatArray
    controls: FloatArray
    constraint_inputs: FloatArray
    parameters: FloatArray
    constraint_margins: FloatArray
    control_margins: FloatArray
    ending: MotionEnd | None
