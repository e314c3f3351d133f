"""One run: any law on any plant, by one wiring, and its figures."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Diagram, DiagramBuilder, System, TriggerType
from pydrake.systems.primitives import LogVectorOutput, RandomSource, VectorLogSink

from contact_peers.plants import (
    DURATION,
    PERIOD,
    SETTLED,
    Condition,
    MeasuredPlant,
    task,
    vary,
)
from contact_peers.robot import Goals, Robot
from drake_dae.arrays import FloatArray
from drake_dae.dae.structure.structure import Structure
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import DrakeDaeError
from drake_dae.robots.model import RobotModel
from drake_dae.scenario.advice.advice import advised
from drake_dae.scenario.loop import build_loop, make_plant
from drake_dae.scenario.model import scenario_model, scenario_structure
from drake_dae.scenario.scenario import Scenario
from drake_dae.scenario.start import start_scenario
from drake_dae.simulation.simulate import simulate
from drake_dae.systems.control.references import ReferenceGenerator
from drake_dae.systems.control.sampling import ControlHold
from drake_dae.systems.sensing.force_sensor import ForceSensor

STEPS = SimulatorConfig(
    integration_scheme="explicit_euler", max_step_size=PERIOD, use_error_control=False
)
"""Nothing in these diagrams is continuous but an integral of Drake's controller without a gain."""


@dataclass(frozen=True)
class Figures:
    """What a run comes to, after it has settled.

    Attributes:
        position: The rms distance from the goal along the wall, in mm.
        force: The rms error of the normal force, in N.
        roughness: The rms difference between the torques of one sample and the next, in N m.
        open: The share of the time in which nothing touches.
    """

    position: float
    force: float
    roughness: float
    open: float

    @property
    def is_lost(self) -> bool:
        """Whether the run failed, or was out of contact for a tenth of the time."""
        return not (np.isfinite(self.force) and self.open < 0.1)


FAILED = Figures(np.inf, np.inf, np.inf, 1.0)


def figures(
    time: FloatArray,
    output: FloatArray,
    goal: FloatArray,
    u: FloatArray,
    settled: float = SETTLED,
) -> Figures:
    """The figures of outputs z and their goals, shape (k, 7), and controls, likewise."""
    late = time > settled
    if not (np.isfinite(output).all() and late.any()):
        return FAILED
    error, force = (output - goal)[late], output[late, -1]
    return Figures(
        1e3 * _rms(np.linalg.norm(error[:, :2], axis=1)),
        _rms(error[:, -1]),
        _rms(np.diff(u[late], axis=0)),
        float(np.mean(force <= 0.0)),
    )


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


@dataclass(frozen=True, eq=False)
class Setup:
    """What all runs of a condition share whose law believes in the same."""

    scenario: Scenario
    model: RobotModel
    structure: Structure

    @classmethod
    @cache
    def of(cls, condition: Condition, friction: float, settings: tuple[str, ...] = ()) -> "Setup":
        scenario = task(condition, friction, *settings)
        model = scenario_model(scenario)
        structure = scenario_structure(model)
        return cls(advised(scenario, model, structure).scenario, model, structure)

    def plant(self, condition: Condition) -> MeasuredPlant:
        plant = make_plant(self.scenario, self.model, self.structure)
        return MeasuredPlant(plant, condition.noise)


def run_ours(condition: Condition, friction: float, settings: tuple[str, ...] = ()) -> Figures:
    """Our law, as its scenario wires it; the settings are those of `--set`."""
    setup = Setup.of(condition, friction, settings)
    plant = setup.plant(condition)
    loop = build_loop(setup.scenario, setup.model, setup.structure, plant=plant)
    context = start_scenario(setup.scenario, loop)
    vary(condition, plant, context)
    try:
        simulate(loop.diagram, context, DURATION, setup.scenario.integrator)
    except (DrakeDaeError, RuntimeError):
        return FAILED
    found = loop.record(context)
    return figures(
        found.time, found["controlled_output"], found["desired_output"], found["control"]
    )


@dataclass(frozen=True, eq=False)
class Beginning:
    """Where a task begins, and how it goes on: the same for our law and all others."""

    state: FloatArray
    reference: ReferenceGenerator
    outputs: list[int]

    @classmethod
    @cache
    def of(cls, condition: Condition) -> "Beginning":
        setup = Setup.of(condition, 0.0)
        loop: ClosedLoop = build_loop(
            setup.scenario, setup.model, setup.structure, plant=setup.plant(condition)
        )
        context = start_scenario(setup.scenario, loop)
        state = loop.plant.state(loop.plant.GetMyContextFromRoot(context))
        return cls(state, loop.reference, list(loop.controller.law.layout.lowest))


@cache
def beliefs(friction: float) -> tuple[Robot, Goals, FloatArray]:
    """What the other laws know: the robot, the task on the wall, and where it begins."""
    setup = Setup.of(Condition(""), 0.0)
    plant = setup.model.links.plant
    assert plant is not None  # It was read from a file.
    robot, state = Robot(plant), Beginning.of(Condition("")).state
    return robot, Goals(robot, state[:7], friction), state


def run_law(
    condition: Condition,
    law: type,
    gains: Mapping[str, float],
    friction: float,
    duration: float = DURATION,
    settled: float = SETTLED,
) -> Figures:
    """Another law, wired as ours is: sensor, sampling and delay are those of the scenario."""
    setup, begin = Setup.of(condition, 0.0), Beginning.of(condition)
    plant, reference = setup.plant(condition), begin.reference
    robot, goals, start = beliefs(friction)
    diagram, logs = wire(
        plant,
        law(robot, goals, gains, start),
        ReferenceGenerator(reference.references, reference.degrees),
        ControlHold(7, setup.scenario.sampling),
        setup.scenario.force_feedback.sensor(1),
    )
    context = diagram.CreateDefaultContext()
    plant.set_consistent_state(plant.GetMyMutableContextFromRoot(context), begin.state)
    vary(condition, plant, context)
    try:
        simulate(diagram, context, duration, STEPS)
    except (DrakeDaeError, RuntimeError):
        return FAILED
    found = {name: log.FindLog(context) for name, log in logs.items()}
    time = found["control"].sample_times()
    goal = reference.along(time)[:, begin.outputs]
    output, control = (found[name].data().T for name in ("controlled_output", "control"))
    return figures(time, output, goal, control, settled)


def wire(
    plant: MeasuredPlant,
    law: System,
    reference: ReferenceGenerator,
    hold: ControlHold,
    sensor: ForceSensor,
) -> tuple[Diagram, dict[str, VectorLogSink]]:
    """The loop of a law: it reads state, reference and force of one instant, and acts late."""
    builder = DiagramBuilder()
    for system in (plant, law, reference, hold, sensor):
        builder.AddSystem(system)
    builder.Connect(plant.GetOutputPort("state"), law.GetInputPort("estimated_state"))
    builder.Connect(reference.GetOutputPort("reference"), law.GetInputPort("reference"))
    builder.Connect(plant.GetOutputPort("constraint_force"), sensor.GetInputPort("force"))
    if sensor.HasInputPort("noise"):
        noise = builder.AddSystem(RandomSource(RandomDistribution.kGaussian, 1, PERIOD))
        builder.Connect(noise.get_output_port(), sensor.GetInputPort("noise"))
    if law.HasInputPort("measured_force"):
        builder.Connect(sensor.GetOutputPort("measured_force"), law.GetInputPort("measured_force"))
    builder.Connect(law.GetOutputPort("control"), hold.get_input_port())
    builder.Connect(hold.get_output_port(), plant.GetInputPort("control"))
    logs = {
        name: LogVectorOutput(port, builder, {TriggerType.kPeriodic}, PERIOD)
        for name, port in (
            ("controlled_output", plant.GetOutputPort("controlled_output")),
            ("control", hold.get_output_port()),
        )
    }
    return builder.Build(), logs
