"""What a scenario asks for, before it is simulated: analysis, needed forces, limits."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from drake_dae.analysis.analyze import analyze
from drake_dae.analysis.report import Analysis, count_of
from drake_dae.analysis.tables import Part, Table, digits, to_markdown, to_text
from drake_dae.arrays import FloatArray
from drake_dae.dae.signals import Signal
from drake_dae.diagrams.build import build_scenario
from drake_dae.diagrams.scenario import Scenario
from drake_dae.errors import AssumptionError, ModelError, ScenarioError
from drake_dae.robots.model import RobotModel
from drake_dae.simulation.summary import Limits
from drake_dae.systems.robot_plant import RobotPlant
from drake_dae.trace.functions import TracedFunction

SAMPLES = 1001
"""At how many times along the reference, at least."""

MOST_SAMPLES = 20_000
"""At how many times along a reference that varies fast, at most."""

_STRAIGHT = 0.01
"""How far a reference is from a straight line between two times, of the range that it covers."""

_SLACK = 1e-9
"""Of joint limits, in their unit: a start on the limit is not beyond it."""


@dataclass(frozen=True, eq=False)
class Course:
    """One signal along the reference.

    Attributes:
        signal: Name and unit.
        least, least_time: The lowest value, and when in s.
        largest, largest_time: The highest value, and when in s.
        low, high: What is allowed; infinite where all is.
        beyond_time: When it first leaves what is allowed, in s; None if never.
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
        """The value of largest size, and when."""
        if abs(self.least) > abs(self.largest):
            return self.least, self.least_time
        return self.largest, self.largest_time

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers; None for an infinite limit."""
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
class Preview:
    """The analysis of a scenario's robot, and what its reference takes.

    All is for the law's model, started without errors: the least that the scenario asks for.

    Attributes:
        analysis: Of the robot, around the start and along the reference.
        duration: Of the scenario, in s.
        controls: u, against what the actuators can do.
        joint_forces: What the actuation puts on the joints, against their effort limits; empty
            with rigid joints, where that is u.
        constraint_forces: Of the constraints.
        joints: Positions and velocities of the joints that have limits.
        is_resolved: Whether the times follow the reference; if not, it varies faster than they do,
            and the values between them are not known.
    """

    analysis: Analysis
    duration: float
    controls: tuple[Course, ...] = ()
    joint_forces: tuple[Course, ...] = ()
    constraint_forces: tuple[Course, ...] = ()
    joints: tuple[Course, ...] = ()
    is_resolved: bool = True

    @property
    def problems(self) -> tuple[str, ...]:
        """What is violated, exceeded or out of reach, one text each; empty if nothing is."""
        found = list(self.analysis.problems)
        for course in (*self.controls, *self.joint_forces):
            if course.beyond_time is not None:
                value, time = course.peak
                unit = course.signal.unit
                found.append(
                    f"{course.signal.name} needs {abs(value):.4g} {unit} at {time:.4g} s, limit "
                    f"{course.high:.4g} {unit}"
                )
        for course in self.constraint_forces:
            if course.beyond_time is not None:
                found.append(
                    f"{course.signal.name} pulls from {course.beyond_time:.4g} s on, most with "
                    f"{-course.least:.4g} {course.signal.unit} at {course.least_time:.4g} s: a "
                    "real contact would open"
                )
        for course in self.joints:
            if course.beyond_time is not None:
                found.append(
                    f"{course.signal.name} goes from {digits(course.least)} to "
                    f"{digits(course.largest)} {course.signal.unit}, its limits are "
                    f"{course.low:.4g} and {course.high:.4g}, left at {course.beyond_time:.4g} s"
                )
        return tuple(found)

    def __repr__(self) -> str:
        found = count_of(len(self.problems), "problem") if self.problems else "no problem found"
        return f"Preview('{self.analysis.system.name}': {found})"

    def __str__(self) -> str:
        return to_text(self._parts())

    def to_markdown(self) -> str:
        """The same with Markdown tables."""
        return to_markdown(self._parts())

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, lists and texts."""
        return {
            "analysis": self.analysis.to_dict(),
            "duration": self.duration,
            "resolved": self.is_resolved,
            **{
                key: [course.to_dict() for course in getattr(self, key)]
                for key in ("controls", "joint_forces", "constraint_forces", "joints")
            },
            "problems": list(self.problems),
        }

    def _parts(self) -> list[Part]:
        parts = self.analysis.parts()
        for title, courses in (
            ("control needed", self.controls),
            ("joint force", self.joint_forces),
        ):
            if courses:
                rows = [
                    [
                        *_name(course),
                        digits(abs(course.peak[0])),
                        _when(course, course.peak[1]),
                        f"{course.high:.4g}" if np.isfinite(course.high) else "none",
                        "" if course.beyond_time is None else "over its limit",
                    ]
                    for course in courses
                ]
                parts.append(Table([title, "unit", "largest", "at", "limit", ""], rows, left=2))
        if self.constraint_forces:
            rows = [
                [
                    *_name(course),
                    digits(course.least),
                    _when(course, course.least_time),
                    digits(course.largest),
                    _when(course, course.largest_time),
                    "" if course.beyond_time is None else "pulls: a real contact would open",
                ]
                for course in self.constraint_forces
            ]
            head = ["constraint force", "unit", "least", "at", "largest", "at", ""]
            parts.append(Table(head, rows, left=2))
        if self.joints:
            rows = [
                [
                    *_name(course),
                    digits(course.least),
                    digits(course.largest),
                    f"{course.low:.4g} to {course.high:.4g}",
                    "" if course.beyond_time is None else f"leaves at {course.beyond_time:.4g} s",
                ]
                for course in self.joints
            ]
            parts.append(Table(["joint", "unit", "least", "largest", "limits", ""], rows, left=2))
        motion = self.analysis.motion
        if motion is not None and motion.times.size:
            text = f"Started without errors, and examined at {motion.times.size} times."
            if not self.is_resolved:
                text += (
                    " The reference varies too fast for these: what lies between them is not "
                    "known. A shorter duration takes them closer together."
                )
            parts.append([text])
        problems = self.problems
        parts.append([f"PROBLEM  {problem}" for problem in problems] or ["no problem found"])
        return parts


def preview(scenario: Scenario) -> Preview:
    """Analyzes the robot of a scenario, and the motion that its reference commands.

    Args:
        scenario: As loaded.

    Raises:
        ScenarioError: What does not fit, with the key. A violated assumption is no error: the
            analysis tells it.
    """
    try:
        loop, context = build_scenario(scenario)
    except ScenarioError as error:
        cause = error.__cause__
        if isinstance(cause, AssumptionError) and cause.system is not None:
            return Preview(analyze(cause.system), scenario.duration)
        raise
    plant = loop.plant
    if not isinstance(plant, RobotPlant):
        raise ModelError("a scenario describes a robot")
    begin = scenario.integrator.start_time
    times, is_resolved = sample_times(loop.reference.reference, begin, begin + scenario.duration)
    analysis = analyze(
        plant.dae,
        reference=loop.reference.reference,
        times=times,
        start=plant.state(plant.GetMyContextFromRoot(context)),
    )
    return replace(_with_courses(analysis, scenario.duration, plant.model), is_resolved=is_resolved)


def sample_times(
    reference: Callable[[float], FloatArray], begin: float, end: float
) -> tuple[FloatArray, bool]:
    """Times between which a reference is nearly straight.

    Even times alone would see a sinusoid stand still whose period fits between them. Each interval
    is tried at a random place, until a whole round finds nothing new.

    Args:
        reference: t -> R(t).
        begin, end: In s.

    Returns:
        Between SAMPLES and MOST_SAMPLES increasing times in s, and whether these are enough.
    """
    random = np.random.default_rng(0)
    times = np.linspace(begin, end, SAMPLES)
    values = np.array([reference(time) for time in times])
    while True:
        share = random.uniform(0.3, 0.7, times.size - 1)
        tried = times[:-1] + share * np.diff(times)
        found = np.array([reference(time) for time in tried])
        known = np.concatenate([values, found])
        # Beside what is round-off of a constant.
        allowed = _STRAIGHT * np.ptp(known, axis=0) + 1e-9 * np.abs(known).max(axis=0)
        off = np.abs(found - values[:-1] - share[:, None] * np.diff(values, axis=0))
        new = np.flatnonzero(np.any(off > allowed, axis=1))
        room = MOST_SAMPLES - times.size
        is_resolved = new.size <= room
        if not is_resolved:
            new = np.sort(random.choice(new, room, replace=False))
        times = np.insert(times, new + 1, tried[new])
        values = np.insert(values, new + 1, found[new], axis=0)
        if not (new.size and is_resolved):
            return times, is_resolved


def _with_courses(analysis: Analysis, duration: float, model: RobotModel) -> Preview:
    motion, limits, dae = analysis.motion, Limits.of(model), model.dae
    if motion is None or not motion.times.size:
        return Preview(analysis, duration)

    def courses(
        signals: Sequence[Signal], values: FloatArray, low: FloatArray, high: FloatArray
    ) -> tuple[Course, ...]:
        columns = zip(signals, values.T, low, high, strict=True)
        return tuple(_course(s, motion.times, v, float(a), float(b)) for s, v, a, b in columns)

    highest = model.control_limits
    joint_forces: tuple[Course, ...] = ()
    if model.joint_force is not None:
        effort = model.links.effort_limits
        forces = _joint_forces(model, motion.states)
        joint_forces = courses(model.links.actuator_signals, forces, -effort, effort)
    reactions = dae.constraint_input_signals
    least = np.array([-np.inf if limits.can_pull(signal) else 0.0 for signal in reactions])
    joints: tuple[Course, ...] = ()
    if limits.state is not None:
        low, high = limits.state
        bounded = np.isfinite(low) | np.isfinite(high)
        chosen = [s for s, yes in zip(dae.state_signals, bounded, strict=False) if yes]
        values = motion.states[:, : low.size][:, bounded]
        joints = courses(chosen, values, low[bounded], high[bounded])
    return Preview(
        analysis,
        duration,
        controls=courses(dae.control_signals, motion.controls, -highest, highest),
        joint_forces=joint_forces,
        constraint_forces=courses(
            reactions, motion.constraint_inputs, least, np.full(least.size, np.inf)
        ),
        joints=joints,
    )


def _joint_forces(model: RobotModel, states: FloatArray) -> FloatArray:
    """tau at each state, shape (k, nu)."""
    dae = model.dae
    inputs = {"state": dae.state, "parameters": dae.parameter_symbol}
    function = TracedFunction("joint force", inputs, {"tau": ca.densify(model.joint_force)})
    return np.array([function(state, dae.parameter_values)[0] for state in states])


def _course(
    signal: Signal, times: FloatArray, values: FloatArray, low: float, high: float
) -> Course:
    least, largest = int(np.argmin(values)), int(np.argmax(values))
    beyond = (values < low - _SLACK) | (values > high + _SLACK)
    return Course(
        signal,
        float(values[least]),
        float(times[least]),
        float(values[largest]),
        float(times[largest]),
        low,
        high,
        float(times[np.argmax(beyond)]) if beyond.any() else None,
    )


def _when(course: Course, time: float) -> str:
    """Nothing for a constant, whose extremes are round-off."""
    size = max(abs(course.least), abs(course.largest))
    return f"{time:.4g} s" if course.largest - course.least > 1e-9 * size else ""


def _name(course: Course) -> list[str]:
    return [course.signal.name, course.signal.unit or "1"]
