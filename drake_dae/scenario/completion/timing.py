"""The references of a scenario as a path in the shortest time: the key `time_optimal`."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drake_dae.dae.references import references_by_name
from drake_dae.dae.structure.structure import Structure
from drake_dae.dae.timing.motion_limits import MotionLimits
from drake_dae.dae.timing.profile import PathTiming, TimeOptimalReference
from drake_dae.errors import ScenarioError
from drake_dae.robots.model import RobotModel
from drake_dae.robots.motion_limits import robot_motion_limits
from drake_dae.scenario.completion.completion import Completed
from drake_dae.scenario.forms.keys import at
from drake_dae.scenario.scenario import Scenario


@dataclass(frozen=True, eq=False)
class TimedScenario:
    """The time-optimal motion of a scenario.

    Attributes:
        reference: Its reference, for all outputs.
        governed: The robot's limits, which are kept during the run; None without governor.
        slowed: The limits at which a governor slows the motion down; None without governor.
    """

    reference: TimeOptimalReference
    governed: MotionLimits | None = None
    slowed: MotionLimits | None = None


LATE = 0.5
"""The time in s by which a run with a governor is longer than the motion."""

OF_CONES = 0.99
"""The fraction of the friction of cones that a motion may use; the rest is left for feedback."""

LEAST_CLOSE = 1e-3
"""The least share of the limit of a speed within which it is close to it."""

MOST_CAUSES = 3
"""The largest number of limits in a note."""


def timed(
    scenario: Scenario, model: RobotModel, structure: Structure
) -> tuple[Completed, TimedScenario | None]:
    """Computes the time-optimal motion of a scenario.

    Args:
        scenario: A completed scenario.
        model: Its robot.
        structure: The structure of the model's system.

    Returns:
        The scenario with the duration of the motion, and the motion. Without the key `time_optimal`
        the scenario unchanged, and None.

    Raises:
        ScenarioError: There is no such motion; the message says why.
    """
    settings = scenario.time_optimal
    if settings is None:
        return Completed(scenario), None
    if scenario.task is not None:
        raise ScenarioError(("time_optimal", "a task plans its own motion: it has no path to time"))
    with at("references"):
        outputs = [signal.name for signal in model.dae.output_signals]
        references = references_by_name(scenario.references, outputs, structure.output_degrees)
    begin = scenario.integrator.start_time
    until = begin + scenario.duration if settings.until is None else settings.until
    with at("time_optimal"):
        contacts: dict[str, Any] = {"forces": settings.forces, "cones": settings.cones}
        limits = robot_motion_limits(
            model,
            efforts=settings.efforts,
            joint_speeds=settings.joint_speeds,
            joint_accelerations=settings.joint_accelerations,
            forces=settings.forces,
            cones=[replace(cone, friction=OF_CONES * cone.friction) for cone in settings.cones],
        )
        profile = PathTiming(structure, limits).profile(
            references,
            until,
            begin=begin,
            largest_rate=settings.largest_rate,
            points=settings.points,
        )
    reference = TimeOptimalReference(profile)
    if settings.until is None:
        duration = profile.duration + (LATE if settings.governor else 0.0)
        scenario = replace(scenario, time_optimal=replace(settings, until=until), duration=duration)
    causes = [f"{name} {share:.0%}" for name, share in profile.shares.items() if share >= 0.005]
    note = (
        f"time-optimal: {profile.duration:.4g} s for the references up to {until:.4g} s; limited "
        f"by {', '.join(causes[:MOST_CAUSES])}" + (", ..." if len(causes) > MOST_CAUSES else "")
    )
    notes = [note]
    pairs = zip(model.dae.control_signals, model.control_limits, strict=True)
    free = [signal.name for signal, limit in pairs if np.isinf(limit)]
    if settings.governor and free:
        notes.append(
            f"{', '.join(free)} has no effort limit: where no motion along the path is within the "
            "limits, the error stays as predicted and they are exceeded"
        )
    if not settings.governor:
        return Completed(scenario, tuple(notes)), TimedScenario(reference)
    # Half of what the profile leaves of the speeds is for errors of the model: a joint whose
    # acceleration is da more than the model's exceeds its limit by da / APPROACH. The motion does
    # not come close to a limit, which is by half of what it leaves of it.
    speeds = (1.0 + settings.joint_speeds) / 2.0
    governed, slowed = (
        replace(
            robot_motion_limits(model, joint_speeds=share, **contacts),
            close=max((1.0 - settings.joint_speeds / share) / 2.0, LEAST_CLOSE),
        )
        for share in (1.0, speeds)
    )
    return Completed(scenario, tuple(notes)), TimedScenario(reference, governed, slowed)
