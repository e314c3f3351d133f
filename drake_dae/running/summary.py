"""A judged run as text of at most a page, as data, and as figures for tables of many runs."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import asdict, dataclass
from math import isfinite
from textwrap import fill
from typing import Any

import numpy as np

from drake_dae.analysis import LimitKind, SignalRange, Table
from drake_dae.dae import Signal
from drake_dae.diagrams.record import Record
from drake_dae.running.judgement import (
    ROUND_OFF,
    FindingKind,
    Judgement,
    Outcome,
    qualities,
    record_sizes,
)
from drake_dae.running.simulate import RunStatistics
from drake_dae.systems.control.contract import PhaseChange

WIDTH = 100
"""The width of a paragraph, in characters."""

MOST = 6
"""The most findings that the text tells beside the first."""

EXPECTED = (FindingKind.PREDICTION,)
"""What the table of outputs tells, unless it decides."""

UNEXCITED = 0.5
"""A parameter is not excited if its deviation stays above this share of that of its bounds."""

SURE = 2.0
"""The number of standard deviations from which an estimate differs from what the law believes."""

_FORCES = (LimitKind.FORCE, LimitKind.CONTROL, LimitKind.EFFORT)


@dataclass(frozen=True, eq=False)
class RunSummary:
    """What is told about a run: `text` and `data` say the same.

    `remedies` are what to look at beside the causes of the findings, `notes` what is approximate,
    `accuracy` that of error control, and `named` the parameters that the user had estimated;
    statistics are None for a failed run.
    """

    judgement: Judgement
    record: Record
    changes: Sequence[PhaseChange] = ()
    statistics: RunStatistics | None = None
    remedies: Sequence[str] = ()
    notes: Sequence[str] = ()
    accuracy: float | None = None
    named: Collection[str] = ()

    @property
    def missed(self) -> bool:
        """Whether the run is bad, or off the prediction for no known reason."""
        return self.judgement.outcome is Outcome.BAD or any(
            f.kind is FindingKind.PREDICTION and f.decides for f in self.judgement.findings
        )

    @property
    def look_next(self) -> list[str]:
        """What to change, or to look at."""
        causes = [f.cause for f in self.judgement.findings if f.decides and f.cause]
        return list(dict.fromkeys([*self.remedies, *causes]))

    @property
    def residual(self) -> dict[str, float]:
        """Unit -> the largest constraint residual in it."""
        recorded, found = self.record.signals["constraint_residual"], dict[str, float]()
        largest = np.max(np.abs(recorded.values), axis=0, initial=0.0).tolist()
        for signal, value in zip(recorded.signals, largest, strict=True):
            found[signal.unit] = max(found.get(signal.unit, 0.0), value)
        return found

    @property
    def data(self) -> dict[str, Any]:
        """The summary as plain data."""
        judgement, ran = self.judgement, self.statistics
        names = ("simulated_time", "steps", "wall_time")
        return {
            "outcome": str(judgement.outcome),
            "reason": str(judgement),
            "missed": self.missed,
            "findings": [_named(asdict(finding)) for finding in judgement.findings],
            "outputs": [_named(asdict(output)) for output in judgement.outputs],
            "forces_and_controls": [
                {"kind": str(r.kind), **r.to_dict(), "cut_off": self._cut_off(r)}
                for r in self._limited
            ],
            "phases": [asdict(change) for change in self.changes],
            "residual": self.residual,
            "look_next": self.look_next,
            "notes": list(self.notes),
            "interrupted": ran is not None and ran.interrupted is not None,
            **{name: getattr(ran, name, None) for name in names},
        }

    @property
    def text(self) -> str:
        """The summary in lines of at most 100 characters; the first says good, bad, undecided."""
        head = [fill(str(self.judgement), WIDTH)]
        told = [f for f in self.judgement.findings[1:] if f.kind not in EXPECTED or f.decides]
        for finding in told[:MOST]:
            head.append(fill(f"- {finding.text}", WIDTH, subsequent_indent="  "))
        head += [f"- {len(told) - MOST} more, which --json names"] * (len(told) > MOST)
        phases = [fill(str(change), WIDTH, subsequent_indent="  ") for change in self.changes]
        parts = [head, self._outputs(), self._forces(), phases, [*self._ending()]]
        return "\n\n".join("\n".join(part) for part in parts if part)

    def _outputs(self) -> list[str]:
        sizes, rows = record_sizes(self.record), []
        for q in self.judgement.outputs:
            numbers = (q.start, 3), (q.largest, 3), (q.late_rms, 2), (q.off_prediction, 2)
            texts = [_number(value, sizes[q.signal.unit], digits) for value, digits in numbers]
            rows.append([q.signal.name, q.signal.unit or "1", *texts, f"{q.tolerance:.2g}"])
        off = [f.cause for f in self.judgement.findings if f.kind is FindingKind.PREDICTION]
        why = f"; as {off[0]}" if off and not self.missed else ""
        note = "late: in the second half; off prediction: from the error that the gains alone leave"
        head = ["tracking error", "unit", "start", "largest", "late rms", "off prediction"]
        table = str(Table([*head, "tolerated"], rows, left=2)).splitlines()
        return [*table, fill(f"{note}{why}", WIDTH, subsequent_indent="  ")] if rows else []

    @property
    def _limited(self) -> list[SignalRange]:
        """Forces of constraints, controls, and forces of joints behind their actuation."""
        found = [r for r in self.judgement.ranges if r.kind in _FORCES]
        return sorted(found, key=lambda r: _FORCES.index(r.kind))

    def _forces(self) -> list[str]:
        sizes, rows = record_sizes(self.record), []
        for r in self._limited:
            size = sizes.get(r.signal.unit, 0.0)
            texts = [_number(value, size, 4) for value in (r.least, r.largest)]
            limit = "none" if r.high == np.inf else f"{r.high:.4g}"
            limit = "pushes only" if r.low == 0.0 else limit
            cut = self._cut_off(r)
            remark = f"cut off for {cut:.3g} s" if cut else ""
            rows.append([r.signal.name, r.signal.unit or "1", *texts, limit, remark])
        head = ["force or control", "unit", "least", "largest", "limit", ""]
        return str(Table(head, rows, left=2)).splitlines() if rows else []

    def _cut_off(self, limited: SignalRange) -> float:
        """The time for which a control was cut off at its limit, in s."""
        if limited.kind is not LimitKind.CONTROL or "excess" not in self.record:
            return 0.0
        recorded, times = self.record.signals["excess"], self.record.time
        column = [s.name for s in self.record.signals["control"].signals].index(limited.signal.name)
        # A sample describes the step before it.
        return float(np.diff(times, prepend=times[:1]) @ (recorded.values[:, column] != 0.0))

    def _ending(self) -> Iterator[str]:
        """Residual and speed, what is identified and approximate, and what to look at next."""
        if any(self.residual.values()):
            numbers = ", ".join(f"{v:.2g} {unit}".rstrip() for unit, v in self.residual.items())
            # In compliant contact the state is not projected.
            when = "" if "contact_force" in self.record else ", before the projection of each step"
            yield f"constraint residual  {numbers} at most{when}"
        if (ran := self.statistics) is not None:
            yield (
                f"simulated            {ran.simulated_time:g} s in {ran.steps} steps, "
                f"{ran.wall_time:.2f} s, {ran.times_real_time:.1f} times real time"
            )
        if nearest := _nearest(self.judgement.ranges):
            yield f"nearest to a limit   {nearest}"
        lines = [*_identified(self.record, self.named), *(("note", note) for note in self.notes)]
        for title, text in (*lines, *(("look next", text) for text in self.look_next)):
            yield fill(f"{title:21}{text}", WIDTH, subsequent_indent=" " * 21)


def _nearest(ranges: Sequence[SignalRange]) -> str:
    """The drive and the joint that come closest to their limits."""
    texts = []
    for kinds in ((LimitKind.CONTROL, LimitKind.EFFORT), (LimitKind.POSITION,)):
        if limited := [r for r in ranges if r.kind in kinds and isfinite(r.share)]:
            r = max(limited, key=lambda r: r.share)
            left, unit = f"{r.share:.0%} of {r.high:.4g}", f" {r.signal.unit}".rstrip()
            left = f"{r.room:.3g}{unit} left" if r.kind is LimitKind.POSITION else f"{left}{unit}"
            texts.append(f"{r.signal.name}, {left}")
    return "; ".join(texts)


def _identified(record: Record, named: Collection[str]) -> Iterator[tuple[str, str]]:
    """What an estimator found at the end that is new or that the user named, and how many more."""
    if "identified" not in record.signals:
        if "friction" in record.signals:
            recorded = record.signals["friction"]
            pairs = zip(recorded.signals, recorded.values[-1], strict=True)
            yield "identified", ", ".join(f"{signal.name} = {value:.3g}" for signal, value in pairs)
        return
    recorded, deviations = record.signals["identified"], record["identified_deviation"]
    believed, found, own = recorded.values[0], recorded.values[-1], deviations[-1]
    # The first row has the deviations of values that are equally likely within their bounds.
    is_excited = own < UNEXCITED * deviations[0]
    is_named = np.array([s.name.partition("[")[0] in named for s in recorded.signals])
    is_told = is_excited & (is_named | (np.abs(found - believed) > SURE * own))
    for i in np.flatnonzero(is_told):
        signal = recorded.signals[i]
        yield "identified", f"{signal.name} = {found[i]:.3g} +- {own[i]:.1g} {signal.unit}".rstrip()
    if (is_named & ~is_excited).any():
        names = ", ".join(recorded.signals[i].name for i in np.flatnonzero(is_named & ~is_excited))
        yield "not identified", f"{names}: this motion does not excite them"
    counts = (
        (np.sum(is_excited & ~is_told), "more within two deviations of what the law believes"),
        (np.sum(~is_excited & ~is_named), "more that this motion does not excite"),
    )
    if texts := [f"{count} {text}" for count, text in counts if count]:
        yield "estimated", ", ".join(texts)


def _named(values: dict[str, Any]) -> dict[str, Any]:
    """Plain data of a finding or an output: the signal by name and unit, None for no number."""
    signal = values.pop("signal") or {"name": "", "unit": ""}
    values = {"name": signal["name"], "unit": signal["unit"], **values}
    is_number = {key: isinstance(value, float) for key, value in values.items()}
    return {k: None if is_number[k] and not isfinite(v) else v for k, v in values.items()}


def _number(value: float, size: float, digits: int) -> str:
    """A number, or 0 if it is round-off of numbers of a given size."""
    return "0" if abs(value) <= ROUND_OFF * size else f"{value:.{digits}g}"


def figures_of(record: Record, ranges: Sequence[SignalRange]) -> dict[str, float]:
    """The figures of a run: name with unit, such as "largest error of tool.z [m]" -> number.

    For each output: the largest |z - r|, the last z - r, and the "late" error, the root mean square
    of z - r over the second half of the time. For each constraint force: its least and largest
    value. For each control: the largest |u|. Then the "margin" of each limited signal, its least
    distance from its limits, which is negative beyond them; the largest constraint residual before
    a projection, and the time at which the record ends. An empty record has none.
    """
    if not record.time.size:
        return {}
    figures = dict[str, float]()
    for q in qualities(record, np.zeros_like(record["tracking_error"]), {}):
        figures[_label("largest error of", q.signal)] = q.largest
        figures[_label("final error of", q.signal)] = q.final
        figures[_label("late error of", q.signal)] = q.late_rms
    for name, what in (("constraint_force", "least"), ("control", "")):
        recorded = record.signals[name]
        for signal, values in zip(recorded.signals, recorded.values.T, strict=True):
            if what:
                figures[_label(what, signal)] = float(np.min(values))
            figures[_label("largest", signal)] = float(np.max(values if what else np.abs(values)))
    for r in ranges:
        # The margin of a force that may not pull is its least value.
        if isfinite(r.room) and r.kind is not LimitKind.FORCE:
            figures[_label("margin of", r.signal)] = r.room
    residuals = np.abs(record["constraint_residual"])
    figures["largest residual"] = float(np.max(residuals, initial=0.0))
    figures["end [s]"] = float(record.time[-1])
    return figures


def _label(what: str, signal: Signal) -> str:
    return f"{what} {signal.name} [{signal.unit}]" if signal.unit else f"{what} {signal.name}"
