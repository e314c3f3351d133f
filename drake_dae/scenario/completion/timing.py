"""The references of a scenario as a path in the shortest time: the key `time_optimal`."""

from collections.abc import Sequence
from dataclasses import replace

from drake_dae.dae.references import Reference, references_by_name
from drake_dae.dae.structure.structure import Structure
from drake_dae.dae.timing.profile import PathTiming, TimeOptimalReference
from drake_dae.errors import ScenarioError
from drake_dae.robots.model import RobotModel
from drake_dae.robots.motion_limits import robot_motion_limits
from drake_dae.scenario.completion.completion import Completed
from drake_dae.scenario.forms.keys import at
from drake_dae.scenario.scenario import Scenario

MOST_CAUSES = 3
"""The number of limits that a note names."""


def timed(
    scenario: Scenario, model: RobotModel, structure: Structure
) -> tuple[Completed, Sequence[Reference] | None]:
    """A scenario with the duration of its time-optimal motion, and the references of this.

    Args:
        scenario: A completed scenario.
        model: Its robot.
        structure: The structure of the model's system.

    Returns:
        The scenario as it is, and None, without the key `time_optimal`.

    Raises:
        ScenarioError: There is no such motion; the message says why.
    """
    wanted = scenario.time_optimal
    if wanted is None:
        return Completed(scenario), None
    if scenario.task is not None:
        raise ScenarioError(("time_optimal", "a task plans its own motion: it has no path to time"))
    with at("references"):
        outputs = [signal.name for signal in model.dae.output_signals]
        references = references_by_name(scenario.references, outputs, structure.output_degrees)
    begin = scenario.integrator.start_time
    until = begin + scenario.duration if wanted.until is None else wanted.until
    with at("time_optimal"):
        limits = robot_motion_limits(
            model,
            efforts=wanted.efforts,
            joint_speeds=wanted.joint_speeds,
            joint_accelerations=wanted.joint_accelerations,
            forces=wanted.forces,
            cones=wanted.cones,
        )
        profile = PathTiming(structure, limits).profile(
            references,
            until,
            begin=begin,
            largest_rate=wanted.largest_rate,
            points=wanted.points,
        )
    reference = TimeOptimalReference(profile)
    if wanted.until is None:
        own = replace(wanted, until=until)
        scenario = replace(scenario, time_optimal=own, duration=profile.duration)
    causes = [f"{name} {share:.0%}" for name, share in profile.shares.items() if share >= 0.005]
    note = (
        f"time-optimal: {profile.duration:.4g} s for the references up to {until:.4g} s; limited "
        f"by {', '.join(causes[:MOST_CAUSES])}" + (", ..." if len(causes) > MOST_CAUSES else "")
    )
    return Completed(scenario, (note,)), [reference]
