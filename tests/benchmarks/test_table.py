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
from pydrake.geometry import SceneGraph
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial
from runs import scenario
from timing import calls, has_compiler, race, times

from drake_dae import build_scenario, compile_diagram, rollout, simulate, sweep
from drake_dae.blocks.traced_system import TracedSystem
from drake_dae.running import start_values
from drake_dae.scenario.build import make_plant
from drake_dae.scenario.model import completed_model, scenario_structure
from drake_dae.studies import make_variations

FIXED = [
    "integrator.integration_scheme=runge_kutta3",
    "integrator.use_error_control=false",
    "integrator.max_step_size=1e-3",
]
CONTACT = 2.0
"""The simulated time of a run on contact in s, and half of that of a longer one."""

CHOICES = {"interpreted": "false"} | ({"machine code": "true"} if has_compiler() else {})
"""How functions run, and the choice of a scenario that makes them so."""


def loops(name: str):
    """A scenario for each choice: how it runs, its loop, and its start."""
    for how, compiled in CHOICES.items():
        yield how, *build_scenario(scenario(name, f"compiled={compiled}"))


LAWS = {
    "7 rigid joints": "seven_joint_wall",
    "7 flexible joints": "seven_joint_flexible",
    "7 flexible joints, motors": "seven_joint_flexible_motors",
    "14 rigid joints, 6 constraints": "two_arms",
}


@pytest.mark.parametrize("label", LAWS)
def test_law(label, compare):
    laws = [loop.controller.law for _, loop, _ in loops(LAWS[label])]
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


class Empty(LeafSystem):
    """A block that computes nothing: what Drake itself takes."""

    def __init__(self, states, inputs, outputs):
        super().__init__()
        index = self.DeclareContinuousState(states)
        self.inputs = [self.DeclareVectorInputPort(name, size) for name, size in inputs.items()]
        self.value = np.zeros(outputs)
        self.DeclareStateOutputPort("state", index)
        self.DeclareVectorOutputPort("control", outputs, self.calc)

    def calc(self, context, output):
        for port in self.inputs:
            port.Eval(context)
        output.SetFromVector(self.value)

    def DoCalcTimeDerivatives(self, context, derivatives):
        if derivatives.size():
            self.inputs[0].Eval(context)
            state = context.get_continuous_state_vector().CopyToVector()
            derivatives.get_mutable_vector().SetFromVector(state)


def empty_loop(states, references, controls):
    builder = DiagramBuilder()
    plant = builder.AddSystem(Empty(states, {"control": controls}, 0))
    law = {"estimated_state": states, "reference": references}
    controller = builder.AddSystem(Empty(0, law, controls))
    source = builder.AddSystem(ConstantVectorSource(np.zeros(references)))
    builder.Connect(plant.GetOutputPort("state"), controller.GetInputPort("estimated_state"))
    builder.Connect(source.get_output_port(), controller.GetInputPort("reference"))
    builder.Connect(controller.GetOutputPort("control"), plant.GetInputPort("control"))
    diagram = builder.Build()
    return diagram, diagram.CreateDefaultContext()


def test_closed_loop(compare):
    """In Drake: a derivative at a new state, and a step of 1 ms with its projection."""
    for how, loop, context in loops("seven_joint_wall"):
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
        steps = {}
        for name in ("as one block", "empty"):
            config = SimulatorConfig(
                integration_scheme="runge_kutta3", use_error_control=False, max_step_size=1e-3
            )
            simulator = Simulator(*pairs[name])
            ApplySimulatorConfig(config, simulator)
            simulator.Initialize()
            at = simulator.get_context()
            steps[name] = lambda simulator=simulator, at=at: simulator.AdvanceTo(
                at.get_time() + 1e-3
            )
        found = race(steps, rounds=30)
        figure = f"1 ms step of the block, RK3, projected: {how}"
        compare(figure, found["as one block"], "empty blocks", found["empty"])


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
        options = {"config": chosen.integrator, "compiled": how != "interpreted"}
        (done,) = rollout(loop, start, parameters, moments, **options)
        ends[how] = done.record["state"][-1]

    own = {how: lambda how=how: rolled(how) for how in CHOICES}
    for function in own.values():
        function()  # The first compiles.
    took = race({"simulate": drake, **own}, rounds=3, number=1)
    for how in own:
        np.testing.assert_allclose(ends[how], ends["simulate"], rtol=0.0, atol=1e-6)
        figure = f"10 s of 7 joints on a wall, {case}: rollout, {how}"
        compare(figure, took[how], "simulate", took["simulate"])


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
