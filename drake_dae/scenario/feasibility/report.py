"""The requirements of a scenario's reference: values, tables, and problems."""

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from drake_dae.analysis.limits import LimitsAlong
from drake_dae.analysis.report import Analysis
from drake_dae.analysis.tables import Part, Table, count_of, digits, to_markdown, to_text
from drake_dae.dae.system.signals import Signal
from drake_dae.robots.links_behind import LinkBehind

WRONG_SIDE = (
    ": turn its normal around if its free side is the other one, or choose another posture or place"
)
"""The remedy for a link behind a surface."""


@dataclass(frozen=True, eq=False)
class SignalRange:
    """One signal along the reference.

    Attributes:
        signal: Name and unit.
        least, least_time: The lowest value, and when in s.
        largest, largest_time: The highest value, and when in s.
        low, high: The limits; infinite without a limit.
        beyond_time: The first time beyond a limit, in s; None if there is none.
    """

    signal: Signal
    least: float
    least_time: float
    largest: float
    largest_time: float
    low: float
    high: float
    beyond_time: float | None

    @property
    def peak(self) -> tuple[float, float]:
        """The value of largest magnitude, and its time."""
        if abs(self.least) > abs(self.largest):
            return self.least, self.least_time
        return self.largest, self.largest_time

    def to_dict(self) -> dict[str, Any]:
        """The range as plain numbers; None for an infinite limit."""
        return {
            "name": self.signal.name,
            "unit": self.signal.unit,
            "least": {"value": self.least, "time": self.least_time},
            "largest": {"value": self.largest, "time": self.largest_time},
            "low": self.low if np.isfinite(self.low) else None,
            "high": self.high if np.isfinite(self.high) else None,
            "beyond_time": self.beyond_time,
        }


@dataclass(frozen=True, eq=False)
class Feasibility:
    """The analysis of a scenario's robot, and the requirements of its reference.

    All numbers are those of the law's model without errors: the minimum requirements.

    Attributes:
        analysis: The result of `analyze`, around the start and along the reference.
        duration: The duration of the scenario, in s.
        controls: u, with the limits of the actuators.
        joint_forces: The joint forces of the actuation, with their effort limits; empty with rigid
            joints, where they are u.
        constraint_forces: lambda; zero is the lower limit of unilateral constraints.
        joints: Positions and velocities of the joints that have limits.
        is_resolved: Whether the times resolve the reference; otherwise values between them are not
            known.
        behind: Links that move behind a contact surface.
        sticking: A sentence if fixed steps are too long for a contact to stick, else empty.
        gains: Why no gains can be computed where they are left out, else empty.
        slowing: How much slower the references keep all limits; None where they keep them.
    """

    analysis: Analysis
    duration: float
    controls: tuple[SignalRange, ...] = ()
    joint_forces: tuple[SignalRange, ...] = ()
    constraint_forces: tuple[SignalRange, ...] = ()
    joints: tuple[SignalRange, ...] = ()
    is_resolved: bool = True
    behind: tuple[LinkBehind, ...] = ()
    sticking: str = ""
    gains: str = ""
    slowing: LimitsAlong | None = None

    @property
    def wrong_sides(self) -> tuple[str, ...]:
        """The problems with links behind a surface."""
        return tuple(f"{link}{WRONG_SIDE}" for link in self.behind)

    @property
    def problems(self) -> tuple[str, ...]:
        """The problems, one text each; empty if there are none."""
        return (
            *self.analysis.problems,
            *map(_exceeded, _beyond((*self.controls, *self.joint_forces))),
            *map(_pulling, _beyond(self.constraint_forces)),
            *map(_left, _beyond(self.joints)),
            *self.wrong_sides,
            *([self.gains] if self.gains else []),
            *(
                []
                if self.slowing is None
                else [f"most of all {self.slowing.excess}; {self.slowing.remedy}"]
            ),
        )

    def __repr__(self) -> str:
        text = count_of(len(self.problems), "problem") if self.problems else "no problem found"
        return f"Feasibility('{self.analysis.system.name}': {text})"

    def __str__(self) -> str:
        return to_text(self._parts())

    def to_markdown(self) -> str:
        """The report with Markdown tables."""
        return to_markdown(self._parts())

    def to_dict(self) -> dict[str, Any]:
        """The report as plain numbers, lists and texts."""
        return {
            "analysis": self.analysis.to_dict(),
            "duration": self.duration,
            "resolved": self.is_resolved,
            **{
                key: [r.to_dict() for r in getattr(self, key)]
                for key in ("controls", "joint_forces", "constraint_forces", "joints")
            },
            "behind": [asdict(link) for link in self.behind],
            "sticking": self.sticking,
            "slowing": None if self.slowing is None else asdict(self.slowing),
            "problems": list(self.problems),
        }

    def _parts(self) -> list[Part]:
        tables = (
            _table(_NEEDED, self.controls, _needed_row),
            _table(["joint force", *_NEEDED[1:]], self.joint_forces, _needed_row),
            _table(_FORCE, self.constraint_forces, _force_row),
            _table(_JOINT, self.joints, _joint_row),
        )
        parts = [*self.analysis.parts(), *(table for table in tables if table.rows)]
        motion = self.analysis.motion
        if motion is not None and motion.times.size:
            text = f"Started without errors, and examined at {motion.times.size} times."
            if not self.is_resolved:
                text += (
                    " The reference varies too fast for these: what lies between them is not "
                    "known. A shorter duration takes them closer together."
                )
            parts.append([text])
        if self.sticking:
            parts.append([self.sticking])
        parts.append([f"PROBLEM  {text}" for text in self.problems] or ["no problem found"])
        return parts


_NEEDED = ["control needed", "unit", "largest", "at", "limit", ""]
_FORCE = ["constraint force", "unit", "least", "at", "largest", "at", ""]
_JOINT = ["joint", "unit", "least", "largest", "limits", ""]


def _table(
    head: list[str], ranges: Iterable[SignalRange], row: Callable[[SignalRange], list[str]]
) -> Table:
    names = ([r.signal.name, r.signal.unit or "1", *row(r)] for r in ranges)
    return Table(head, list(names), left=2)


def _needed_row(r: SignalRange) -> list[str]:
    value, time = r.peak
    limit = f"{r.high:.4g}" if np.isfinite(r.high) else "none"
    remark = "" if r.beyond_time is None else "over its limit"
    return [digits(abs(value)), _when(r, time), limit, remark]


def _force_row(r: SignalRange) -> list[str]:
    remark = "" if r.beyond_time is None else "pulls: a real contact would open"
    least, largest = digits(r.least), digits(r.largest)
    return [least, _when(r, r.least_time), largest, _when(r, r.largest_time), remark]


def _joint_row(r: SignalRange) -> list[str]:
    remark = "" if r.beyond_time is None else f"leaves at {r.beyond_time:.4g} s"
    return [digits(r.least), digits(r.largest), f"{r.low:.4g} to {r.high:.4g}", remark]


def _when(r: SignalRange, time: float) -> str:
    """The time in words; empty for a constant, whose extremes are round-off."""
    size = max(abs(r.least), abs(r.largest))
    return f"{time:.4g} s" if r.largest - r.least > 1e-9 * size else ""


def _beyond(ranges: Iterable[SignalRange]) -> list[SignalRange]:
    return [r for r in ranges if r.beyond_time is not None]


def _exceeded(r: SignalRange) -> str:
    (value, time), unit = r.peak, r.signal.unit
    return (
        f"{r.signal.name} needs {abs(value):.4g} {unit} at {time:.4g} s, limit {r.high:.4g} {unit}"
    )


def _pulling(r: SignalRange) -> str:
    return (
        f"{r.signal.name} pulls from {r.beyond_time:.4g} s on, most with {-r.least:.4g} "
        f"{r.signal.unit} at {r.least_time:.4g} s: a real contact would open"
    )


def _left(r: SignalRange) -> str:
    return (
        f"{r.signal.name} goes from {digits(r.least)} to {digits(r.largest)} {r.signal.unit}, its "
        f"limits are {r.low:.4g} and {r.high:.4g}, left at {r.beyond_time:.4g} s"
    )
