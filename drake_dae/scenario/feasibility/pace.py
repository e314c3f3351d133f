"""The pace of each phase of a task at which the robot's limits hold: the key `within_limits`."""

from dataclasses import dataclass, replace
from math import ceil
from operator import itemgetter

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.structure.structure import Structure
from drake_dae.dae.system.layout import Indices
from drake_dae.errors import ScenarioError
from drake_dae.robots.model import RobotModel
from drake_dae.scenario.completion.completion import Completed
from drake_dae.scenario.feasibility.task import TaskNeeds, phase_rows, task_needs
from drake_dae.scenario.parts.task import WithinLimits
from drake_dae.scenario.scenario import Scenario
from drake_dae.simulation.summary import Limits

MOST_RUNS = 12
"""The largest number of runs of the law's model."""

SLOWEST = 0.05
"""The pace below which a phase counts as one that exceeds a limit at rest."""

ROOM = 0.98
"""Each pace is this fraction of the estimated one, so that few runs are needed."""


def paced(scenario: Scenario, model: RobotModel, structure: Structure) -> Completed:
    """Slows down the phases of a task until the law's model keeps the limits of the robot.

    The torque of a rigid robot is a part at rest and a part with the square of the pace, so that
    the largest share of a limit is about s + d pace^2. The first estimate takes s = 0, each further
    one the line through the last two runs. Joint speeds are proportional to the pace.

    Args:
        scenario: A completed scenario with gains, from `advised`.
        model: Its robot.
        structure: The structure of the model's system.

    Returns:
        The scenario with the paces and a duration that is longer by what they add, and a note for
        each phase that is slowed down; without the key the scenario unchanged.

    Raises:
        ScenarioError: The robot has no limits, or a phase exceeds one also at rest.
    """
    task = scenario.task
    if task is None or task.within_limits is None:
        return Completed(scenario)
    limits, given = task.within_limits, dict(task.pace)
    pace, before, later = dict(given), dict[str, tuple[float, float]](), 0.0
    for _ in range(MOST_RUNS):
        chosen = replace(
            scenario,
            task=replace(task, pace=pace, within_limits=None),
            duration=scenario.duration + ceil(later),
        )
        needs = task_needs(chosen, model, structure)
        worst = _worst(needs, limits, model)
        if not worst:
            notes = [
                f"task.pace: {name} at {value:.3g} of its speed, so that limits hold"
                for name, value in pace.items()
                if value != given.get(name, 1.0)
            ]
            if later:
                notes.append(f"duration: {chosen.duration:g} s, since the task takes longer")
            return Completed(chosen, tuple(notes))
        for name, shares in worst.items():
            now = pace.get(name, 1.0)
            pace[name] = _slower(shares, now, before.get(name), limits)
            before[name] = now, shares.effort
            if pace[name] < SLOWEST:
                raise _exceeded(name, shares, limits)
            lasts = sum(each.end - each.begin for each in needs.phases if each.name == name)
            later += lasts * (now / pace[name] - 1.0)
    raise _exceeded(*next(iter(worst.items())), limits)


@dataclass(frozen=True)
class _Shares:
    """The largest shares of limits in a phase: of a drive's effort, and of a joint's velocity."""

    drive: str
    effort: float
    speed: float

    def exceed(self, limits: WithinLimits) -> bool:
        """Whether a share is larger than it may be."""
        return self.effort > limits.efforts or self.speed > limits.joint_speeds


def _worst(needs: TaskNeeds, limits: WithinLimits, model: RobotModel) -> dict[str, _Shares]:
    """Name -> the shares of each phase that exceeds a limit, the largest over all its entries.

    Raises:
        ScenarioError: The robot has no limits.
    """
    joints, worst = Limits.of(model).state, dict[str, _Shares]()
    if joints is None and not any(phase.drive for phase in needs.phases):
        text = "the robot's file has neither effort nor velocity limits; leave it out"
        raise ScenarioError(("task.within_limits", text))
    for phase in needs.phases:
        rows = phase_rows(needs.record, phase.begin, phase.end)
        same = worst.get(phase.name, _Shares("", 0.0, 0.0))
        drive, effort = max(
            (same.drive, same.effort), (phase.drive, phase.share), key=itemgetter(1)
        )
        worst[phase.name] = _Shares(drive, effort, max(same.speed, _speed(needs, rows, joints)))
    return {name: shares for name, shares in worst.items() if shares.exceed(limits)}


def _speed(needs: TaskNeeds, rows: Indices, joints: tuple[FloatArray, FloatArray] | None) -> float:
    """The largest speed of a joint as a share of its limit; 0 without limits."""
    if joints is None:
        return 0.0
    signals = needs.record.signals["state"].signals[: joints[0].size]
    speeds = [i for i, signal in enumerate(signals) if signal.unit.endswith("/s")]
    values = needs.states[rows][:, speeds]
    shares = np.maximum(values / joints[1][speeds], values / joints[0][speeds])
    return float(np.max(shares, initial=0.0))


def _slower(
    shares: _Shares, pace: float, before: tuple[float, float] | None, limits: WithinLimits
) -> float:
    """The next pace of a phase, from its shares at this pace and the effort at the one before."""
    slower = pace * min(limits.joint_speeds / shares.speed, 1.0) if shares.speed else pace
    if shares.effort > limits.efforts:
        square = pace**2 * limits.efforts / shares.effort
        if before is not None and before[1] > shares.effort:
            slope = (before[1] - shares.effort) / (before[0] ** 2 - pace**2)
            square = min(square, max(pace**2 - (shares.effort - limits.efforts) / slope, 0.0))
        slower = min(slower, square**0.5)
    return ROOM * slower


def _exceeded(name: str, shares: _Shares, limits: WithinLimits) -> ScenarioError:
    what = f"{shares.effort:.0%} of the effort limit of {shares.drive}"
    if shares.effort <= limits.efforts:
        what = f"{shares.speed:.0%} of the velocity limit of a joint"
    text = f"{name} needs {what}, however slowly it moves; change its posture or its force"
    return ScenarioError(("task.within_limits", text))
