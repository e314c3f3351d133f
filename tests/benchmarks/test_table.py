"""The figures that a user asks for first, each beside its counterpart in one run.

Counterparts are the same interpreted, the same in Drake with blocks that do nothing, and bare
imports. What is compared computes the same, which is checked first. Peers stand in `test_peers`.
"""

import resource
import subprocess
import sys
import time

import numpy as np
import pytest
from empty import empty_loop, stepping
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, RevoluteJoint, SpatialInertia, UnitInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial
from runs import scenario
from timing import calls, has_compiler, race, times
from two_arms import two_arms

from drake_dae import (
    DcMotors,
    FlexibleJoints,
    JointPositions,
    Plane,
    PointOnSurface,
    RobotModel,
    RobotPlant,
    TrackingLaw,
    build_scenario,
    compile_diagram,
    poles,
    rollout,
    simulate,
    sweep,
)
from drake_dae.blocks.traced_system import TracedSystem
from drake_dae.running import start_values
from drake_dae.scenario.build import make_plant
from drake_dae.scenario.model import completed_model, scenario_structure
from drake_dae.studies import make_variations

SPRINGS = FlexibleJoints(8000.0, inertia=1.0)
MOTORS = DcMotors(torque_constant=0.5, inductance=1e-2, resistance=1.0, gear_ratio=100.0)
FIXED = [
    "integrator.integration_scheme=runge_kutta3",
    "integrator.use_error_control=false",
    "integrator.max_step_size=1e-3",
]
CONTACT = 2.0
"""The simulated time of a run on contact in s, and half of that of a longer one."""

CHOICES = {"interpreted": "false", "machine code": "true"}


def choices() -> dict[str, str]:
    """How functions run, and the choice of a scenario that makes them so."""
    return {name: text for name, text in CHOICES.items() if text == "false" or has_compiler()}


def loops(name: str, *settings: str):
    """A scenario for each choice: how it runs, the scenario, its loop, and its start."""
    for how, compiled in choices().items():
        chosen = scenario(name, *settings, f"compiled={compiled}")
        yield how, chosen, *build_scenario(chosen)


LAWS = {
    "7 rigid joints": "seven_joint_wall",
    "7 flexible joints": "seven_joint_flexible",
    "7 flexible joints, motors": "seven_joint_flexible_motors",
    "14 rigid joints, 6 constraints": "two_arms",
}


@pytest.mark.parametrize("label", LAWS)
def test_law(label, compare):
    laws = [loop.controller.law for _, _, loop, _ in loops(LAWS[label])]
    law, state = laws[0], laws[0].system.nominal_state
    reference = np.linspace(0.1, 0.5, len(law.reference_signals))
    functions = [one.function for one in (laws * 2)[:2]]
    for one, two in zip(
        *(f(state, reference, law.all_parameters()) for f in functions), strict=True
    ):
        np.testing.assert_allclose(one, two, rtol=1e-12, atol=1e-12 * np.abs(two).max())
    took = times(calls(functions, state, reference, law.all_parameters()))
    for how in [how for how in took if how != "interpreted"]:
        compare(f"law, {label}: {how}", took[how], "interpreted", took["interpreted"])


def test_closed_loop(compare):
    """In Drake: a derivative at a new state, and a step of 1 ms with its projection."""
    for how, _, loop, context in loops("seven_joint_wall"):
        law = loop.controller.law
        sizes = law.system.num_states, len(law.reference_signals), law.system.num_controls
        # The loop as wired, and as one block, which `simulate` runs.
        state = {"state": loop.plant.GetOutputPort("state")}
        block = TracedSystem(
            compile_diagram(loop.diagram, state, context=context), compiled=how != "interpreted"
        )
        pairs = {
            "as wired": (loop.diagram, context),
            "as one block": (block, block.CreateDefaultContext()),
            "empty": empty_loop(*sizes),
        }
        timed = {}
        for name, (diagram, at) in pairs.items():
            state = at.get_continuous_state_vector().CopyToVector()
            rate = diagram.AllocateTimeDerivatives()

            def touch(at=at, state=state):
                at.SetTime(0.5)
                at.SetContinuousState(state)

            timed[f"touch {name}"] = touch
            timed[name] = lambda touch=touch, diagram=diagram, at=at, rate=rate: (
                touch(),
                diagram.CalcTimeDerivatives(at, rate),
            )
        took = race(timed)
        alone = {name: took[name] - took[f"touch {name}"] for name in pairs}
        for name in ("as wired", "as one block"):
            figure = f"derivative of the closed loop, 7 joints, {name}: {how}"
            wanted = 1.0 if (name, how) == ("as one block", "machine code") else ""
            compare(figure, alone[name], "empty blocks", alone["empty"], wanted)
        runs = [stepping(block, block.CreateDefaultContext()), stepping(*pairs["empty"])]
        found = np.array([[run() for run in runs] for _ in range(30)]).min(axis=0) * 1e-6
        figure = f"1 ms step of the block, RK3, projected: {how}"
        compare(figure, found[0], "empty blocks", found[1])


@pytest.mark.parametrize("case", ["1 ms steps", "accuracy 1e-8"])
def test_rollout(case, compare):
    """Ten seconds, records and all, beside `simulate` interpreted; the same end to 1e-6."""
    settings = FIXED if case == "1 ms steps" else ["integrator.accuracy=1e-8"]
    chosen = scenario("seven_joint_wall", "duration=10", "compiled=false", *settings)
    loop, context = build_scenario(chosen)
    start, parameters = start_values(loop, context)
    moments = np.linspace(0.0, 10.0, 10001 if case == "1 ms steps" else 1001)
    ends = {}

    def drake():
        own = loop.diagram.CreateDefaultContext()
        own.SetTimeStateAndParametersFrom(context)
        simulate(loop.diagram, own, chosen.duration, chosen.integrator)
        ends["simulate"] = loop.record(own)["state"][-1]

    def rolled(how):
        (done,) = rollout(
            loop,
            start,
            parameters,
            moments,
            config=chosen.integrator,
            compiled=how != "interpreted",
        )
        ends[how] = done.record["state"][-1]

    own = {how: lambda how=how: rolled(how) for how in choices()}
    for function in own.values():
        function()  # The first compiles.
    took = race({"simulate": drake, **own}, rounds=3, number=1)
    for how in own:
        np.testing.assert_allclose(ends[how], ends["simulate"], rtol=0.0, atol=1e-6)
        figure = f"10 s of 7 joints on a wall, {case}: rollout, {how}"
        compare(figure, took[how], "simulate", took["simulate"])


def arms_with_motors() -> RobotModel:
    """14 joints with springs and motors, and a weld."""
    return two_arms([SPRINGS, MOTORS])


def flexible_snake() -> RobotModel:
    """30 joints with springs, the last link on a floor."""
    plant = MultibodyPlant(0.0)
    inertia = SpatialInertia(1.0, [0.05, 0.0, 0.0], UnitInertia(0.02, 0.02, 0.02))
    end = plant.world_frame()
    for i in range(30):
        body = plant.AddRigidBody(f"link{i}", inertia)
        joint = RevoluteJoint(f"j{i}", end, body.body_frame(), np.eye(3)[2 - i % 3])
        plant.AddJointActuator(f"motor{i}", plant.AddJoint(joint))
        pose = RigidTransform([0.1, 0.0, 0.0])
        end = plant.AddFrame(FixedOffsetFrame(f"end{i}", body.body_frame(), pose))
    plant.Finalize()
    floor = PointOnSurface("link29", Plane([0.0, 0.0, -1.0], [0.0, 0.0, 1.0]))
    outputs = [JointPositions([f"j{i}" for i in range(30) if i != 26])]
    bent = 0.3 * np.sin(np.arange(30))
    return RobotModel.from_multibody(plant, [floor], outputs, bent, "snake", [SPRINGS])


TRACED = {
    "14 joints with springs and motors": (arms_with_motors, 5.0),
    "30 joints with springs": (flexible_snake, 8.0),
}


@pytest.mark.parametrize("label", TRACED)
def test_tracing(label, compare):
    """Model with its comparison to the plant, structure, law and plant; nothing is compiled."""
    make, wanted = TRACED[label]
    seconds = []
    for _ in range(2):
        began = time.process_time()
        model = make()
        law = TrackingLaw(model.dae, poles(-4.0))
        RobotPlant(model, structure=law.structure)
        seconds.append(time.process_time() - began)
    compare(f"tracing, {label}", min(seconds), wanted=wanted)


def test_starting(compare, tmp_path):
    """Processor time of commands and of what they stand on, in alternation."""

    def seconds(*words):
        began = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, *words], check=True, capture_output=True)
        ended = resource.getrusage(resource.RUSAGE_CHILDREN)
        return ended.ru_utime + ended.ru_stime - began.ru_utime - began.ru_stime

    run = "-m", "drake_dae", "simulate", "two_link_wall", "--set=duration=0.5", "--force"
    for figure, words, bare in (
        ("drake-dae list", ("-m", "drake_dae", "list"), "import numpy"),
        (
            "drake-dae simulate, 0.5 s of two joints",
            (*run, f"--out={tmp_path}"),
            "import pydantic, scipy.linalg, pydrake.multibody.plant",
        ),
    ):
        found = np.array([[seconds(*words), seconds("-c", bare)] for _ in range(5)])
        compare(figure, *found.min(axis=0)[:1], bare, found.min(axis=0)[1])


@pytest.mark.parametrize("name", ["two_link_wall", "seven_joint_wall"])
def test_a_run_beside_real_time(name, compare):
    chosen = scenario(name, "integrator.accuracy=1e-6")
    loop, context = build_scenario(chosen)
    run = simulate(loop.diagram, context, chosen.duration, chosen.integrator)
    compare(f"1 s of {name}", 1.0 / run.times_real_time, "real time", 1.0, 0.05)


@pytest.mark.parametrize(
    ("name", "wanted"), [("wall_point_contact", 1.6), ("wall_hydroelastic", 1.3)]
)
def test_a_run_on_contact_beside_its_plant(name, wanted, compare):
    """1 s of the loop and of its `ContactPlant` alone, under the torques of that run.

    The difference of two runs is the time of the steps, without what a run takes to begin.
    """
    compiled = "compiled=true" if has_compiler() else "compiled=false"
    chosen = scenario(name, f"duration={2.0 * CONTACT}", compiled)
    loop, start = build_scenario(chosen)
    _, model, _ = completed_model(chosen, SceneGraph())
    plant = make_plant(chosen, model, scenario_structure(model))
    builder = DiagramBuilder()
    builder.AddSystem(plant)

    def whole(duration):
        context = start.Clone()
        began = time.process_time()
        simulate(loop.diagram, context, duration, chosen.integrator)
        return time.process_time() - began, loop.record(context)

    record = whole(2.0 * CONTACT)[1]
    torques = record["control"]
    breaks = plant.time_step * np.arange(len(torques) + 1)
    path = PiecewisePolynomial.ZeroOrderHold(breaks, np.vstack([torques, torques[-1:]]).T)
    source = builder.AddSystem(TrajectorySource(path))
    builder.Connect(source.get_output_port(), plant.GetInputPort("control"))
    diagram = builder.Build()

    def alone(duration):
        context = diagram.CreateDefaultContext()
        own = plant.GetMyMutableContextFromRoot(context)
        plant.set_state(own, record["state"][0])
        simulator = Simulator(diagram, context)
        simulator.Initialize()
        began = time.process_time()
        simulator.AdvanceTo(duration)
        took = time.process_time() - began
        end = record["state"][round(duration / plant.time_step)]
        np.testing.assert_allclose(plant.state(own), end, atol=1e-6)
        return took

    times = CONTACT, 2.0 * CONTACT
    runs = [[*(whole(t)[0] for t in times), *(alone(t) for t in times)] for _ in range(3)]
    short, long, plant_short, plant_long = np.min(runs, axis=0) / CONTACT
    compare(f"1 s of {name}", long - short, "its plant alone", plant_long - plant_short, wanted)


@pytest.mark.skipif(not has_compiler(), reason="there is no C compiler")
def test_many_rollouts(compare, tmp_path):
    """10,000 of 1 s with other starts, side by side; and a run of a sweep of 10 s."""
    chosen = scenario("two_link_wall", "integrator.accuracy=1e-6")
    loop, context = build_scenario(chosen)
    start, parameters = start_values(loop, context)
    manifold, random = loop.plant.structure.manifold, np.random.default_rng(0)
    starts = [manifold.settle(start + 0.05 * random.normal(size=4)) for _ in range(500)] * 20

    def run():
        found = rollout(
            loop, starts, parameters, [0.0, 1.0], config=chosen.integrator, compiled=True
        )
        assert all(each.failure is None for each in found)

    run()
    began = time.process_time()
    run()
    compare("10,000 rollouts of 1 s, two joints", time.process_time() - began, wanted=0.5)
    variations = make_variations({"start.errors.tool.z": np.linspace(-0.05, 0.05, 3000)})
    for workers in (1, 2):
        began, file = time.perf_counter(), tmp_path / f"{workers}.db"
        study = sweep(scenario("two_link_wall"), variations, file, workers=workers, rollout=True)
        took = time.perf_counter() - began
        assert study.table()["outcome"] == ["finished"] * 3000
        compare(f"sweep of 3,000 rollouts of 10 s, {workers} processes", took, wanted=20.0)
