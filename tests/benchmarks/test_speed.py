"""Speed of the shipped scenarios, reported and never judged: `make benchmark`.

A derivative is that of the whole closed loop; the ratio is to an empty plant and controller in
Python, in the same run. So is a step, of runge_kutta3 at 1 ms: with its projection and its log. A
record is what is computed of each step afterwards. Traced is parsed, traced and built. Runs are at
an accuracy of 1e-6. The command that lists scenarios has NumPy alone beside it.
"""

import resource
import subprocess
import sys
import time

import numpy as np
import pytest
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource

from drake_dae import build_scenario, load_scenario, simulate
from drake_dae.scenario.shipped import find_scenario

SCENARIOS = ["two_link_wall", "seven_joint_wall"]


class _EmptyPlant(LeafSystem):
    def __init__(self, states, controls):
        super().__init__()
        index = self.DeclareContinuousState(states)
        self.control = self.DeclareVectorInputPort("control", controls)
        self.DeclareStateOutputPort("state", index)

    def DoCalcTimeDerivatives(self, context, derivatives):
        self.control.Eval(context)
        derivatives.get_mutable_vector().SetFromVector(
            context.get_continuous_state_vector().CopyToVector()
        )


class _EmptyController(LeafSystem):
    def __init__(self, states, references, controls):
        super().__init__()
        self.state = self.DeclareVectorInputPort("estimated_state", states)
        self.reference = self.DeclareVectorInputPort("reference", references)
        self.value = np.zeros(controls)
        self.DeclareVectorOutputPort("control", controls, self.calc)

    def calc(self, context, output):
        self.state.Eval(context)
        self.reference.Eval(context)
        output.SetFromVector(self.value)


def empty_loop(states, references, controls):
    builder = DiagramBuilder()
    plant = builder.AddSystem(_EmptyPlant(states, controls))
    controller = builder.AddSystem(_EmptyController(states, references, controls))
    source = builder.AddSystem(ConstantVectorSource(np.zeros(references)))
    builder.Connect(plant.GetOutputPort("state"), controller.GetInputPort("estimated_state"))
    builder.Connect(source.get_output_port(), controller.GetInputPort("reference"))
    builder.Connect(controller.GetOutputPort("control"), plant.GetInputPort("control"))
    diagram = builder.Build()
    return diagram, diagram.CreateDefaultContext()


def stepping(diagram, context):
    """A function that runs 20 steps of 1 ms, and returns what one of them takes, in us."""
    config = SimulatorConfig(
        integration_scheme="runge_kutta3", use_error_control=False, max_step_size=1e-3
    )
    simulator = Simulator(diagram, context)
    ApplySimulatorConfig(config, simulator)
    simulator.Initialize()

    def run():
        began = time.perf_counter()
        simulator.AdvanceTo(context.get_time() + 0.02)
        return 1e6 * (time.perf_counter() - began) / 20

    return run


def test_a_short_run(tmp_path, report):
    """CPU time of the command with all pictures, and of what it stands on, in alternation."""

    def seconds(*words):
        began = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, *words], check=True, capture_output=True)
        ended = resource.getrusage(resource.RUSAGE_CHILDREN)
        return ended.ru_utime + ended.ru_stime - began.ru_utime - began.ru_stime

    run = ("-m", "drake_dae", "simulate", "two_link_wall", "--set=duration=0.5")
    packages = "import pydantic, scipy.linalg, matplotlib.figure, pydrake.multibody.plant"
    pairs = [
        (seconds(*run, f"--out={tmp_path / str(i)}"), seconds("-c", packages)) for i in range(5)
    ]
    ours, theirs = map(min, zip(*pairs, strict=True))
    figures = {"CPU [s]": f"{ours:.2f} (<1.6)", "to its packages alone": f"{ours / theirs:.1f}"}
    report("drake-dae simulate", figures)


@pytest.mark.parametrize("name", SCENARIOS)
def test_building_and_running(name, report):
    began = time.perf_counter()
    scenario = load_scenario(find_scenario(name), ["integrator.accuracy=1e-6"])
    loop, context = build_scenario(scenario)
    built = time.perf_counter() - began
    run = simulate(loop.diagram, context, scenario.duration, scenario.integrator)
    report(
        name,
        {
            "traced [s]": f"{built:.2f} (<2)",
            "x real time": f"{run.times_real_time:.1f} (>20)",
            "steps": f"{run.steps}",
        },
    )
