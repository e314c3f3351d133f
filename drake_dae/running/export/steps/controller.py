"""The whole controller of a loop as one step in C99, and as a class of C++."""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import casadi as ca
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context, Diagram

from drake_dae.arguments import checked
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.running.export.steps.boundary import ExportedPart, controller_part
from drake_dae.running.export.steps.cuts import CONTROL
from drake_dae.running.export.steps.parts import CONTROLLER, WrittenPart, defaults
from drake_dae.running.export.steps.played import played_run
from drake_dae.running.export.steps.words import (
    called,
    file_of,
    identifiers,
    members,
    named,
    numbers,
    parameter_signals,
    prefix_of,
    updates,
)
from drake_dae.running.export.text import braced, comment, generated, string, written
from drake_dae.trace.compiled import without_branches

TEMPLATES = Path(__file__).parent / "c99"
COMMON = TEMPLATES.parents[1] / "c99"

STEPS = 2000
"""At most so many steps has the run that the program plays."""


@checked(ModelError)
def export_controller(
    loop: ClosedLoop | Diagram,
    context: Context,
    name: str,
    folder: str | Path,
    config: SimulatorConfig | None = None,
    duration: float = 2.0,
) -> list[Path]:
    """Writes the whole controller of a loop as one step of C99, with a class of C++ over it.

    It has the law, references, observer, integrals, samples, delays and limits: all that leads from
    what plant and sensors show to the control. name_controller.h says what it does with inputs that
    are not numbers, too old or too late. The program play_name.c plays a run of Drake's Simulator,
    name_run.csv, to it, compares, and takes the time of a step.

    Args:
        loop: The closed loop, or any diagram with one `Plant`.
        context: Its context at the start; not changed.
        name: What the files are called, and, in letters that C takes, the functions.
        folder: Where to write; made if there is none.
        config: Drake's settings for the run; its defaults if None.
        duration: How long that run is at most, in s. It has at most 2000 steps.

    Returns:
        The files.

    Raises:
        ModelError: The controller acts continuously, or has a block that no C has: why.
        OSError: A file cannot be written.
    """
    part, file = controller_part(loop, context), file_of(name)
    words = _words(part, context, name)
    diagram = loop if isinstance(loop, Diagram) else loop.diagram
    run = played_run(diagram, part, context, config, duration, STEPS)
    found = [
        *_written(folder, file, words),
        *written(TEMPLATES, folder, {"play.c": f"play_{file}.c"}, words),
        *written(COMMON, folder, {each: each for each in ("Makefile", "LICENSE.txt")}, words),
    ]
    (found[0].parent / f"{file}_run.csv").write_text(run, encoding="utf-8")
    return [*found, found[0].parent / f"{file}_run.csv"]


def write_controller(
    part: ExportedPart, context: Context, name: str, folder: str | Path
) -> WrittenPart:
    """Writes a controller as name_controller.h, .c and .hpp.

    Args:
        part: As `controller_part` made it.
        context: The context of the diagram at the start.
        name: What the files are called.
        folder: Where to write; made if there is none.

    Raises:
        ModelError: It reads nothing.
        OSError: A file cannot be written.
    """
    files = _written(folder, file_of(name), _words(part, context, name))
    signals = parameter_signals(part.compiled)
    values, inputs = defaults(part, context)
    return WrittenPart(part, CONTROLLER, signals, values, inputs, tuple(files), context.get_time())


def _words(part: ExportedPart, context: Context, name: str) -> dict[str, Any]:
    prefix = prefix_of(name)
    return _Words(part, context, prefix).found | {
        "title": comment(name),
        "name": file_of(name),
        "prefix": prefix,
        "guard": prefix.upper(),
        "version": version("drake_dae"),
        "casadi": ca.__version__,
    }


def _written(folder: str | Path, file: str, words: Mapping[str, Any]) -> list[Path]:
    names = {f"controller.{each}": f"{file}_controller.{each}" for each in ("h", "c", "hpp")}
    return written(TEMPLATES, folder, names, words)


@dataclass
class _Words:
    """What stands in the templates of a controller."""

    part: ExportedPart
    context: Context
    prefix: str

    def __post_init__(self) -> None:
        part, compiled, prefix = self.part, self.part.compiled, self.prefix
        if not part.inputs:
            raise ModelError(
                "the controller reads nothing that is measured, so that none is needed"
            )
        functions = compiled.staged
        start, (_, held) = self.context.get_time(), compiled.start(self.context)
        begin = compiled.initialization(held)
        chosen = {"given": functions["given"], "row": functions["row"]}
        chosen |= {name: each for name, each in functions.items() if name.startswith("update")}
        if begin is not None:
            chosen["begin"] = begin
        self._functions = chosen
        self._symbols = {key: f"{prefix}_traced_controller_{key}" for key in chosen}
        inputs, outputs = identifiers(part.inputs), identifiers(part.outputs)
        signals = parameter_signals(compiled)
        values = compiled.values(self.context)[: len(signals)]
        first = part.ticks.at(start)
        count, updated = compiled.sizes["held"], self._updates()
        self.found: dict[str, Any] = {
            "period": repr(part.ticks.period),
            "start": repr(part.ticks.time(first)),
            "first": str(first),
            "inputs": members(inputs),
            "outputs": members(outputs),
            "num_parameters": str(len(signals)),
            "num_inputs": str(sum(map(len, inputs.values()))),
            "num_outputs": str(sum(map(len, outputs.values()))),
            "num_controls": str(len(part.outputs[CONTROL])),
            "num_held": str(count + 1),
            "count_held": str(count),
            "num_given": str(functions["given"].numel_out(0) + 1),
            "generated": without_branches(
                generated({self._symbols[key]: each for key, each in chosen.items()})
            ),
            "names": named(f"{prefix}_controller", "parameter", signals),
            "parameters": numbers(values),
            "held": numbers(held),
            "given": self._call("given", ["&time", "c->parameters"], ["c->given"]),
            "row": self._call("row", self._arguments("held"), ["row", "&valid"]),
            "begin": self._begin(),
            "updates": updated["updates"],
            "time": self._time(),
            "steps": self._steps(updated),
            "gathered": _copied(inputs, "in->{0}", "fresh + {1}", to_member=False),
            "written": _copied(
                {key: one for key, one in outputs.items() if key != CONTROL},
                "out->{0}",
                "row + {1}",
                first=len(outputs[CONTROL]),
            ),
            "filled": _copied(inputs, "in->{0}", "row + {1}"),
            "shown": _copied(outputs, "out->{0}", "row + {1}", to_member=False),
            "output_sizes": braced(
                [f"{{{string(key)}, {len(one)}}}" for key, one in outputs.items()]
            ),
        }

    def _arguments(self, held: str) -> list[str]:
        # There is no continuous state; its place takes any pointer.
        return ["&time", "0", held, "c->parameters", "c->given"]

    def _call(self, key: str, given: list[str], results: list[str]) -> str:
        return called(self._symbols[key], self._functions[key], given, results)

    def _begin(self) -> str:
        if "begin" not in self._functions:
            return ""
        return self._call("begin", ["&time", "0", "held", "c->parameters"], ["c->held"])

    def _time(self) -> str:
        """The time of a tick, to the bit as Drake has it: offset + k period of a due rate."""
        lines, ticks = [], self.part.ticks
        for every, first, (period, offset) in zip(
            ticks.every, ticks.first, ticks.rates, strict=True
        ):
            moment = f"{offset!r} + (double)((tick - {first}) / {every}) * {period!r}"
            lines.append(f"  if (is_due(tick, {every}, {first})) time = {moment};\n")
        return "".join(lines)

    def _steps(self, updated: Mapping[str, str]) -> str:
        """The outputs and the updates, in Drake's order."""
        show, acts_at_once = "  good &= show(c, time, held, row);\n", self.part.acts_at_once
        lines = updated["unrestricted"] + updated["discrete"]
        return show + lines if acts_at_once else lines + show

    def _updates(self) -> dict[str, str]:
        ticks = self.part.ticks
        return updates(
            self.part.compiled.rates,
            "Controller *c",
            lambda i: self._call(f"update_{i}", self._arguments("before"), ["values", "&valid"]),
            lambda i: f"is_due(tick, {ticks.every[i]}, {ticks.first[i]})",
        )


def _copied(
    vectors: dict[str, Any], member: str, place: str, first: int = 0, to_member: bool = True
) -> str:
    """Copies between members of a struct and one array."""
    lines = []
    for name, signals in vectors.items():
        pair = member.format(name, first), place.format(name, first)
        to, source = pair if to_member else pair[::-1]
        lines.append(f"  memcpy({to}, {source}, sizeof(double) * {len(signals)});\n")
        first += len(signals)
    return "".join(lines)
