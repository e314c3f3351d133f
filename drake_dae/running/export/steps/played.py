"""A run of Drake's Simulator as a table of a controller's inputs and outputs at each step."""

from math import floor

import numpy as np
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import Context, Diagram, OutputPortIndex

from drake_dae.compiler.wires import Port
from drake_dae.errors import SimulationError
from drake_dae.running.export.steps.boundary import ExportedPart


def played_run(
    diagram: Diagram,
    part: ExportedPart,
    context: Context,
    config: SimulatorConfig | None,
    duration: float,
    most: int,
) -> str:
    """Returns the run as CSV: each line has the time in s, the inputs, and the resulting outputs.

    The inputs are those before the updates of the same instant. If outputs change by these updates,
    they are evaluated after Drake has made the updates without advancing the time.

    Args:
        diagram: The whole diagram.
        part: The controller of the diagram.
        context: The context at the start.
        config: Drake's settings; None for defaults.
        duration: The largest duration of the run, in s.
        most: The largest number of steps.

    Raises:
        SimulationError: The run ends before its first step.
    """
    config, ticks = config or SimulatorConfig(), part.ticks
    simulator = Simulator(diagram, context.Clone())
    ApplySimulatorConfig(config, simulator)
    own = simulator.get_mutable_context()
    own.SetTime(context.get_time())
    own.SetAccuracy(config.accuracy)
    simulator.Initialize()
    first = ticks.at(context.get_time())
    count = max(1, min(most, floor(duration / ticks.period + 1e-9)))
    wires = part.compiled.wires
    inputs, outputs = list(wires.inputs.values()), list(wires.outputs.values())

    def values(ports: list[Port]) -> list[float]:
        columns = [
            system.get_output_port(OutputPortIndex(index)).Eval(system.GetMyContextFromRoot(own))
            for system, index in ports
        ]
        return np.concatenate(columns).tolist() if columns else []

    signals = [
        signal.name
        for group in (part.inputs, part.outputs)
        for signals in group.values()
        for signal in signals
    ]
    lines = [",".join(["time", *(name.replace(",", " ") for name in signals)])]
    for tick in range(first, first + count):
        try:
            if tick > first:
                simulator.AdvanceTo(ticks.time(tick))
            row = [own.get_time(), *values(inputs)]
            if part.acts_at_once:
                row += values(outputs)
            simulator.AdvancePendingEvents()
            if not part.acts_at_once:
                row += values(outputs)
        except SimulationError:
            if tick == first:
                raise
            break
        lines.append(",".join(map(repr, row)))
    return "\n".join([*lines, ""])
