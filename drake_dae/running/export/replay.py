"""The program that plays a run of Drake's Simulator to exported code, and compares."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import Context, Diagram

from drake_dae.blocks.compose import Port
from drake_dae.errors import SimulationError
from drake_dae.running.export.c_code import BlockCode, braced, file_of, identifiers, string, written

MOST = 2000
"""The largest number of steps of the run."""


def write_replay(
    code: BlockCode, kind: str, name: str, folder: str | Path, run: str, words: Mapping[str, str]
) -> list[Path]:
    """Writes play_name_kind.c, name_kind_run.csv, a Makefile and the licence; see play.c."""
    own = identifiers(code.outputs).items()
    sizes = braced([f"{{{string(key)}, {len(signals)}}}" for key, signals in own])
    file = f"{file_of(name)}_{kind}"
    files = {f"play_{file}.c": "play.c", "Makefile": "Makefile", "LICENSE.txt": "LICENSE.txt"}
    common = {"kind": kind, "KIND": kind.upper(), "most": str(MOST), "output_sizes": sizes}
    paths = written(folder, files, {**code.words(name), **common, **words})
    table = Path(folder) / f"{file}_run.csv"
    table.write_text(run, encoding="utf-8")
    return [*paths, table]


def recorded_run(
    diagram: Diagram,
    context: Context,
    config: SimulatorConfig,
    times: Sequence[float],
    code: BlockCode,
    inputs: Mapping[str, Port],
    outputs: Mapping[str, Port],
    acts_at_once: bool = False,
) -> str:
    """A run as CSV: each line has the time in s, the inputs, and the resulting outputs.

    Inputs are those before the updates of the instant, outputs those after, or at once before.
    """
    simulator = Simulator(diagram, context.Clone())
    ApplySimulatorConfig(config, simulator)
    own = simulator.get_mutable_context()
    own.SetTime(context.get_time())
    own.SetAccuracy(config.accuracy)
    simulator.Initialize()

    def values(ports: Mapping[str, Port]) -> list[float]:
        columns = [
            system.get_output_port(index).Eval(system.GetMyContextFromRoot(own))
            for system, index in ports.values()
        ]
        return np.concatenate([np.zeros(0), *columns]).tolist()

    vectors = *code.inputs.values(), *code.outputs.values()
    names = [signal.name.replace(",", " ") for signals in vectors for signal in signals]
    lines = [",".join(["time", *names])]
    for time in times:
        try:
            if time > own.get_time():
                simulator.AdvanceTo(time)
            row = [own.get_time(), *values(inputs)]
            if acts_at_once:
                row += values(outputs)
            simulator.AdvancePendingEvents()
            if not acts_at_once:
                row += values(outputs)
        except SimulationError:
            if len(lines) == 1:
                raise
            break
        lines.append(",".join(map(repr, row)))
    return "\n".join([*lines, ""])
