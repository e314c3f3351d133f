"""The whole controller of a loop as one step in C99, and as a class of C++."""

from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import casadi as ca
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context, Diagram

from drake_dae.arguments import checked
from drake_dae.compiler.rates import Rate
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.running.export.steps.boundary import CONTROL, Part, controller_part
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
)
from drake_dae.running.export.text import braced, comment, string, written
from drake_dae.trace.compiled import generate, renamed, without_branches

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
    part = controller_part(loop, context)
    prefix, file = prefix_of(name), file_of(name)
    words = _Words(part, context, prefix).found | {
        "title": comment(name),
        "name": file,
        "prefix": prefix,
        "guard": prefix.upper(),
        "version": version("drake_dae"),
        "casadi": ca.__version__,
    }
    files = {
        "controller.h": f"{file}_controller.h",
        "controller.c": f"{file}_controller.c",
        "controller.hpp": f"{file}_controller.hpp",
        "play.c": f"play_{file}.c",
    }
    diagram = loop if isinstance(loop, Diagram) else loop.diagram
    run = played_run(diagram, part, context, config, duration, STEPS)
    found = written(TEMPLATES, folder, files, words)
    found += written(COMMON, folder, {each: each for each in ("Makefile", "LICENSE.txt")}, words)
    (found[0].parent / f"{file}_run.csv").write_text(run, encoding="utf-8")
    return [*found, found[0].parent / f"{file}_run.csv"]


@dataclass
class _Words:
    """What stands in the templates of a controller."""

    part: Part
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
        begin = compiled.begin(held)
        chosen = {"given": functions["given"], "row": functions["row"]}
        chosen |= {name: each for name, each in functions.items() if name.startswith("update")}
        if begin is not None:
            chosen["begin"] = begin
        self._functions = chosen
        self._symbols = {key: f"{prefix}_traced_controller_{key}" for key in chosen}
        generated = generate(*(renamed(f, self._symbols[key]) for key, f in chosen.items()))
        inputs, outputs = identifiers(part.inputs), identifiers(part.outputs)
        signals = parameter_signals(compiled)
        values = compiled.values(self.context)[: len(signals)]
        first = part.ticks.at(start)
        count = compiled.sizes["held"]
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
            "generated": without_branches(generated),
            "names": named(f"{prefix}_controller", "parameter", signals),
            "parameters": numbers(values),
            "held": numbers(held),
            "given": self._call("given", ["&time", "c->parameters"], ["c->given"]),
            "row": self._call("row", self._arguments("held"), ["row", "&valid"]),
            "begin": self._begin(),
            "updates": "".join(_update(*each, self) for each in enumerate(compiled.rates)),
            "time": self._time(),
            "steps": self._steps(),
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

    def _steps(self) -> str:
        """The outputs and the updates, in Drake's order."""
        rates, ticks = self.part.compiled.rates, self.part.ticks
        show = "  good &= show(c, time, held, row);\n"
        lines = [show] if self.part.acts_at_once else []
        for is_unrestricted in (True, False):
            chosen = [i for i, each in enumerate(rates) if each.is_unrestricted is is_unrestricted]
            if not chosen:
                continue
            lines.append("  {\n    double before[HELD + 1];\n")
            lines.append("    memcpy(before, held, sizeof(before));\n")
            for i in chosen:
                due = f"is_due(tick, {ticks.every[i]}, {ticks.first[i]})"
                lines.append(f"    if ({due}) good &= update_{i}(c, time, before, held);\n")
            lines.append("  }\n")
        return "".join([*lines, *([] if self.part.acts_at_once else [show])])


def _update(number: int, rate: Rate, words: _Words) -> str:
    """The function of one rate, from what is held before an instant to what is held after it."""
    count = len(rate.places)
    listed = ", ".join(map(str, [*rate.places, 0]))
    call = words._call(f"update_{number}", words._arguments("before"), ["values", "&valid"])
    return f"""/* From t = {rate.offset:g} s on each {rate.period:g} s. */
static int update_{number}(Controller *c, double time, const double *before, double *held) {{
  static const int places[] = {{{listed}}};
  double values[{count + 1}], valid = 0.0;
  int i;
{call}  for (i = 0; i < {count}; i++) held[places[i]] = values[i];
  return isfinite(valid) != 0;
}}
"""


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
