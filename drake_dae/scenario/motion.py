"""The references of a scenario, and the motion along them: what they demand of the robot."""

from collections.abc import Callable, Sequence

import numpy as np

from drake_dae.analysis.limits import robot_limits
from drake_dae.arrays import FloatArray
from drake_dae.dae import DaeSystem, PinnedMotion, Structure, ZeroDynamics
from drake_dae.errors import DrakeDaeError, ScenarioError
from drake_dae.references import ConstantReference, Reference
from drake_dae.references.by_name import assign, in_order
from drake_dae.references.reference import stack_references
from drake_dae.robots import RobotModel, links_behind
from drake_dae.scenario.form import at
from drake_dae.scenario.scenario import Scenario
from drake_dae.scenario.start import start_state

_TIMES = 201
"""The number of times at which a completed scenario is examined."""

_NEARLY_SINGULAR = 0.1
"""B(x) is nearly singular where its smallest singular value is this part of the usual one."""

_SLACK = 1e-6
"""The excess over a limit that counts, in its unit."""


def references_of(
    scenario: Scenario, outputs: Sequence[str], degrees: Sequence[int]
) -> list[Reference]:
    """The references in the order of the outputs, each smooth enough for its degree.

    Raises:
        ScenarioError: One does not fit; the message names its key.
    """
    smooth = []
    for name, reference in scenario.references.items():
        with at(f"references.{name}"):
            smooth.append(assign(name, reference, outputs, degrees))
    with at("references"):
        return in_order(smooth, outputs)


def exogenous_references(
    scenario: Scenario, system: DaeSystem, needed: Sequence[int] | None = None
) -> list[Reference]:
    """The references of the exogenous parameters, in the order of the system.

    Args:
        scenario: The scenario.
        system: The system of its plant or of its law.
        needed: The number of derivatives of each entry that are needed; None to check none.

    Raises:
        ScenarioError: There are too few or too many, or one is not smooth enough.
    """
    moving: list[Reference] = []
    degrees = list(needed or ())
    for parameter in system.exogenous.moving:
        key = f"exogenous.{parameter.name}"
        entries = scenario.exogenous[parameter.name]
        references = [e if isinstance(e, Reference) else ConstantReference(e) for e in entries]
        size = sum(reference.size for reference in references)
        if size != parameter.value.size:
            text = f"{size} values, but the parameter has {parameter.value.size}"
            raise ScenarioError((key, text))
        for index, reference in enumerate(references if needed is not None else ()):
            with at(f"{key}.{index}"):
                reference.derivatives(degrees[: reference.size])
            del degrees[: reference.size]
        moving += references
    return moving


def reference_and_start(
    scenario: Scenario, model: RobotModel, structure: Structure
) -> tuple[Callable[[float], FloatArray], FloatArray]:
    """R(t) of the law's model, and a state where the motion along it begins."""
    names = [signal.name for signal in model.dae.output_signals]
    degrees = structure.layout.reference_degrees
    stacked = stack_references(references_of(scenario, names, degrees), degrees)

    def reference(time: float) -> FloatArray:
        return stacked(time).copy()

    outputs = reference(scenario.integrator.start_time)[structure.layout.lowest]
    parameters = model.dae.parameter_values
    with at("start"):
        return reference, start_state(scenario, model, outputs, parameters, parameters)


def in_the_way(scenario: Scenario, model: RobotModel, structure: Structure) -> str:
    """What is in the way of a scenario along its references, as a sentence; empty if nothing is.

    It is decided as a run is: by the inverse dynamics of the law's model, and the limits of joints,
    drives, contacts and links in front of surfaces.
    """
    try:
        reference, start = reference_and_start(scenario, model, structure)
        begin, end = scenario.integrator.start_time, scenario.duration
        times = begin + np.linspace(0.0, end, _TIMES)
        exogenous = exogenous_references(scenario, model.dae)
        motion = ZeroDynamics(model.dae, structure=structure).motion(
            reference, times, start, exogenous=exogenous
        )
    except DrakeDaeError as error:
        return str(error)
    if motion.ending is not None:
        return str(motion.ending)
    limits = robot_limits(model, scenario.judgement.friction_cones)
    for one in limits.ranges(motion.times, limits.of_motion(motion)):
        # A start may be on the limit of a joint.
        if one.excess and abs(one.excess.value - one.excess.limit) > _SLACK:
            return f"{one.excess}{_singularity(model, motion)}"
    behind = links_behind(model, motion.times, motion.states, motion.parameters)
    return "; ".join(map(str, behind))


def _singularity(model: RobotModel, motion: PinnedMotion) -> str:
    """A phrase on the time at which B(x) is nearly singular, and the joints that are fast there."""
    margins = motion.control_margins
    row = int(np.argmin(margins))
    if margins[row] > _NEARLY_SINGULAR * np.median(margins):
        return ""
    nq, nv = model.links.q.numel(), model.links.v.numel()
    speeds = np.abs(motion.states[row, nq : nq + nv])
    first, second = np.sort(np.argsort(-speeds, kind="stable")[:2])
    names = [signal.name for signal in model.links.position_signals]
    return (
        f"; the robot is nearly singular at {motion.times[row]:.4g} s, where {names[first]} and "
        f"{names[second]} turn fast and the tool hardly moves, as by a straight wrist"
    )
