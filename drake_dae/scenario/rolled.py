"""Loops of a scenario for rollouts, and for pages, where a person moves things while they run."""

import time
from collections.abc import Callable
from dataclasses import replace
from math import ceil, floor
from typing import Any, NamedTuple

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import Context

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.parts import ENCODER_NOISE, encoder_seed
from drake_dae.diagrams.record import Record, RecordAfter
from drake_dae.errors import DrakeDaeError, ModelError, ScenarioError, SimulationError
from drake_dae.pictures.page.controls import PUSH
from drake_dae.references import ConstantReference
from drake_dae.robots import KnownWrench, PointOnSurface
from drake_dae.running.diagnosis import DivergenceWatch
from drake_dae.running.rollout import Rollout, diagnosed, run_loop, start_values
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.robot_file.reading import robot_links
from drake_dae.scenario.scenario import Scenario
from drake_dae.scenario.start import start_scenario

ROWS, MOST_ROWS = 1000, 1e7
"""The number of rows of a record under error control, after the first; and the largest number of
rows of fixed steps, since a larger record takes gigabytes."""

PERIOD, SAME = 0.2, 1e-6
"""The time by the clock in s between checks of a running rollout for divergence; and the fraction
of a step within which two times are equal."""


def for_rollout(scenario: Scenario) -> tuple[Scenario, str]:
    """A scenario with a plant that rollouts support, and a remark if this changed the plant."""
    plant = scenario.plant.rolled
    if plant is scenario.plant:
        return scenario, ""
    # Drake's contact has no viscous friction.
    viscous = [c.name for c in scenario.constraints if getattr(c, "viscous_friction", None)]
    none = {f"{name}.viscous_friction": 0.0 for name in viscous}
    plant = replace(plant, parameters={**plant.parameters, **none})
    return replace(scenario, plant=plant), (
        f"a !{type(plant).__name__} runs in place of !{type(scenario.plant).__name__}: "
        "the same equations of contact, traced. Drake's solver stops at a relative residual of "
        "1e-6, and joints stop at their limits in Drake's plant alone"
    )


def rollout_times(scenario: Scenario, time_step: float = 0.0) -> FloatArray:
    """The times of the rows of a rollout's record, in s: equidistant, or those of fixed steps."""
    config, duration = scenario.integrator, scenario.duration
    start, end = config.start_time, config.start_time + duration
    fixed = time_step or (0.0 if config.use_error_control else config.max_step_size)
    if fixed and duration / fixed > MOST_ROWS:
        raise ModelError(
            f"steps of {fixed:g} s make {duration / fixed:.2g} rows for {duration:g} s; a rollout "
            f"keeps at most {MOST_ROWS:g}"
        )
    if time_step:
        first, after = floor(start / time_step + SAME) + 1, ceil(end / time_step - SAME)
        return np.concatenate([[start], time_step * np.arange(first, after), [end]])
    rows = max(1, ceil(duration / fixed - 0.01)) if fixed else ROWS
    times: FloatArray = start + np.linspace(0.0, duration, rows + 1)
    return times


def roll_scenario(
    scenario: Scenario,
    loop: ClosedLoop,
    context: Context,
    lasting: float | None = None,
    look: Callable[[RecordAfter], bool] = lambda record: False,
) -> Rollout:
    """Runs a scenario by `rollout`; a diverging run ends, as by `simulate`."""
    start, parameters = start_values(loop, context)
    sensors, seeds = scenario.sensors, dict[str, int]()
    if sensors.force is not None:
        seeds["force_noise"] = sensors.force.seed
    if sensors.encoders is not None:
        seeds[ENCODER_NOISE] = encoder_seed(sensors.encoders.seed)
    watch, due = DivergenceWatch(loop.plant, scenario.duration), time.perf_counter() + PERIOD
    seen: float | None = None
    failure: SimulationError | None = None

    def diverges(rows: Record, is_last: bool = False) -> bool:
        nonlocal seen, due, failure
        due = time.perf_counter() + PERIOD
        if not scenario.judgement.may_diverge and failure is None and rows.time.size:
            seen = float(rows.time[-1])
            try:
                watch.look(rows, is_last=is_last)
            except SimulationError as error:
                failure = error
        return failure is not None

    def watched(record: RecordAfter) -> bool:
        return (time.perf_counter() > due and diverges(record(seen))) or look(record)

    (rollout,) = run_loop(
        loop,
        start,
        parameters,
        rollout_times(scenario, loop.plant.time_step),
        config=scenario.integrator,
        seeds=[seeds],
        lasting=lasting,
        look=watched,
    )
    if diverges(rollout.record.after(seen), is_last=rollout.failure is None):
        assert failure is not None
        rollout = rollout.ended(failure)
    return diagnosed(loop, rollout, scenario.integrator)


class Commanded(NamedTuple):
    """A loop that a person can change while it runs, its start, and why some changes are none."""

    loop: ClosedLoop
    context: Context
    left_out: tuple[str, ...]


@checked(lambda text: ScenarioError(("", text)))
def build_commanded(scenario: Scenario) -> Commanded:
    """Builds a loop with `CommandedReferences`, surfaces that can be moved, and wrenches on links.

    Without commands the loop behaves as in the scenario: surfaces are fixed, and wrenches and
    additional friction are zero. Signals for which a task waits are inputs of the diagram.
    """
    scenario, remark = for_rollout(scenario)
    if scenario.plant.carries:
        text = "Drake's hydroelastic contact cannot be traced: take a !CompliantContact instead"
        raise ScenarioError(("plant", text))
    told = [f"Drake's plant: {remark}"] if remark else []
    extended, left_out = scenario, [*told]
    for name, add in _CHANGES.items():
        try:
            extended = add(extended)
        except ModelError as error:
            left_out.append(f"{name}: none, since {error}")
    try:
        completed, loop = build_completed(extended, commanded=True)
    except DrakeDaeError as error:
        completed, loop = build_completed(scenario, commanded=True)  # Its own errors come first.
        left_out = [*told, *(f"{name}: {error}" for name in _CHANGES)]
    # The original exogenous signals decide whether the loop starts at rest.
    initial = replace(completed.scenario, exogenous=scenario.exogenous)
    return Commanded(loop, start_scenario(initial, loop), tuple(left_out))


def _with_friction(scenario: Scenario) -> Scenario:
    """Adds a coefficient of friction of 0 to frictionless contacts of ideal plants."""
    points = [c for c in scenario.constraints if isinstance(c, PointOnSurface)]
    bare = [point for point in points if point.friction is None]
    if not bare or scenario.plant.material is not None:  # Which has the friction of contacts.
        return scenario
    if scenario.actuation:
        raise ModelError("the law would differentiate it; give the constraint a friction")
    rough = [replace(c, friction=0.0) if c in bare else c for c in scenario.constraints]
    return replace(scenario, constraints=rough)


def _with_moving_surfaces(scenario: Scenario) -> Scenario:
    """Makes the positions of surfaces constant exogenous signals."""
    if scenario.plant.material is not None:
        return scenario  # Of a compliant contact they are parameters of the plant alone.
    if scenario.estimator is not None:
        raise ModelError(
            "an estimator does not know how a surface moves, and an ideal contact needs a law that "
            "does; with `plant: !CompliantContact` they are dragged"
        )
    points = [c for c in scenario.constraints if isinstance(c, PointOnSurface)]
    places = [c.parameters[0] for c in points if c.parameters[0].name not in scenario.exogenous]
    still: dict[str, Any] = {p.name: [*map(ConstantReference, p.value.tolist())] for p in places}
    return replace(scenario, exogenous={**scenario.exogenous, **still})


def _with_pushes(scenario: Scenario) -> Scenario:
    """Adds a zero wrench to each movable link."""
    robot, pushes = scenario.robot, []
    plant = robot_links(robot, SceneGraph(), drawn=False)[0].plant
    for body in (plant.get_body(BodyIndex(i)) for i in range(1, plant.num_bodies())):
        if plant.GetVisualGeometriesForBody(body) and not plant.IsAnchored(body):
            name = body.scoped_name().get_full()
            pushes.append(KnownWrench(name, name=PUSH + name))
    return replace(scenario, robot=replace(robot, known_forces=[*robot.known_forces, *pushes]))


_CHANGES: dict[str, Callable[[Scenario], Scenario]] = {
    "friction of the plant": _with_friction,
    "surfaces that are dragged": _with_moving_surfaces,
    "links that are pushed": _with_pushes,
}
"""What a person may change beside references, and what it adds to a scenario."""
