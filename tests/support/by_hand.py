"""The two-link arm on its wall, wired by hand, with blocks of Drake's before its drives."""

from arms import arm, law
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.primitives import (
    FirstOrderLowPassFilter,
    Gain,
    LogVectorOutput,
    Saturation,
    VectorLogSink,
    ZeroOrderHold,
)

from drake_dae import ReferenceGenerator, RobotPlant, SinusoidReference, TrackingController

OUTPUTS = ("controlled_output", "constraint_force", "state")


def wired(hold: float = 0.0) -> tuple[Diagram, Context, dict[str, VectorLogSink]]:
    """The diagram, its context at a start on the wall, and a logger for each of `OUTPUTS`.

    Args:
        hold: The period in s of a ZeroOrderHold behind the law; 0 for none.
    """
    found, tracking = arm("two_link"), law("two_link")
    builder = DiagramBuilder()
    robot = builder.AddSystem(RobotPlant(found.model, structure=found.structure))
    controller = builder.AddSystem(TrackingController(tracking))
    height, force = SinusoidReference(0.3, 0.3, 1.5), SinusoidReference(20.0, 5.0, 2.0)
    reference = builder.AddSystem(ReferenceGenerator([height, force], tracking.degrees))
    builder.Connect(robot.GetOutputPort("state"), controller.GetInputPort("estimated_state"))
    builder.Connect(reference.GetOutputPort("reference"), controller.GetInputPort("reference"))
    chain = [Gain(0.95, 2), FirstOrderLowPassFilter(0.01, 2), Saturation([-60.0] * 2, [60.0] * 2)]
    if hold:
        chain.insert(1, ZeroOrderHold(hold, 2))
    source = controller.GetOutputPort("control")
    for block in chain:
        builder.AddSystem(block)
        builder.Connect(source, block.get_input_port())
        source = block.get_output_port()
    builder.Connect(source, robot.GetInputPort("control"))
    builder.ExportOutput(source, "torque")
    loggers = {}
    for name in OUTPUTS:
        builder.ExportOutput(robot.GetOutputPort(name), name)
        loggers[name] = LogVectorOutput(robot.GetOutputPort(name), builder)
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    q = found.model.configuration([0.35], [1.2, -1.6])
    robot.set_consistent_state(robot.GetMyMutableContextFromRoot(context), [*q, 0.0, 0.0])
    return diagram, context, loggers
