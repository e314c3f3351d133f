"""A block as C99: functions that CasADi generates, and the texts of the templates around them."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from string import Template
from textwrap import fill

import casadi as ca
import numpy as np
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import Context, Diagram

from drake_dae.arrays import FloatArray
from drake_dae.blocks.block import stacked
from drake_dae.blocks.compose import Composed, Port
from drake_dae.blocks.stepping import StepFunctions
from drake_dae.dae import Signal
from drake_dae.errors import ModelError

TEMPLATES = Path(__file__).with_name("c99")

MOST = 2000  # The largest number of steps of a run that is played to exported code.
Vectors = Mapping[str, Sequence[Signal]]  # Name of a vector -> names and units of its entries.


class BlockCode:
    """A part of a diagram as functions in C, and its numbers at a start.

    Parameters of the functions are those of the block, then inputs that keep their value
    (`places`), and last `inputs`, those of each step, which `parameters` and `values` leave out.
    `known` names outputs whose blocks do not name them.
    """

    def __init__(
        self, composed: Composed, context: Context, inputs: Vectors, known: Vectors
    ) -> None:
        block, named, self.inputs = composed.block, composed.block.signals, inputs
        parameters, values = [*named["parameters"]], [block.default("parameters")]
        columns, self.places = [block.parameters], dict[str, slice]()
        for name in [name for name in block.inputs if name not in inputs]:
            system, index = composed.fixed[name]
            port, local = system.get_input_port(index), system.GetMyContextFromRoot(context)
            if not port.HasValue(local):
                raise ModelError(f"the input port '{name}' has no value in this context: fix one")
            self.places[name] = slice(len(parameters), len(parameters) + port.size())
            parameters += signals_of({}, name, port.size())
            values.append(port.Eval(local))
            columns.append(block.inputs[name])
        columns += [block.inputs[name] for name in inputs]
        # Values of one rate are neighbours.
        held = {name: block.held[name] for names in block.rates().values() for name in names}
        self.steps = steps = StepFunctions(
            replace(block, inputs={}, parameters=stacked(columns), held=held, defaults={})
        )
        starts = [np.asarray(each.start, float).ravel() for each in held.values()]
        if any(np.isnan(start).any() for start in starts):
            begun = [
                each.symbol if each.begin is None or np.isfinite(start).all() else each.begin
                for each, start in zip(held.values(), starts, strict=True)
            ]
            value = ca.densify(stacked(begun))
            steps.functions["begin"] = ca.Function("begin", steps.columns, [value])
        self.outputs = {
            name: signals_of({**known, **named}, name, value.numel())
            for name, value in block.outputs.items()
        }
        self.held = np.concatenate([np.zeros(0), *starts])
        self.parameters, self.values = parameters, np.concatenate(values)

    def words(self, name: str) -> dict[str, str]:
        """The texts of a block for the templates, and those that all templates have."""
        prefix = prefix_of(name)
        return {
            "title": comment(name),
            "name": file_of(name),
            "prefix": prefix,
            "guard": prefix.upper(),
            "version": version("drake_dae"),
            "casadi": ca.__version__,
            "inputs": members(self.inputs),
            "outputs": members(self.outputs),
            "num_parameters": str(len(self.parameters)),
            "num_inputs": str(sum(map(len, self.inputs.values()))),
            "num_outputs": str(sum(map(len, self.outputs.values()))),
            "num_held": str(self.held.size),
            "num_rates": str(len(self.steps.rates)),
            "parameters": numbers(self.values),
            "held": numbers(self.held),
            "parameter_names": strings(s.name for s in self.parameters),
            "parameter_units": strings(s.unit for s in self.parameters),
        }


def written(folder: str | Path, files: Mapping[str, str], words: Mapping[str, str]) -> list[Path]:
    """Writes files from templates, name -> template, with words, placeholder -> text."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for name, template in files.items():
        text = Template((TEMPLATES / template).read_text("utf-8")).substitute(words)
        (folder / name).write_text(text, "utf-8")
    return [folder / name for name in files]


def prefix_of(name: str) -> str:
    """A valid C identifier for a name, the prefix of all exported C names."""
    if not re.search("[A-Za-z]", name):
        raise ModelError(f"a name of C has letters of A to Z, got {name!r}")
    prefix = re.sub("[^A-Za-z0-9]+", "_", name).strip("_").lower()
    return f"dae_{prefix}" if prefix[0].isdigit() else prefix


def file_of(name: str) -> str:
    """A file name of letters, digits and "_.-" only."""
    return re.sub(r"[^\w.-]+", "_", name, flags=re.ASCII)


def signals_of(known: Vectors, name: str, size: int) -> list[Signal]:
    """The known signals of a vector if their number is right, otherwise numbered ones."""
    signals = list(known.get(name, ()))
    numbered = [Signal(f"{name}[{i}]" if size > 1 else name) for i in range(size)]
    return signals if len(signals) == size else numbered


def identifiers(vectors: Vectors) -> dict[str, Sequence[Signal]]:
    """Vectors under valid C names; empty ones are left out, as C has no empty arrays."""
    by_word: dict[str, Sequence[Signal]] = {}
    for name, signals in vectors.items():
        word = re.sub(r"\W+", "_", name, flags=re.ASCII)
        word = f"v_{word}" if not word or word[0].isdigit() else word
        while word in by_word:
            word += "_"
        if signals:
            by_word[word] = signals
    return by_word


def members(vectors: Vectors) -> str:
    """C code that declares vectors as members of a struct, with names and units in comments."""
    lines = []
    for name, signals in identifiers(vectors).items():
        width = max(len(comment(signal.name)) for signal in signals)
        rows = [
            f"{i:3d}  {comment(s.name).ljust(width)}  {comment(s.unit)}".rstrip()
            for i, s in enumerate(signals)
        ]
        lines.append(
            f"  double {name}[{len(signals)}];\n    /* " + "\n       ".join(rows) + " */\n"
        )
    return "".join(lines)


def numbers(values: FloatArray) -> str:
    """A C initializer list, with an entry more, as C has no empty arrays; nan becomes NAN."""
    return braced([*(repr(x) if np.isfinite(x) else "NAN" for x in values.tolist()), "0.0"])


def strings(texts: Iterable[str]) -> str:
    """A C initializer list of strings, with a null pointer at its end."""
    rows = ",\n  ".join([*(f'"{comment(text)}"' for text in texts), "0"])
    return f"{{{rows}}}"


def braced(items: Sequence[str]) -> str:
    """A C initializer list of items without spaces in strings, wrapped to short lines."""
    text = fill(", ".join(items), 98, subsequent_indent="  ", break_on_hyphens=False)
    return f"{{{text}}}"


def comment(text: str) -> str:
    """Text for a comment or a string of C, without characters that could end it."""
    return re.sub(r"[^\w .,:;()\[\]'/^+-]|/(?=[/*])", "_", text, flags=re.ASCII)


def write_replay(
    code: BlockCode, kind: str, name: str, folder: str | Path, run: str, words: Mapping[str, str]
) -> list[Path]:
    """Writes play_name_kind.c, name_kind_run.csv, a Makefile and the licence; see play.c."""
    own = identifiers(code.outputs).items()
    sizes = braced([f'{{"{key}", {len(signals)}}}' for key, signals in own])
    file = f"{file_of(name)}_{kind}"
    files = {f"play_{file}.c": "play.c", "Makefile": "Makefile", "LICENSE.txt": "LICENSE.txt"}
    common = {"kind": kind, "most": str(MOST), "output_sizes": sizes}
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
    """A run as CSV: the time in s, the inputs, and the resulting outputs.

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
        if time > own.get_time():
            simulator.AdvanceTo(time)
        row = [own.get_time(), *values(inputs)]
        row += values(outputs) if acts_at_once else []
        simulator.AdvancePendingEvents()
        row += [] if acts_at_once else values(outputs)
        lines.append(",".join(map(repr, row)))
    return "\n".join([*lines, ""])
