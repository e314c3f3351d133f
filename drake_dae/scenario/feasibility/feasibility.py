"""Feasibility of a scenario, before it is simulated."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np
from pydrake.geometry import SceneGraph

from drake_dae.analysis.analyze import along, analyze, examine
from drake_dae.analysis.limits import limits_along
from drake_dae.arrays import FloatArray
from drake_dae.dae.structure.structure import Structure
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.system.system import DaeSystem
from drake_dae.dae.zero_dynamics.pinned_motion import PinnedMotion
from drake_dae.errors import AssumptionError, ScenarioError
from drake_dae.references.reference import common_period
from drake_dae.robots.links_behind import links_behind
from drake_dae.robots.model import RobotModel
from drake_dae.scenario.advice.advice import advised
from drake_dae.scenario.advice.sticking import sticking_note
from drake_dae.scenario.controllers.task_controller import check_task
from drake_dae.scenario.feasibility.limits import robot_limits
from drake_dae.scenario.feasibility.report import Feasibility, SignalRange
from drake_dae.scenario.forms.keys import at
from drake_dae.scenario.loop import build_loop, exogenous_references
from drake_dae.scenario.model import completed_model, examine_scenario, scenario_structure
from drake_dae.scenario.plants import IdealConstraints
from drake_dae.scenario.robot_file.links import RobotLinks
from drake_dae.scenario.scenario import Scenario
from drake_dae.scenario.start import start_scenario
from drake_dae.simulation.summary import Limits
from drake_dae.trace.functions import TracedFunction

SAMPLES = 1001
"""The smallest number of examined times along a reference."""

MOST_SAMPLES = 20_000
"""The largest number of examined times along a reference that varies fast."""

_STRAIGHT = 0.01
"""The allowed deviation of a reference from linear interpolation between two times, relative to its
range."""

_SHORTEST = 1e-6
"""The shortest interval that is divided, relative to the whole."""

_SLACK = 1e-9
"""The excess over a limit that counts, in its unit: a start may be on the limit."""

_Range = tuple[SignalRange, ...]
_Ranges = tuple[_Range, _Range, _Range, _Range]


def find_feasibility(scenario: Scenario) -> Feasibility:
    """Analyzes the robot of a scenario, and what its reference requires of drives and joints.

    All numbers are those of the law's model without errors: the minimum requirements.

    Args:
        scenario: A scenario, as `load_scenario` returns it.

    Raises:
        ScenarioError: The scenario is not valid; the message names the key. A violated assumption
            is no error: the analysis reports it.
    """
    return complete_and_examine(scenario, SceneGraph())[1]


def complete_and_examine(
    scenario: Scenario, scene_graph: SceneGraph, robot: RobotLinks | None = None
) -> tuple[Scenario, Feasibility]:
    """Returns a scenario with what `complete_scenario` adds, and what `find_feasibility` finds.

    Args:
        scenario: The scenario.
        scene_graph: The scene graph of the robot's geometry.
        robot: What `robot_links` made of the robot with this scene graph; None to read it.

    Raises:
        ScenarioError: As for `find_feasibility`.
    """
    if scenario.task is not None:
        check_task(scenario)
    completed, model = completed_model(scenario, scene_graph, drawn=False, robot=robot)
    return completed.scenario, _feasibility(completed.scenario, model)


def _feasibility(scenario: Scenario, model: RobotModel) -> Feasibility:
    """The feasibility of a completed scenario with its model."""
    examined = None
    try:
        if scenario.task is None:
            examined = examine_scenario(model)
        if examined is None or examined.structure is None or examined.problems:
            structure = scenario_structure(model)
        else:
            structure = examined.structure
    except AssumptionError:
        return Feasibility(analyze(model.dae), scenario.duration)
    gains = _without_gains(scenario, model, structure)
    if scenario.task is not None:
        return Feasibility(analyze(model.dae), scenario.duration, gains=gains)
    # The law's model, without differences of the plant.
    ideal = replace(
        scenario,
        plant=IdealConstraints(parameters=scenario.plant.parameters),
        sensors=replace(scenario.sensors, encoders=None),
        estimator=None,
    )
    loop = build_loop(ideal, model, structure)
    context = start_scenario(ideal, loop)
    reference, begin = loop.reference.reference, scenario.integrator.start_time

    def signals(time: float) -> FloatArray:
        moving = [] if loop.exogenous is None else [loop.exogenous.reference(time)]
        return np.concatenate([reference(time), *moving])

    times, is_resolved = sample_times(signals, begin, begin + scenario.duration)
    start = loop.plant.state(loop.plant.GetMyContextFromRoot(context))
    exogenous = exogenous_references(
        scenario, loop.plant.dae, loop.controller.law.exogenous_degrees
    )
    period = common_period([r.repeats for r in (*loop.reference.references, *exogenous)])
    analysis = along(
        examined or examine(model.dae), reference, times, start, period or None, exogenous
    )
    motion, slowing = analysis.motion, None
    if motion is not None and analysis.structure is not None:
        with at("judgement.friction_cones"):
            limits = robot_limits(model, scenario.judgement.friction_cones)
        slowing = limits_along(analysis.structure, limits, reference, motion)
    return Feasibility(
        analysis,
        scenario.duration,
        *(((), (), (), ()) if motion is None else _ranges(motion, model)),
        is_resolved=is_resolved,
        behind=(
            ()
            if motion is None
            else links_behind(model, motion.times, motion.states, motion.parameters)
        ),
        sticking=(
            ""
            if motion is None
            else sticking_note(scenario, model, motion.states, motion.constraint_inputs)
        ),
        gains=gains,
        slowing=slowing,
    )


def _without_gains(scenario: Scenario, model: RobotModel, structure: Structure) -> str:
    """Why no gains can be computed where they are left out, else empty."""
    try:
        advised(scenario, model, structure)
    except ScenarioError as error:
        return str(error)
    return ""


def sample_times(
    reference: Callable[[float], FloatArray], begin: float, end: float
) -> tuple[FloatArray, bool]:
    """Sample times between which a reference is nearly linear.

    Equidistant times would miss a sinusoid whose period is the interval. Each interval is tested at
    a random time and divided if the reference is not linear there, until no interval is divided.

    Args:
        reference: The function t -> R(t).
        begin, end: The first and the last time, in s.

    Returns:
        From SAMPLES to MOST_SAMPLES increasing times in s, and whether these suffice.
    """
    random = np.random.default_rng(0)
    times = np.linspace(begin, end, SAMPLES)
    values = np.array([reference(time) for time in times])
    while True:
        share = random.uniform(0.3, 0.7, times.size - 1)
        tried = times[:-1] + share * np.diff(times)
        new_values = np.array([reference(time) for time in tried])
        all_values = np.concatenate([values, new_values])
        # A constant varies by round-off.
        allowed = _STRAIGHT * np.ptp(all_values, axis=0) + 1e-9 * np.abs(all_values).max(axis=0)
        off = np.abs(new_values - values[:-1] - share[:, None] * np.diff(values, axis=0))
        # At a jump of the derivative no division suffices.
        is_long = np.diff(times) > _SHORTEST * (end - begin)
        new = np.flatnonzero(np.any(off > allowed, axis=1) & is_long)
        room = MOST_SAMPLES - times.size
        is_resolved = new.size <= room
        if not is_resolved:
            new = np.sort(random.choice(new, room, replace=False))
        times = np.insert(times, new + 1, tried[new])
        values = np.insert(values, new + 1, new_values[new], axis=0)
        if not (new.size and is_resolved):
            return times, is_resolved


def _ranges(motion: PinnedMotion, model: RobotModel) -> _Ranges:
    """The controls, joint forces, constraint forces and joints of a `Feasibility`."""
    dae, limits = model.dae, Limits.of(model)
    if not motion.times.size:
        return (), (), (), ()

    def ranges(
        signals: Sequence[Signal], values: FloatArray, low: FloatArray, high: FloatArray
    ) -> tuple[SignalRange, ...]:
        columns = zip(signals, values.T, low, high, strict=False)
        return tuple(_range(s, motion.times, v, float(a), float(b)) for s, v, a, b in columns)

    highest, reactions = model.control_limits, dae.force_signals
    least = np.array([-np.inf if limits.can_pull(signal) else 0.0 for signal in reactions])
    unlimited = np.full(least.size, np.inf)
    controls = ranges(dae.control_signals, motion.controls, -highest, highest)
    constraint_forces = ranges(reactions, _forces(dae, motion), least, unlimited)
    joint_forces: tuple[SignalRange, ...] = ()
    if model.joint_force is not None:
        effort = model.links.effort_limits
        forces = _along(model, model.joint_force, motion.states)
        joint_forces = ranges(model.links.actuator_signals, forces, -effort, effort)
    joints: tuple[SignalRange, ...] = ()
    if limits.state is not None:
        joints += ranges(dae.state_signals, motion.states, *limits.state)
    if limits.loops is not None:
        loops = model.loop_joints
        states = _along(model, loops.state, motion.states)
        joints += ranges(loops.signals, states, *limits.loops)
    limited = tuple(r for r in joints if np.isfinite(r.low) or np.isfinite(r.high))
    return controls, joint_forces, constraint_forces, limited


def _forces(dae: DaeSystem, motion: PinnedMotion) -> FloatArray:
    """All constraint forces at each state, shape (k, M), as `constraint_force` of a plant."""
    if dae.sharing is None:
        return motion.constraint_inputs
    v = ca.SX.sym("v", dae.num_constraints)
    function = dae.trace("shared forces", {"forces": dae.forces(v)}, {"v": v})
    pairs = zip(motion.states, motion.constraint_inputs, strict=True)
    return np.array([function(x, v_at, dae.parameter_values)[0] for x, v_at in pairs])


def _along(model: RobotModel, expression: ca.SX, states: FloatArray) -> FloatArray:
    """The values of an expression of the state at each state, shape (k, size)."""
    dae = model.dae
    inputs = {"state": dae.state, "parameters": dae.parameter_symbol}
    function = TracedFunction("along the motion", inputs, {"value": ca.densify(expression)})
    return np.array([function(state, dae.parameter_values)[0] for state in states])


def _range(
    signal: Signal, times: FloatArray, values: FloatArray, low: float, high: float
) -> SignalRange:
    """The range of a signal within its limits, with times."""
    # The first of those that differ by round-off.
    near = 1e-9 * np.max(np.abs(values))
    least = int(np.argmax(values <= values.min() + near))
    largest = int(np.argmax(values >= values.max() - near))
    beyond = (values < low - _SLACK) | (values > high + _SLACK)
    return SignalRange(
        signal,
        least=float(values[least]),
        least_time=float(times[least]),
        largest=float(values[largest]),
        largest_time=float(times[largest]),
        low=low,
        high=high,
        beyond_time=float(times[np.argmax(beyond)]) if beyond.any() else None,
    )
