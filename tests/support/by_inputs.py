"""Numbers of a loop or diagram that are set by the names that a page shows."""

import numpy as np
from pydrake.systems.framework import Context, Diagram

from drake_dae import ClosedLoop
from drake_dae.running.bench.inputs import Inputs


def set_inputs(loop: ClosedLoop | Diagram, context: Context, changes: dict[str, float]) -> None:
    """Sets the inputs in a context whose names end with those of `changes`."""
    inputs = Inputs.of(loop, context)
    values = inputs.values(context)
    for ending, value in changes.items():
        places = [k for k, name in enumerate(inputs.names) if name.endswith(ending)]
        assert places, ending
        values[places] = value
    for block, first in inputs.blocks.items():
        own = block.GetMyMutableContextFromRoot(context).get_mutable_numeric_parameter(0)
        own.SetFromVector(values[first : first + own.size()])
    for port, first in inputs.ports.items():
        own_context = port.get_system().GetMyMutableContextFromRoot(context)
        port.FixValue(own_context, np.array(values[first : first + port.size()]))
