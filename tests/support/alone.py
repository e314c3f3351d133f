"""A system alone in a diagram, with all of its ports at hand."""

import numpy as np
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, PortDataType, System


def alone(system: System) -> tuple[Diagram, Context]:
    """A diagram of one system, all ports exported, and a context with random numbers in it.

    An input port has the name "in <index>" there, an output port with vectors "out <index>".
    """
    builder, random = DiagramBuilder(), np.random.default_rng(0)
    builder.AddSystem(system)
    for i in range(system.num_input_ports()):
        if system.get_input_port(i).get_data_type() == PortDataType.kVectorValued:
            builder.ExportInput(system.get_input_port(i), f"in {i}")
    for i in range(system.num_output_ports()):
        if system.get_output_port(i).get_data_type() == PortDataType.kVectorValued:
            builder.ExportOutput(system.get_output_port(i), f"out {i}")
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    context.SetTime(0.4)
    for i in range(diagram.num_input_ports()):
        port = diagram.get_input_port(i)
        port.FixValue(context, random.normal(size=port.size()))
    state = context.get_mutable_continuous_state_vector()
    state.SetFromVector(random.normal(size=state.size()))
    discrete = context.get_mutable_discrete_state()
    for i in range(discrete.num_groups()):
        discrete.get_mutable_vector(i).SetFromVector(random.normal(size=discrete.value(i).size))
    return diagram, context
