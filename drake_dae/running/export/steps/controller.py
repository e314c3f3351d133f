"""The whole controller of a loop as one step function in C99, and as a C++ class."""

from collections.abc import Mapping, Sequence
from math import floor
from pathlib import Path

import numpy as np
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import Context, Diagram, OutputPortIndex

from drake_dae.arguments import checked
from drake_dae.compiler.wires import Port
from drake_dae.dae import Signal
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError, SimulationError
from drake_dae.running.export.steps.boundary import ExportedPart, controller_part
from drake_dae.running.export.steps.cuts import CONTROL
from drake_dae.running.export.steps.parts import CONTROLLER, WrittenPart, defaults
from drake_dae.running.export.steps.ticks import Ticks
from drake_dae.running.export.steps.words import (
    GeneratedFunctions,
    common_words,
    file_of,
    identifiers,
    members,
    named,
    numbers,
    parameter_signals,
    prefix_of,
    updates,
)
from drake_dae.running.export.text import braced, string, written

TEMPLATES = Path(__file__).parent / "c99"
COMMON = TEMPLATES.parents[1] / "c99"

MOST_PLAYED = 2000
"""The largest number of steps of the run in the test program."""


@checked(ModelError)
def export_controller(
    loop: ClosedLoop | Diagram,
    context: Context,
    name: str,
    folder: str | Path,
    config: SimulatorConfig | None = None,
    duration: float = 2.0,
) -> list[Path]:
    """Writes the whole controller of a loop as one step function in C99, with a C++ class.

    The controller consists of all blocks between measurements and control: law, references,
    observer, integrals, samplers, delays and limits. name_controller.h describes the reaction to
    inputs that are not finite, too old or too late. The program play_name.c feeds a recorded run of
    Drake's Simulator, name_run.csv, to the controller, compares its outputs, and measures the time
    of a step.

    Args:
        loop: The closed loop, or any diagram with one `Plant`.
        context: Its context at the start; not changed.
        name: The name of the files, and, as a C identifier, the prefix of the functions.
        folder: The folder to write to; created if it does not exist.
        config: Drake's settings of the run; None for defaults.
        duration: The largest duration of the run, in s. The run has at most 2000 steps.

    Returns:
        The paths of the files.

    Raises:
        ModelError: The controller acts continuously, or has a block that cannot be exported.
        OSError: A file cannot be written.
    """
    part, file = controller_part(loop, context), file_of(name)
    words = _words(part, context, name)
    diagram = loop if isinstance(loop, Diagram) else loop.diagram
    run = played_run(diagram, part, context, config, duration, MOST_PLAYED)
    files = [
        *_written(folder, file, words),
        *written(TEMPLATES, folder, {"play.c": f"play_{file}.c"}, words),
        *written(COMMON, folder, {name: name for name in ("Makefile", "LICENSE.txt")}, words),
    ]
    table = Path(folder) / f"{file}_run.csv"
    table.write_text(run, encoding="utf-8")
    return [*files, table]


def write_controller(
    part: ExportedPart, context: Context, name: str, folder: str | Path
) -> WrittenPart:
    """Writes a controller as name_controller.h, .c and .hpp.

    Args:
        part: The controller, from `controller_part`.
        context: The context of the diagram at the start.
        name: The name of the files.
        folder: The folder to write to; created if it does not exist.

    Raises:
        ModelError: The controller reads no measurement.
        OSError: A file cannot be written.
    """
    files = _written(folder, file_of(name), _words(part, context, name))
    signals = parameter_signals(part.compiled)
    values, inputs = defaults(part, context)
    return WrittenPart(part, CONTROLLER, signals, values, inputs, tuple(files), context.get_time())


def _written(folder: str | Path, file: str, words: Mapping[str, str]) -> list[Path]:
    names = {f"controller.{end}": f"{file}_controller.{end}" for end in ("h", "c", "hpp")}
    return written(TEMPLATES, folder, names, words)


def _words(part: ExportedPart, context: Context, name: str) -> dict[str, str]:
    """The texts for the templates of a controller."""
    if not part.inputs:
        raise ModelError("the controller reads nothing that is measured, so that none is needed")
    compiled, ticks, prefix = part.compiled, part.ticks, f"{prefix_of(name)}_controller"
    _, held = compiled.start(context)
    functions = GeneratedFunctions.of(
        compiled, ("given", "row"), held, f"{prefix_of(name)}_traced_controller"
    )

    def arguments(held: str) -> list[str]:
        # There is no continuous state, so that its pointer can be null.
        return ["&time", "0", held, "c->parameters", "c->given"]

    code = updates(
        compiled.rates,
        "Controller *c",
        lambda i: functions.call(f"update_{i}", arguments("before"), ["values", "&valid"]),
        lambda i: f"is_due(tick, {ticks.every[i]}, {ticks.first[i]})",
    )
    # The outputs and the updates, in Drake's order.
    steps = ["  good &= show(c, time, held, row);\n", code["unrestricted"] + code["discrete"]]
    begin = ""
    if "begin" in functions.functions:
        begin = functions.call("begin", ["&time", "0", "held", "c->parameters"], ["c->held"])
    inputs, outputs = identifiers(part.inputs), identifiers(part.outputs)
    others = {key: signals for key, signals in outputs.items() if key != CONTROL}
    parameters, first = parameter_signals(compiled), ticks.at(context.get_time())
    num_controls = len(part.outputs[CONTROL])
    return common_words(name) | {
        "period": repr(ticks.period),
        "start": repr(ticks.time(first)),
        "first": str(first),
        "inputs": members(inputs),
        "outputs": members(outputs),
        "num_parameters": str(len(parameters)),
        "num_inputs": str(sum(map(len, inputs.values()))),
        "num_outputs": str(sum(map(len, outputs.values()))),
        "num_controls": str(num_controls),
        "num_held": str(held.size + 1),
        "count_held": str(held.size),
        "num_given": str(functions.functions["given"].numel_out(0) + 1),
        "generated": functions.code(),
        "names": named(prefix, "parameter", parameters),
        "parameters": numbers(compiled.values(context)[: len(parameters)]),
        "held": numbers(held),
        "given": functions.call("given", ["&time", "c->parameters"], ["c->given"]),
        "row": functions.call("row", arguments("held"), ["row", "&valid"]),
        "begin": begin,
        "updates": code["updates"],
        "time": _time(ticks),
        "steps": "".join(steps if part.acts_at_once else steps[::-1]),
        "gathered": _copied(inputs, "in->{0}", "fresh + {1}", to_member=False),
        "written": _copied(others, "out->{0}", "row + {1}", first=num_controls),
        "filled": _copied(inputs, "in->{0}", "row + {1}"),
        "shown": _copied(outputs, "out->{0}", "row + {1}", to_member=False),
        "output_sizes": braced(
            [f"{{{string(key)}, {len(signals)}}}" for key, signals in outputs.items()]
        ),
    }


def _time(ticks: Ticks) -> str:
    """C code for the time of a tick, see `Ticks.time`."""
    lines = []
    for every, first, (period, offset) in zip(ticks.every, ticks.first, ticks.rates, strict=True):
        moment = f"{offset!r} + (double)((tick - {first}) / {every}) * {period!r}"
        lines.append(f"  if (is_due(tick, {every}, {first})) time = {moment};\n")
    return "".join(lines)


def _copied(
    vectors: Mapping[str, Sequence[Signal]],
    member: str,
    place: str,
    first: int = 0,
    to_member: bool = True,
) -> str:
    """C code that copies between members of a struct and one array."""
    lines = []
    for name, signals in vectors.items():
        pair = member.format(name, first), place.format(name, first)
        to, source = pair if to_member else pair[::-1]
        lines.append(f"  memcpy({to}, {source}, sizeof(double) * {len(signals)});\n")
        first += len(signals)
    return "".join(lines)


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
