"""Judges a run: do outputs reach their references, are all limits kept, is it as predicted?

As text of at most a page, and as data.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from functools import cached_property
from math import isfinite
from signal import Signals
from textwrap import fill
from typing import Any

import numpy as np

from drake_dae.analysis import LimitKind, SignalRange, Table, count_of
from drake_dae.arrays import FloatArray
from drake_dae.dae import Signal
from drake_dae.diagrams.record import Record
from drake_dae.systems.controller import PhaseChange

SHARE = 0.01  # The default tolerance, as a share of the range of references in an output's unit.
GRACE = 0.1  # The permitted delay relative to the prediction, as a share of the run.
# The deviation from the prediction, as a share of an output's size, from which it needs a reason;
# or so many times the accuracy of the integrator, if that is more.
NEAR, STEPS = 1e-2, 10.0
ROUND_OFF = 1e-13  # A number below this, relative to the largest one in its unit, is round-off.
PURE = {"": 1.0, "rad": 1.0}  # The least size of numbers without a unit, and of angles.


WIDTH, MOST = 100, 6  # The width of a paragraph; the most findings that follow the first one.
UNEXCITED = 0.5  # A parameter is not excited whose deviation is above this share of that at first.
ANALYZE = "`drake-dae analyze` says whether slower references keep the limits"
SURE = 2.0  # The number of deviations from which an estimate differs from what the law believes.

_FORCES = (LimitKind.FORCE, LimitKind.CONTROL, LimitKind.EFFORT)


class Outcome(StrEnum):
    """Whether a run succeeded."""

    GOOD = "good"
    BAD = "bad"
    UNDECIDED = "undecided"


class FindingKind(StrEnum):
    """What a finding on a run is about."""

    ENDED = "ended early"
    TASK = "task"
    REFERENCE = "reference"
    LIMIT = "limit"
    CONTACT = "contact"
    BEHIND = "link behind a surface"
    PREDICTION = "prediction"


@dataclass(frozen=True)
class RunFinding:
    """What a run shows, as data, and the outcome that it leads to; None for a remark."""

    kind: FindingKind
    text: str
    decides: Outcome | None = None
    signal: Signal | None = None
    value: float | None = None
    limit: float | None = None
    time: float | None = None
    cause: str = ""


@dataclass(frozen=True)
class OutputQuality:
    """How well an output followed its reference: z - r, in its unit."""

    signal: Signal
    start: float
    largest: float
    final: float
    late_rms: float
    off_prediction: float  # the largest deviation from the predicted error (30)
    tolerance: float
    within_since: (
        float | None
    )  # in s, |z - r| stayed within the tolerance; None: outside at the end


@dataclass(frozen=True)
class RunStatistics:
    """Simulated and elapsed time in s, steps, and the signal that ended a run early, if any."""

    simulated_time: float
    wall_time: float
    steps: int
    interrupted: Signals | None

    @property
    def times_real_time(self) -> float:
        """Simulated seconds per second."""
        return self.simulated_time / max(self.wall_time, 1e-9)


@dataclass(frozen=True, eq=False)
class RunSummary:
    """Whether a run succeeded, and why, in words (`text`) and as `data`, which say the same.

    Without phases, each output must be within its tolerance from the first half of the run on, or
    from the time at which the predicted error is. If the predicted error exceeds the tolerance even
    at the end, and the run follows it, the run is undecided; so it is if it is off the prediction
    for no known reason. With phases, the last one must end.
    """

    record: Record
    predicted: FloatArray
    ranges: Sequence[SignalRange] = ()
    tolerances: Mapping[str, float] = field(default_factory=dict)
    changes: Sequence[PhaseChange] = ()
    ended: str = ""  # why the run broke off
    accuracy: float | None = None  # of error control
    reasons: Sequence[str] = ()  # of a deviation from the prediction
    more: Sequence[RunFinding] = ()
    statistics: RunStatistics | None = None  # None for a failed run
    notes: Sequence[str] = ()  # what is approximate
    named: Collection[str] = ()  # the parameters that the user had estimated

    def __str__(self) -> str:
        reasons = [finding.text for finding in self.findings]
        reason = reasons[0] if reasons else "there is no output, and nothing is violated"
        return f"{self.outcome.name}: {reason}"

    @property
    def outcome(self) -> Outcome:
        return (self.findings[0].decides if self.findings else None) or Outcome.GOOD

    @cached_property
    def findings(self) -> list[RunFinding]:
        """What the run shows, that which decides first."""
        record, found = self.record, list[RunFinding]()
        if self.ended:
            end = float(record.time[-1])
            text = f"the run broke off at {end:.4g} s: {self.ended}"
            found.append(RunFinding(FindingKind.ENDED, text, Outcome.BAD, time=end))
        # Of a compliant contact the whole force is recorded, which cannot pull.
        kinds = {*LimitKind} - ({LimitKind.FORCE} if "contact_force" in record else set())
        beyond = [r.excess for r in self.ranges if r.kind in kinds and r.excess is not None]
        for excess in sorted(beyond, key=lambda e: -abs(e.value / e.limit) if e.limit else -np.inf):
            # A task and a free motion have no references, and a pace changes no position.
            is_paced = not self.changes and record["desired_output"].size
            cause = ANALYZE if is_paced and excess.kind is not LimitKind.POSITION else ""
            more = excess.signal, excess.value, excess.limit, excess.time, cause
            found.append(RunFinding(FindingKind.LIMIT, str(excess), Outcome.BAD, *more))
        found += self.more
        if self.changes:
            found += self._of_task()
        elif not self.ended:  # Else it has not had the time.
            found += [*self._of_contacts(), *self._of_outputs()]
            found += self._of_prediction() if self.outputs else ()
        order = (Outcome.BAD, Outcome.UNDECIDED, None)
        first = (FindingKind.TASK, FindingKind.REFERENCE)  # Of the remarks.
        found.sort(key=lambda f: (order.index(f.decides), not f.decides and f.kind not in first))
        return found

    @cached_property
    def outputs(self) -> list[OutputQuality]:
        """How well each output followed its reference."""
        record, predicted = self.record, self.predicted
        error, times, found = record["tracking_error"], record.time, list[OutputQuality]()
        if not error.size:
            return found
        # By default 1 % of the range of the references in the unit of an output.
        desired, signals = record["desired_output"], record.signals["tracking_error"].signals
        sizes, late = output_sizes(record, predicted), late_rms(times, error)
        spans, largest = np.ptp(desired, axis=0), np.abs(desired).max(axis=0)
        spans[spans <= ROUND_OFF * sizes] = 0.0
        units = np.array([signal.unit for signal in record.signals["desired_output"].signals])
        for i, signal in enumerate(signals):
            same = units == units[i]
            size = spans[same].max() or largest[same].max() or sizes[i]
            size = max(spans[same].max(), 1.0) if units[i] in PURE else size
            values, tolerance = error[:, i], self.tolerances.get(signal.name, float(SHARE * size))
            ends = float(values[0]), float(np.max(np.abs(values))), float(values[-1])
            off = float(np.max(np.abs(values - predicted[:, i])))
            since = _within_since(times, values, tolerance)
            found.append(OutputQuality(signal, *ends, float(late[i]), off, tolerance, since))
        return found

    def _of_task(self) -> Iterator[RunFinding]:
        """Whether a task was done, given up, or had not ended yet; which failures it got over."""
        changes, last, decides = self.changes, self.changes[-1], None
        # After "leave" the change that led there has the reason.
        failures = [change for change in changes if change.failed and change.phase != "held"]
        if last.failed and last.phase in ("held", "leave"):
            left = ""
            if last.phase == "held" and failures and changes[-2].phase == "leave":
                last, left = failures[-1], ", and has left the contact"
            text = f"the task was given up at {last.time:.4g} s{left}: {last.reason}"
            decides, failures = Outcome.BAD, []
        elif last.phase == "held":
            text, failures = f"the task ended as chosen at {last.time:.4g} s: {last.reason}", []
        elif last.phase == "done":
            again = len(changes) - len({change.place for change in changes})
            repeated = f", {again} of them again" if again else ""
            count = count_of(len(changes) - 1, "phase")
            text = f"the task was done at {last.time:.4g} s, in {count}{repeated}"
        else:
            where = f"phase {last.place + 1}, {last.phase}, which began at {last.time:.4g} s"
            text, decides = f"the run ended during {where}", Outcome.UNDECIDED
        yield RunFinding(FindingKind.TASK, text, decides, time=last.time)
        for change in failures:
            text = f"at {change.time:.4g} s {change.reason}, and {change.phase} followed, as chosen"
            yield RunFinding(FindingKind.TASK, text, time=change.time)

    def _of_contacts(self) -> Iterator[RunFinding]:
        """Lost contacts, which are problems in the second half of the run."""
        times, forces = self.record.time, self.record.signals["constraint_force"]
        forced = (r for r in self.ranges if r.kind is LimitKind.FORCE)
        pushing = {r.signal.name for r in forced if r.low == 0.0}
        for signal, values in zip(forces.signals, forces.values.T, strict=True):
            touched = int(np.argmax(values > 0.0))  # 0 if it never is.
            lost = touched + np.flatnonzero(values[touched:-1] == 0.0)
            if signal.name not in pushing or not lost.size:
                continue
            first, lasted = times[lost[0]], np.diff(times)[lost].sum()
            text = f"{signal.name} was 0 for {lasted:.2g} s, first at {first:.4g} s"
            is_late = times[lost[-1]] >= 0.5 * (times[0] + times[-1])
            decides = Outcome.BAD if is_late else None
            yield RunFinding(FindingKind.CONTACT, text, decides, signal, 0.0, time=float(first))

    def _of_outputs(self) -> Iterator[RunFinding]:
        """Which outputs are off their references, or cannot be there yet."""
        times, error = self.record.time, self.record["tracking_error"]
        middle, grace = 0.5 * (times[0] + times[-1]), GRACE * (times[-1] - times[0])
        late, settled, are_bad = times >= middle, [], False
        for i, output in enumerate(self.outputs):
            signal, since, tolerance = output.signal, output.within_since, output.tolerance
            name, unit = signal.name, f" {signal.unit}".rstrip()
            wanted = _within_since(times, self.predicted[:, i], tolerance)
            due = None if wanted is None else max(middle, wanted + grace)
            if since is not None:
                most = float(np.max(np.abs(error[late & (times >= since), i]), initial=0.0))
                settled.append((most / tolerance, most, output))
                if due is None or since <= due:
                    continue
            numbers = signal, float(np.max(np.abs(error[late, i]))), tolerance, since
            if due is None and np.all(np.abs(error - self.predicted)[late, i] <= tolerance):
                text = f"the run is too short: {name} cannot yet be at its reference, by the gains"
                more = *numbers, "a longer duration"
                yield RunFinding(FindingKind.REFERENCE, text, Outcome.UNDECIDED, *more)
                continue
            are_bad, until = True, "ends off" if since is None else f"until {since:.3g} s is off"
            text = (
                f"{name} {until} its reference, by up to {numbers[1]:.2g}{unit} in the second half "
                f"of the run ({tolerance:.2g}{unit} tolerated)"
            )
            cause = (
                f"{name} is off likely because {', '.join(self.reasons)}" if self.reasons else ""
            )
            yield RunFinding(FindingKind.REFERENCE, text, Outcome.BAD, *numbers, cause)
        if settled and not are_bad:
            since = max(output.within_since or 0.0 for *_, output in settled)
            _, most, worst = max(settled, key=lambda each: each[0])
            which = "every output" if len(settled) == len(self.outputs) else "every other output"
            text = (
                f"{which} is at its reference from {since:.3g} s on; {worst.signal.name} comes "
                f"closest to its tolerance, with {most:.2g} of {worst.tolerance:.2g} "
                f"{worst.signal.unit}"
            ).rstrip()
            numbers = worst.signal, most, worst.tolerance, since
            yield RunFinding(FindingKind.REFERENCE, text, None, *numbers)

    def _of_prediction(self) -> Iterator[RunFinding]:
        """The output farthest off the prediction, if that is more than an integrator leaves."""
        record, accuracy, reasons = self.record, self.accuracy, self.reasons
        off = np.abs(record["tracking_error"] - self.predicted)
        shares = off / output_sizes(record, self.predicted)
        allowed, column = max(NEAR, STEPS * (accuracy or 0.0)), int(np.argmax(shares.max(axis=0)))
        if not shares[:, column].max() > allowed:
            return
        signal = record.signals["tracking_error"].signals[column]
        largest = float(off[:, column].max())
        time = float(record.time[np.argmax(shares[:, column] > allowed)])
        text = (
            f"from {time:.3g} s on the error of {signal.name} is off the predicted one, by up to "
            f"{largest:.2g} {signal.unit}".rstrip()
        )
        decides, cause = None, ", ".join(reasons)
        if not reasons:
            decides, text = Outcome.UNDECIDED, f"{text}, and nothing in the scenario explains it"
            finer = "smaller steps" if accuracy is None else f"an accuracy finer than {accuracy:g}"
            cause = f"if {finer} changes nothing, plant and law differ"
        yield RunFinding(FindingKind.PREDICTION, text, decides, signal, largest, None, time, cause)

    @property
    def missed(self) -> bool:
        """Whether the run is bad, or off the prediction for no known reason."""
        return self.outcome is Outcome.BAD or any(
            f.kind is FindingKind.PREDICTION and f.decides for f in self.findings
        )

    @property
    def look_next(self) -> list[str]:
        """What to change, or to look at."""
        return list(dict.fromkeys(f.cause for f in self.findings if f.decides and f.cause))

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
    """What an estimator found at the end that is new or that the user named."""
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
    for i in np.flatnonzero(is_excited & (is_named | (np.abs(found - believed) > SURE * own))):
        signal = recorded.signals[i]
        yield "identified", f"{signal.name} = {found[i]:.3g} +- {own[i]:.1g} {signal.unit}".rstrip()
    if (is_named & ~is_excited).any():
        names = ", ".join(recorded.signals[i].name for i in np.flatnonzero(is_named & ~is_excited))
        yield "not identified", f"{names}: this motion does not excite them"


def _named(values: dict[str, Any]) -> dict[str, Any]:
    """Plain data of a finding or an output: the signal by name and unit, None for no number."""
    signal = values.pop("signal") or {"name": "", "unit": ""}
    values = {"name": signal["name"], "unit": signal["unit"], **values}
    is_number = {key: isinstance(value, float) for key, value in values.items()}
    return {k: None if is_number[k] and not isfinite(v) else v for k, v in values.items()}


def unit_sizes(
    *groups: tuple[Sequence[Signal], FloatArray], least: Mapping[str, float] = PURE
) -> dict[str, float]:
    """Unit -> the largest finite number in it, of signals with rows of values."""
    sizes = dict(least)
    for signals, values in groups:
        largest = np.max(np.nan_to_num(np.abs(values), posinf=0.0), axis=0, initial=0.0)
        for signal, size in zip(signals, largest.tolist(), strict=False):
            sizes[signal.unit] = max(sizes.get(signal.unit, 0.0), size)
    return sizes


def record_sizes(record: Record) -> dict[str, float]:
    """Unit -> the largest number in it of states, controls, forces and references."""
    names = ("state", "control", "constraint_force", "desired_output")
    every = [record.signals[name] for name in names if name in record]
    return unit_sizes(*((one.signals, one.values) for one in every))


def output_sizes(record: Record, predicted: FloatArray) -> FloatArray:
    """The sizes of the outputs of a run, shape (p,), positive.

    The size of an output is the largest value of references and predicted errors in its unit, so
    that an output with a reference of 0 has the size of others. If all are zero, it is the largest
    value of the record in that unit, or 1.
    """
    desired, of_all = record.signals["desired_output"], record_sizes(record)
    sizes = unit_sizes((desired.signals, np.vstack([desired.values, predicted])))
    for unit, size in sizes.items():
        if size <= ROUND_OFF * of_all.get(unit, 0.0):
            sizes[unit] = of_all[unit] or 1.0
    return np.array([sizes[signal.unit] or 1.0 for signal in desired.signals])


def _within_since(times: FloatArray, error: FloatArray, tolerance: float) -> float | None:
    """The first time from which |error| stays within the tolerance; None if the last is outside."""
    outside = np.flatnonzero(~(np.abs(error) <= tolerance))
    if not outside.size:
        return float(times[0])
    return float(times[outside[-1] + 1]) if outside[-1] + 1 < times.size else None


def late_rms(times: FloatArray, errors: FloatArray) -> FloatArray:
    """Root mean squares over the second half of the times, of errors linear between them."""
    middle = 0.5 * (times[0] + times[-1])
    late = np.concatenate([[middle], times[times > middle]])
    if late.size == 1:
        return np.abs(errors[-1])
    lines = np.array([np.interp(late, times, column) for column in errors.T])
    begins, ends, steps = lines[:, :-1], lines[:, 1:], np.diff(late)
    squares = (begins**2 + begins * ends + ends**2) / 3.0
    sizes: FloatArray = np.sqrt(squares @ steps / steps.sum())
    return sizes
