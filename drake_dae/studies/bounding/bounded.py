"""The errors of a scenario for declared ranges of unknown numbers: their bound and its causes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from drake_dae.analysis.contact_text import contact_margin_as_dict
from drake_dae.analysis.tables import Part, Table, count_of, to_markdown, to_text
from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.dae.states.contact_margin import ContactMargin
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError
from drake_dae.scenario.scenario import Scenario, scenario_data
from drake_dae.simulation.error_bound import ErrorBound
from drake_dae.studies.bounding.declared_friction import in_words
from drake_dae.studies.runs import Runner
from drake_dae.studies.study import Study
from drake_dae.studies.variations import plain

MOST_CAUSES = 12
"""The largest number of causes with a row of their own."""

_SIDED, _FEW = 0.75, 4
"""A number is named for failures if it is at one end in at least this share of the failed runs, and
if at least so many runs failed."""


@dataclass(frozen=True)
class FailedRun:
    """A run that ended early, or had no start.

    Attributes:
        fractions: Name of a number -> 0 or 1 at an end of its range, otherwise 0.5.
        reason: Why.
    """

    fractions: Mapping[str, float]
    reason: str


@checked(ModelError)
@dataclass(frozen=True, eq=False)
class BoundedErrors:
    """A bound of the errors of a scenario, with the share of each cause.

    Attributes:
        signals: The outputs, p of them.
        after: The time in s from which the errors are bounded.
        middle: The largest |z - r| with all numbers in the middle of their ranges, shape (p,).
        shares: Cause -> the largest change of z - r, if this number alone moves from the middle to
            an end of its range, shape (p,); and the same for other seeds of noise and jitter.
        worst: The largest |z - r| of all runs, shape (p,).
        runs, corners: The number of all runs, and of random corners of the ranges.
        failed: The runs that ended early; with one of them there is no bound.
        events: "<signal>: contact lost" or "<signal>: beyond its limit" -> the number of corners.
        friction_margin: The distance of the highest declared friction from the Painleve paradox,
            along the run in the middle of all ranges, if contacts slide in their worst directions;
            None without friction, with states besides those of rigid joints, or if the sliding
            velocities of a contact are not known.
        scenario: The scenario with its law, for which this is the bound.
        runner: What simulated the runs; `study` uses its loop.
    """

    signals: tuple[Signal, ...]
    after: float
    middle: FloatArray
    shares: Mapping[str, FloatArray]
    worst: FloatArray
    runs: int
    corners: int
    failed: tuple[FailedRun, ...]
    events: Mapping[str, int]
    friction_margin: ContactMargin | None
    scenario: Scenario = field(repr=False)
    runner: Runner = field(repr=False)

    @property
    def bound(self) -> ErrorBound:
        """The bound.

        Raises:
            ModelError: There is none, since a run failed; the message contains the reason.
        """
        if self.failed:
            raise ModelError(self._no_bound)
        named = zip(self.signals, self.worst.tolist(), strict=True)
        # An output that is exact in all runs has no positive bound.
        return ErrorBound({s.name: value for s, value in named if value > 0.0}, self.after)

    @property
    def bounded_scenario(self) -> Scenario:
        """The scenario with its gains and with this bound as `error_bound`.

        Raises:
            ModelError: There is no bound.
        """
        return replace(self.scenario, error_bound=self.bound)

    def study(self, variations: Sequence[Mapping[str, Any]]) -> Study:
        """Runs the bounded scenario once for each variation, in this process.

        The runs are those of `sweep`, without its file and its processes: they need no loop and no
        machine code of their own, and a crash ends this process.

        Args:
            variations: As for `sweep`.

        Raises:
            ModelError: There is no bound.
        """
        scenario = self.bounded_scenario
        chosen = tuple({k: plain(k, v) for k, v in changes.items()} for changes in variations)
        results = self.runner.of(scenario_data(scenario)).run_all(list(enumerate(chosen)))
        return Study(chosen, tuple(results), scenario, self.runner.is_rollout)

    @property
    def _no_bound(self) -> str:
        count = count_of(len(self.failed), "run")
        text = f"there is no bound: {count} of {self.runs} ended early"
        if sides := self._sides():
            text += f", most of them with {' and '.join(sides)}"
        return f"{text}. The first one: {self.failed[0].reason}"

    def _sides(self) -> list[str]:
        """The numbers that are on one side of their range in most failed runs."""
        found = []
        if len(self.failed) < _FEW:
            return []
        for name in self.failed[0].fractions:
            at = [failed.fractions[name] for failed in self.failed]
            for end, side in ((0.0, "low"), (1.0, "high")):
                if (share := float(np.mean([value == end for value in at]))) >= _SIDED:
                    found.append((share, f"{name} at its {side} end"))
        return [text for _, text in sorted(found, reverse=True)[:3]]

    def __repr__(self) -> str:
        return f"BoundedErrors({self._no_bound if self.failed else self.bound})"

    def __str__(self) -> str:
        return to_text(self._parts())

    def to_markdown(self) -> str:
        """The report with Markdown tables."""
        return to_markdown(self._parts())

    def to_dict(self) -> dict[str, Any]:
        """The report as plain numbers, lists and texts."""
        names = [signal.name for signal in self.signals]

        def named(values: FloatArray) -> dict[str, float]:
            return dict(zip(names, values.tolist(), strict=True))

        return {
            "after": self.after,
            "bound": None if self.failed else dict(self.bound.outputs),
            "middle": named(self.middle),
            "shares": {name: named(values) for name, values in self.shares.items()},
            "worst": named(self.worst),
            "runs": self.runs,
            "corners": self.corners,
            "failed": [failed.reason for failed in self.failed],
            "events": dict(self.events),
            "friction_margin": contact_margin_as_dict(self.friction_margin),
        }

    def _parts(self) -> list[Part]:
        head = ["cause", *(f"{s.name} [{s.unit or '1'}]" for s in self.signals)]
        scale = np.where(self.worst > 0.0, self.worst, 1.0)
        sizes = {name: float((share / scale).max()) for name, share in self.shares.items()}
        order = sorted(sizes, key=lambda name: -sizes[name])
        rows = [("all in the middle", self.middle)]
        rows += [(name, self.shares[name]) for name in order[:MOST_CAUSES]]
        if rest := order[MOST_CAUSES:]:
            text = f"{len(rest)} others, each at most"
            rows.append((text, np.array([self.shares[name] for name in rest]).max(axis=0)))
        worst = f"the worst of {self.runs - len(self.failed)} runs"
        rows.append((worst if self.failed else f"bound: {worst}", self.worst))
        table = Table(head, [[name, *(f"{v:.2g}" for v in values)] for name, values in rows])
        lines = [
            f"The largest errors |z - r| from {self.after:g} s on. A cause: the largest change "
            "if this number alone moves from the middle of its range to an end.",
        ]
        lines += [
            f"{event} in {count} of {self.corners} corners of the ranges"
            for event, count in sorted(self.events.items())
        ]
        if self.friction_margin is not None:
            lines.append(in_words(self.friction_margin))
        if self.failed:
            lines.append(f"PROBLEM  {self._no_bound}")
        else:
            lines.append(
                f"The bound is the largest error of {self.corners} random corners of the ranges "
                "and of the runs with one number at an end."
            )
        return [table, lines]
