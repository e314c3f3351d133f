"""The figures of a run as a table."""

from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import fill
from typing import Self

import numpy as np

from drake_dae.analysis.tables import Table
from drake_dae.arrays import FloatArray
from drake_dae.dae.system.signals import Signal
from drake_dae.robots.model import RobotModel
from drake_dae.simulation.job import late_rms
from drake_dae.simulation.records.phases import phase_spans
from drake_dae.simulation.records.record import Record
from drake_dae.simulation.simulate import RunStatistics
from drake_dae.simulation.verdict import ROUND_OFF, in_words, judge, unit_sizes

WIDTH = 100
"""The width of a paragraph, in characters."""

SLACK = 1e-9
"""A smaller excess over a joint limit, in its unit, is ignored: a start may be on the limit."""


@dataclass(frozen=True, eq=False)
class Limits:
    """The limits of a robot; None without limits.

    Attributes:
        control: The largest |u|, shape (p,).
        state: The lowest and the highest (q, v), shape (nq + nv,) each.
        loops: The same for the joints that close loops, (c, c').
        pushing: Names of the unilateral constraint forces; None if all are unilateral.
    """

    control: FloatArray | None = None
    state: tuple[FloatArray, FloatArray] | None = None
    pushing: frozenset[str] | None = None
    loops: tuple[FloatArray, FloatArray] | None = None

    def can_pull(self, force: Signal) -> bool:
        """Whether a constraint force may be negative."""
        return self.pushing is not None and force.name not in self.pushing

    @classmethod
    def of(cls, model: RobotModel) -> Self:
        """The limits of a robot: of its drives, joints and contacts."""
        pairs = zip(model.links.position_limits, model.links.velocity_limits, strict=True)
        lower, upper = (np.concatenate(pair) for pair in pairs)
        state = (lower, upper) if np.any(np.isfinite([lower, upper])) else None
        pushing = frozenset(
            signal.name
            for constraint in model.constraints
            for signal, pushes in zip(
                constraint.force_signals, constraint.is_unilateral, strict=True
            )
            if pushes
        )
        loops = model.loop_joints.limits if model.loop_joints.signals else None
        return cls(model.control_limits, state, pushing, loops)


def summary(
    record: Record,
    predicted: FloatArray,
    limits: Limits | None = None,
    run: RunStatistics | None = None,
    failure: str = "",
    accuracy: float | None = None,
    reasons: Sequence[str] = (),
) -> str:
    """A summary of a run in plain text: its figures, compared with the prediction.

    Numbers that are round-off relative to others of the same unit are shown as 0.

    Args:
        record: A record with state, desired_output, tracking_error, constraint_residual,
            constraint_force and control.
        predicted: The tracking error by theory, shape (k, p).
        limits: The limits of the robot.
        run: The statistics of the run; None for a failed run.
        failure: The reason of the failure.
        accuracy: The accuracy of error control; None with fixed steps.
        reasons: Reasons for a deviation from the prediction, such as "the law is sampled".
    """
    limits = limits or Limits()
    sections = [
        _errors(record, predicted),
        _phases(record),
        _forces(record, limits),
        _controls(record, limits),
    ]
    residual = np.max(np.abs(record["constraint_residual"]), initial=0.0)
    # In compliant contact the state is not projected.
    is_compliant = "contact_force" in record
    kind = "in compliant contact" if is_compliant else "before each step's projection"
    notes = [f"constraint residual  {residual:.2g} at most, {kind}"]
    notes += _identified(record)
    notes += [f"joint limits         {text}" for text in _beyond(record, limits)]
    ended = ""
    if run is not None:
        notes.append(
            f"simulated            {run.simulated_time:g} s in {run.steps} steps, "
            f"{run.wall_time:.2f} s, {run.times_real_time:.1f} times real time"
        )
        if run.interrupted:
            notes.append("interrupted          the record ends there")
            ended = f"Interrupted at {record.time[-1]:.4g} s"
    if failure:
        notes.append(f"failed               the record ends at {record.time[-1]:.6g} s: {failure}")
        ended = f"The run ended early, at {record.time[-1]:.4g} s"
        reasons = ["of what ended it, see above"]
    words = in_words(judge(record, predicted, accuracy), accuracy, reasons, ended)
    verdict = [fill(words, WIDTH)]
    return "\n\n".join("\n".join(lines) for lines in [*sections, notes, verdict] if lines)


def _errors(record: Record, predicted: FloatArray) -> list[str]:
    signals = record.signals["tracking_error"].signals
    if not signals:
        return []
    sizes = unit_sizes(record)
    errors = record["tracking_error"].T
    late = late_rms(record.time, record["tracking_error"])
    head = ["tracking error", "unit", "start", "largest", "final", "late rms", "off prediction by"]
    rows = []
    for signal, error, theory, rms in zip(signals, errors, predicted.T, late, strict=True):
        size, off = sizes[signal.unit], np.max(np.abs(error - theory))
        courses = (error[0], np.max(np.abs(error)), error[-1])
        numbers = [*(_number(e, size, 3) for e in courses), _number(rms, size, 2)]
        rows.append([signal.name, signal.unit or "1", *numbers, _number(off, size, 2)])
    notes = [
        "late rms: the root mean square in the second half of the run",
        "off prediction by: the largest deviation from the predicted error, which decays",
        "from its initial value by the gains alone",
    ]
    return [*Table(head, rows, left=2).lines(), *notes]


def _phases(record: Record) -> list[str]:
    """The errors of each phase of a task, after transients."""
    spans, signals = phase_spans(record), record.signals["tracking_error"].signals
    if not spans or not signals:
        return []
    units = list(dict.fromkeys(signal.unit for signal in signals))
    columns_of = [[i for i, signal in enumerate(signals) if signal.unit == unit] for unit in units]
    sizes, rows, last = unit_sizes(record), [], 0
    for span in spans:
        # At the time of a change a row has the values before it.
        first, last = last, int(np.searchsorted(record.time, span.end, side="right"))
        rms = late_rms(record.time[first:last], record["tracking_error"][first:last])
        sums = [float(np.linalg.norm(rms[columns])) for columns in columns_of]
        numbers = [_number(total, sizes[unit], 2) for total, unit in zip(sums, units, strict=True)]
        rows.append([span.name, f"{span.begin:.4g}", f"{span.end:.4g}", *numbers])
    heads = [f"late rms [{unit or '1'}]" for unit in units]
    return [
        *Table(["phase", "from [s]", "to [s]", *heads], rows).lines(),
        "late rms: of all errors in a unit together, in the second half of the phase",
    ]


def _extremes(record: Record, name: str) -> list[list[str]]:
    """Name, unit, least and largest value of each entry of a signal."""
    recorded, sizes = record.signals[name], unit_sizes(record)
    return [
        [s.name, s.unit or "1", *(_number(f(v), sizes[s.unit], 4) for f in (np.min, np.max))]
        for s, v in zip(recorded.signals, recorded.values.T, strict=True)
    ]


def _forces(record: Record, limits: Limits) -> list[str]:
    forces = record.signals["constraint_force"]
    if not forces.signals:
        return []
    pulls = [
        "pulls: a real contact would open" if _pulls(record, signal, values, limits) else ""
        for signal, values in zip(forces.signals, forces.values.T, strict=True)
    ]
    rows = zip(_extremes(record, "constraint_force"), pulls, strict=True)
    head = ["constraint force", "unit", "least", "largest", ""]
    return Table(head, [[*row, text] for row, text in rows], left=2).lines()


def _controls(record: Record, limits: Limits) -> list[str]:
    controls = record.signals["control"]
    if not controls.signals:
        return []
    largest = _largest_controls(record, limits)
    # A sample describes the step before it.
    excess = record["excess"] if "excess" in record else np.zeros_like(controls.values)
    cut_off = np.diff(record.time, prepend=record.time[:1]) @ (excess != 0.0)
    rows = []
    columns = zip(controls.values.T, largest, cut_off, strict=True)
    for row, (values, limit, time) in zip(_extremes(record, "control"), columns, strict=True):
        remark = "over its limit" if np.max(np.abs(values)) > limit else ""
        remark = f"cut off for {time:.3g} s" if time else remark
        rows.append([*row, f"{limit:.4g}" if np.isfinite(limit) else "none", remark])
    return Table(["control", "unit", "least", "largest", "limit", ""], rows, left=2).lines()


UNEXCITED = 0.5
"""A parameter is not excited if its deviation stays above this share of that of its bounds."""


def _identified(record: Record) -> list[str]:
    """The friction, or all parameters, identified by an observer at the end."""
    if "identified" in record.signals:
        return _estimated(record)
    if "friction" not in record.signals:
        return []
    friction = record.signals["friction"]
    pairs = zip(friction.signals, friction.values[-1], strict=True)
    text = ", ".join(f"{signal.name} = {value:.3g}" for signal, value in pairs)
    return [f"identified           {text} at the end"]


def _estimated(record: Record) -> list[str]:
    """Estimated parameters with their standard deviations, and those that remain unknown."""
    recorded, deviations = record.signals["identified"], record["identified_deviation"]
    found, unknown = list[str](), list[str]()
    # The first row has the deviations of values that are equally likely within their bounds.
    for signal, value, own, prior in zip(
        recorded.signals, recorded.values[-1], deviations[-1], deviations[0], strict=True
    ):
        text = f"{signal.name} = {value:.3g} +- {own:.1g} {signal.unit}".rstrip()
        if own < UNEXCITED * prior:
            found.append(f"identified           {text}")
        else:
            unknown.append(signal.name)
    if unknown:
        names = ", ".join(unknown)
        found.append(f"not identified       {names}: this motion does not excite them")
    return found


def _number(value: float, size: float, digits: int) -> str:
    """A number, or 0 if it is round-off of numbers of a given size."""
    return "0" if abs(value) <= ROUND_OFF * size else f"{value:.{digits}g}"


def _largest_controls(record: Record, limits: Limits) -> FloatArray:
    count = len(record.signals["control"].signals)
    return np.full(count, np.inf) if limits.control is None else limits.control


def _pulls(record: Record, signal: Signal, values: FloatArray, limits: Limits) -> bool:
    """Whether an ideal contact would have to pull.

    A compliant one, whose whole force is recorded, cannot.
    """
    is_ideal = "contact_force" not in record
    return is_ideal and bool(np.min(values) < 0.0) and not limits.can_pull(signal)


def shortfalls(record: Record, limits: Limits) -> list[str]:
    """The violations of limits in a run, a phrase each.

    Args:
        record: A record with constraint_force and control.
        limits: The limits of the robot.
    """
    forces, controls = record.signals["constraint_force"], record.signals["control"]
    texts = [
        f"{signal.name} would open at t = {record.time[np.argmax(values < 0.0)]:.4g} s, where its "
        f"force begins to pull, with up to {-np.min(values):.3g} {signal.unit}"
        for signal, values in zip(forces.signals, forces.values.T, strict=True)
        if _pulls(record, signal, values, limits)
    ]
    over = np.max(np.abs(controls.values), axis=0, initial=0.0) > _largest_controls(record, limits)
    beyond = [signal.name for signal, over in zip(controls.signals, over, strict=True) if over]
    if beyond:
        texts.append(f"{', '.join(beyond)} would exceed the limits")
    if joints := [text.split(" goes from ")[0] for text in _beyond(record, limits)]:
        texts.append(f"{', '.join(joints)} would leave the joint limits")
    return texts


def _beyond(record: Record, limits: Limits) -> list[str]:
    """Positions and velocities beyond their limits."""
    rows: list[tuple[Signal, FloatArray, float, float]] = []
    for key, bounds in (("state", limits.state), ("loop_state", limits.loops)):
        if bounds is not None and key in record.signals:
            recorded = record.signals[key]
            rows += zip(recorded.signals, recorded.values.T, *bounds, strict=False)
    return [
        f"{signal.name} goes from {np.min(values):.4g} to {np.max(values):.4g} {signal.unit}, "
        f"its limits are {lower:.4g} and {upper:.4g}"
        for signal, values, lower, upper in rows
        if np.min(values) < lower - SLACK or np.max(values) > upper + SLACK
    ]
