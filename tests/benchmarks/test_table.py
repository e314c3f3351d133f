"""The figures that a user asks for first, each beside its counterpart in one run.

Counterparts are the same interpreted, and the same in Drake with blocks that do nothing. What is
compared computes the same, which is checked first. Peers stand in `test_peers`.
"""

import time

import numpy as np
import pytest
from pydrake.geometry import SceneGraph
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial
from runs import scenario
from timing import calls, has_compiler, race, times

from drake_dae import build_scenario, compile_diagram, rollout, simulate
from drake_dae.blocks.traced_system import TracedSystem
from drake_dae.running import start_values
from drake_dae.scenario.build import make_plant
from drake_dae.scenario.model import completed_model, scenario_structure

CONTACT = 2.0
"""The simulated time of a run on contact in s, and half of that of a longer one."""

CHOICES = {"interpreted": "false"} | ({"machine code": "true"} if has_compiler() else {})
"""How functions run, and the choice of a scenario that makes them so."""


def loops(name: str):
    """A scenario for each choice: how it runs, its loop, and its start."""
    for how, compiled in CHOICES.items():
        yield how, *build_scenario(scenario(name, f"compiled={compiled}"))


def test_law(compare):
    laws = [loop.controller.law for _, loop, _ in loops("seven_joint_wall")]
    law, state = laws[0], laws[0].system.nominal_state
    reference = np.linspace(0.1, 0.5, len(law.reference_signals))
    functions = [one.function for one in (laws * 2)[:2]]
    for one, two in zip(
        *(f(state, reference, law.all_parameters()) for f in functions), strict=True
    ):
        np.testing.assert_allclose(one, two, rtol=1e-12, atol=1e-12 * np.abs(two).max())
    took = times(calls(functions, state, reference, law.all_parameters()))
    for how in [how for how in took if how != "interpreted"]:
        compare(f"law, 7 rigid joints: {how}", took[how], "interpreted", took["interpreted"])


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
    """In Drake: a derivative at a new state."""
    for how, loop, context in loops("seven_joint_wall"):
        law = loop.controller.law
        sizes = law.system.num_states, len(law.reference_signals), law.system.num_controls
        # The loop as one block, which `simulate` runs.
        state = {"state": loop.plant.GetOutputPort("state")}
        block = TracedSystem(
            compile_diagram(loop.diagram, state, context=context), compiled=how != "interpreted"
        )
        pairs = {"as one block": (block, block.CreateDefaultContext()), "empty": empty_loop(*sizes)}
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
        figure = f"derivative of the closed loop, 7 joints, as one block: {how}"
        wanted = 1.0 if how == "machine code" else ""
        compare(figure, alone["as one block"], "empty blocks", alone["empty"], wanted)


def test_rollout(compare):
    """Ten seconds, records and all, beside `simulate` interpreted; the same end to 1e-6."""
    settings = "duration=10", "compiled=false", "integrator.accuracy=1e-8"
    chosen = scenario("seven_joint_wall", *settings)
    loop, context = build_scenario(chosen)
    start, parameters = start_values(loop, context)
    moments = np.linspace(0.0, 10.0, 1001)
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
        figure = f"10 s of 7 joints on a wall, accuracy 1e-8: rollout, {how}"
        compare(figure, took[how], "simulate", took["simulate"])


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
