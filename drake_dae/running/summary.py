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
    late_rms,
    record_sizes,
)
from drake_dae.running.simulate import RunStatistics

WIDTH, MOST = 100, 6  # The width of a paragraph; the most findings that follow the first one.
UNEXCITED = 0.5  # A parameter is not excited whose deviation is above this share of that at first.
SURE = 2.0  # The number of deviations from which an estimate differs from what the law believes.

_FORCES = (LimitKind.FORCE, LimitKind.CONTROL, LimitKind.EFFORT)


@dataclass(frozen=True, eq=False)
class RunSummary(Judgement):
    """What is told about a run: `text` and `data` say the same.

    `remedies` are what to look at beside the causes of the findings, `notes` what is approximate,
    and `named` the parameters that the user had estimated; statistics are None for a failed run.
    """

    statistics: RunStatistics | None = None
    remedies: Sequence[str] = ()
    notes: Sequence[str] = ()
    named: Collection[str] = ()

    @property
    def missed(self) -> bool:
        """Whether the run is bad, or off the prediction for no known reason."""
        return self.outcome is Outcome.BAD or any(
            f.kind is FindingKind.PREDICTION and f.decides for f in self.findings
        )

    @property
    def look_next(self) -> list[str]:
        """What to change, or to look at."""
        causes = [f.cause for f in self.findings if f.decides and f.cause]
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
        ran = self.statistics
        names = ("simulated_time", "steps", "wall_time")
        return {
            "outcome": str(self.outcome),
            "reason": str(self),
            "missed": self.missed,
            "findings": [_named(asdict(finding)) for finding in self.findings],
            "outputs": [_named(asdict(output)) for output in self.outputs],
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
        sizes = record_sizes(self.record)

        def number(value: float, signal: Signal, digits: int) -> str:
            """A number, or 0 if it is round-off."""
            size = sizes.get(signal.unit, 0.0)
            return "0" if abs(value) <= ROUND_OFF * size else f"{value:.{digits}g}"

        # Findings; the prediction stands below the table, unless it decides.
        off = [f for f in self.findings if f.kind is FindingKind.PREDICTION and not f.decides]
        told = [f for f in self.findings[1:] if f not in off]
        head = [fill(str(self), WIDTH)]
        head += [fill(f"- {f.text}", WIDTH, subsequent_indent="  ") for f in told[:MOST]]
        head += [f"- {len(told) - MOST} more, which --json names"] * (len(told) > MOST)

        # The table of outputs.
        rows, outputs = list[list[str]](), list[str]()
        for q in self.outputs:
            numbers = (q.start, 3), (q.largest, 3), (q.late_rms, 2), (q.off_prediction, 2)
            texts = [number(value, q.signal, digits) for value, digits in numbers]
            rows.append([q.signal.name, q.signal.unit or "1", *texts, f"{q.tolerance:.2g}"])
        if rows:
            names = ["tracking error", "unit", "start", "largest", "late rms", "off prediction"]
            note = "late: in the second half; off prediction: from the error that the gains alone "
            note += f"leave; as {off[0].cause}" if off and not self.missed else "leave"
            table = str(Table([*names, "tolerated"], rows, left=2))
            outputs = [table, fill(note, WIDTH, subsequent_indent="  ")]

        # The table of forces and controls.
        rows = []
        for r in self._limited:
            limit = "none" if r.high == np.inf else f"{r.high:.4g}"
            limit, cut = "pushes only" if r.low == 0.0 else limit, self._cut_off(r)
            texts = [number(value, r.signal, 4) for value in (r.least, r.largest)]
            remark = f"cut off for {cut:.3g} s" if cut else ""
            rows.append([r.signal.name, r.signal.unit or "1", *texts, limit, remark])
        names = ["force or control", "unit", "least", "largest", "limit", ""]
        forces = [str(Table(names, rows, left=2))] if rows else []

        phases = [fill(str(change), WIDTH, subsequent_indent="  ") for change in self.changes]
        ending = [
            fill(f"{title:21}{text}", WIDTH, subsequent_indent=" " * 21)
            for title, text in self._ending()
        ]
        parts = filter(None, [head, outputs, forces, phases, ending])
        return "\n\n".join("\n".join(part) for part in parts)

    @property
    def _limited(self) -> list[SignalRange]:
        """Forces of constraints, controls, and forces of joints behind their actuation."""
        found = [r for r in self.ranges if r.kind in _FORCES]
        return sorted(found, key=lambda r: _FORCES.index(r.kind))

    def _cut_off(self, limited: SignalRange) -> float:
        """The time for which a control was cut off at its limit, in s."""
        if limited.kind is not LimitKind.CONTROL or "excess" not in self.record:
            return 0.0
        times, excess = self.record.time, self.record["excess"]
        column = [s.name for s in self.record.signals["control"].signals].index(limited.signal.name)
        # A sample describes the step before it.
        return float(np.diff(times, prepend=times[:1]) @ (excess[:, column] != 0.0))

    def _ending(self) -> Iterator[tuple[str, str]]:
        """Residual and speed, what is identified and approximate, and what to look at next."""
        if any(self.residual.values()):
            numbers = ", ".join(f"{v:.2g} {unit}".rstrip() for unit, v in self.residual.items())
            # In compliant contact the state is not projected.
            when = "" if "contact_force" in self.record else ", before the projection of each step"
            yield "constraint residual", f"{numbers} at most{when}"
        if (ran := self.statistics) is not None:
            yield (
                "simulated",
                f"{ran.simulated_time:g} s in {ran.steps} steps, {ran.wall_time:.2f} s, "
                f"{ran.times_real_time:.1f} times real time",
            )
        nearest = list[str]()
        for kinds in ((LimitKind.CONTROL, LimitKind.EFFORT), (LimitKind.POSITION,)):
            ranges = [r for r in self.ranges if r.kind in kinds and isfinite(r.share)]
            for r in sorted(ranges, key=lambda r: -r.share)[:1]:
                unit = f" {r.signal.unit}".rstrip()
                left = f"{r.share:.0%} of {r.high:.4g}{unit}"
                left = f"{r.room:.3g}{unit} left" if r.kind is LimitKind.POSITION else left
                nearest.append(f"{r.signal.name}, {left}")
        if nearest:
            yield "nearest to a limit", "; ".join(nearest)
        yield from _identified(self.record, self.named)
        yield from (("note", note) for note in self.notes)
        yield from (("look next", text) for text in self.look_next)


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


def figures_of(record: Record, ranges: Sequence[SignalRange]) -> dict[str, float]:
    """The figures of a run: name with unit, such as "largest error of tool.z [m]" -> number.

    For each output: the largest |z - r|, the last z - r, and the "late" error, the root mean square
    of z - r over the second half of the time. For each constraint force: its least and largest
    value. For each control: the largest |u|. Then the "margin" of each limited signal, its least
    distance from its limits, which is negative beyond them; the largest constraint residual before
    a projection, and the time at which the record ends. An empty record has none.
    """
    figures = dict[str, float]()

    def add(what: str, signal: Signal, value: float) -> None:
        figures[f"{what} {signal.name}" + (f" [{signal.unit}]" if signal.unit else "")] = value

    if not record.time.size:
        return figures
    errors = record.signals["tracking_error"]
    late = late_rms(record.time, errors.values) if errors.signals else ()
    for signal, column, rms in zip(errors.signals, errors.values.T, late, strict=True):
        add("largest error of", signal, float(np.max(np.abs(column))))
        add("final error of", signal, float(column[-1]))
        add("late error of", signal, float(rms))
    forces, controls = (record.signals[name] for name in ("constraint_force", "control"))
    for signal, column in zip(forces.signals, forces.values.T, strict=True):
        add("least", signal, float(np.min(column)))
        add("largest", signal, float(np.max(column)))
    for signal, column in zip(controls.signals, controls.values.T, strict=True):
        add("largest", signal, float(np.max(np.abs(column))))
    for r in ranges:
        # The margin of a force that may not pull is its least value.
        if isfinite(r.room) and r.kind is not LimitKind.FORCE:
            add("margin of", r.signal, r.room)
    figures["largest residual"] = float(np.abs(record["constraint_residual"]).max(initial=0.0))
    figures["end [s]"] = float(record.time[-1])
    return figures
