"""A closed loop in Python that computes nothing: what Drake itself takes."""

import time

import numpy as np
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource


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
