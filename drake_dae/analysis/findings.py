"""What an examination finds of one assumption."""

from dataclasses import dataclass
from enum import StrEnum

from drake_dae.dae.assumptions import Violation
from drake_dae.dae.states.margins import Margin
from drake_dae.dae.zero_dynamics.stability import Verdict


class Finding(StrEnum):
    """What became of an assumption."""

    SATISFIED = "satisfied"
    VIOLATED = "violated"
    UNDECIDED = "undecided"
    NOT_EXAMINED = "not examined"
    FAILS = "does not hold"


@dataclass(frozen=True, eq=False)
class Assumption:
    """One of Assumptions (1)-(5) and what was found of it.

    Attributes:
        number: In the paper.
        statement: What it asks for.
        finding: Whether it holds at the examined states and between them.
        margin: Of A(x) for (2), of B(x) for (5), or for (1) and (4) where a row of these vanishes;
            else None.
        reason: How it is violated and what to change, or why it was not examined; else empty.
        violation: The same as data; None if it is not violated.
    """

    number: int
    statement: str
    finding: Finding
    margin: Margin | None
    reason: str
    violation: Violation | None = None


OF_VERDICT = {
    Verdict.STABLE: Finding.SATISFIED,
    Verdict.UNSTABLE: Finding.VIOLATED,
    Verdict.UNDECIDED: Finding.UNDECIDED,
}
"""What the stability of the zero dynamics says of Assumption 2.2."""
