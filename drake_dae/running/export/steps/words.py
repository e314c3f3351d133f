"""What Python writes in C for a part of a loop: its functions, vectors and names."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Self

import casadi as ca
import numpy as np
from pydrake.systems.framework import System

from drake_dae.arrays import FloatArray
from drake_dae.compiler.compiled import CompiledDiagram
from drake_dae.compiler.rates import UpdateRate
from drake_dae.dae import DaeSystem, Signal, TrackingLaw
from drake_dae.errors import ModelError
from drake_dae.running.export.text import braced, comment, entry_lines, generated, string
from drake_dae.trace.compiled import without_branches


def prefix_of(name: str) -> str:
    """Returns a valid C identifier for a name, the prefix of all exported C names.

    Raises:
        ModelError: The name has no letters.
    """
    if not re.search("[A-Za-z]", name):
        raise ModelError(f"a name of C has letters of A to Z, got {name!r}")
    prefix = re.sub("[^A-Za-z0-9]+", "_", name).strip("_").lower()
    return f"dae_{prefix}" if prefix[0].isdigit() else prefix


def file_of(name: str) -> str:
    """Returns a file name of letters, digits and "_.-" only."""
    return re.sub(r"[^\w.-]+", "_", name, flags=re.ASCII)


def common_words(name: str) -> dict[str, str]:
    """The texts that the templates of all exports use, for the name of an export."""
    prefix = prefix_of(name)
    return {
        "title": comment(name),
        "name": file_of(name),
        "prefix": prefix,
        "guard": prefix.upper(),
        "version": version("drake_dae"),
        "casadi": ca.__version__,
    }


def members(vectors: Mapping[str, Sequence[Signal]]) -> str:
    """C code that declares vectors as members of a struct, with names and units in comments."""
    lines = []
    for name, signals in vectors.items():
        lines.append(f"  double {name}[{len(signals)}];")
        lines.append("    /* " + "\n       ".join(entry_lines(signals)) + " */")
    return "\n".join([*lines, ""])


def identifiers(vectors: Mapping[str, tuple[Signal, ...]]) -> dict[str, tuple[Signal, ...]]:
    """Returns vectors under valid C names; empty ones are left out, as C has no empty arrays."""
    by_word = dict[str, tuple[Signal, ...]]()
    for name, signals in vectors.items():
        if not signals:
            continue
        word = re.sub(r"\W+", "_", name, flags=re.ASCII)
        word = f"v_{word}" if not word or word[0].isdigit() else word
        while word in by_word:
            word += "_"
        by_word[word] = signals
    return by_word


@dataclass(frozen=True)
class GeneratedFunctions:
    """The functions of a part as C code that CasADi generates.

    Attributes:
        prefix: The prefix of the C names.
        functions: Key -> function; the C names are prefix_key.
    """

    prefix: str
    functions: Mapping[str, ca.Function]

    @classmethod
    def of(
        cls, compiled: CompiledDiagram, keys: Sequence[str], held: FloatArray, prefix: str
    ) -> Self:
        """Chooses functions by their keys, all updates, and "begin" if the part has it."""
        functions, begin = compiled.staged, compiled.initialization(held)
        chosen = {key: functions[key] for key in keys}
        chosen |= {key: f for key, f in functions.items() if key.startswith("update")}
        return cls(prefix, chosen if begin is None else chosen | {"begin": begin})

    def code(self) -> str:
        """C code of all functions."""
        functions = {f"{self.prefix}_{key}": function for key, function in self.functions.items()}
        return without_branches(generated(functions))

    def call(self, key: str, arguments: Sequence[str], results: Sequence[str]) -> str:
        """C code that calls a function.

        Args:
            key: The key of the function.
            arguments, results: C expressions; surplus arguments are left out.
        """
        function = self.functions[key]
        own = list(arguments[: function.n_in()])
        return f"""  {{
    const double *arg[{max(1, function.sz_arg())}] = {braced(own or ["0"])};
    double *res[{max(1, function.sz_res())}] = {braced(list(results))};
    {self.prefix}_{key}(arg, res, 0, 0, 0);
  }}
"""


def numbers(values: FloatArray, spare: bool = True) -> str:
    """Returns a C initializer list; values that are not finite become NAN.

    Args:
        values: The entries.
        spare: Whether to append an entry 0.0, since C has no empty arrays.
    """
    texts = [repr(x) if np.isfinite(x) else "NAN" for x in values.tolist()]
    return braced([*texts, "0.0"] if spare else texts)


def updates(
    rates: Sequence[UpdateRate], own: str, call: Callable[[int], str], due: Callable[[int], str]
) -> dict[str, str]:
    """C code of the update functions of all rates, and of the calls of the due ones.

    Args:
        rates: The rates.
        own: The first parameter of the functions: type and name of a pointer.
        call: Number of a rate -> C code that computes `values` and `valid`.
        due: Number of a rate -> C expression that tells whether its update is due.

    Returns:
        The functions as "updates", and the calls for "unrestricted" and "discrete" updates.
    """
    pointer = own.split("*")[1]
    code = {"updates": "", "unrestricted": "", "discrete": ""}
    for number, rate in enumerate(rates):
        count = len(rate.places)
        listed = ", ".join(map(str, [*rate.places, 0]))
        code["updates"] += f"""/* From t = {rate.offset:g} s on each {rate.period:g} s. */
static int update_{number}({own}, double time, const double *before, double *held) {{
  static const int places[] = {{{listed}}};
  double values[{count + 1}], valid = 0.0;
  int i;
{call(number)}  for (i = 0; i < {count}; i++) held[places[i]] = values[i];
  return isfinite(valid) != 0;
}}
"""
    for kind in ("unrestricted", "discrete"):
        is_unrestricted = kind == "unrestricted"
        chosen = [i for i, rate in enumerate(rates) if rate.is_unrestricted is is_unrestricted]
        if chosen:
            calls = "".join(
                f"    if ({due(i)}) good &= update_{i}({pointer}, time, before, held);\n"
                for i in chosen
            )
            code[kind] = f"""  {{
    double before[HELD + 1];
    memcpy(before, held, sizeof(before));
{calls}  }}
"""
    return code


def named(prefix: str, what: str, signals: Sequence[Signal]) -> str:
    """C code of the names and units of signals, as arrays that end with a null pointer."""
    lines = []
    for kind in ("name", "unit"):
        texts = [string(getattr(signal, kind)) for signal in signals]
        lines.append(f"const char *const {prefix}_{kind}s_of_{what}s[] = {braced([*texts, '0'])};")
    return "\n".join([*lines, ""])


def parameter_signals(compiled: CompiledDiagram) -> list[Signal]:
    """Names and units of the parameters of all blocks, except inputs; names are unique."""
    first = compiled.inputs[0][1].start if compiled.inputs else compiled.sizes["parameters"]
    signals = [Signal("")] * first
    for system, part in compiled.parameters:
        signals[part] = parameters_of_block(system, part.stop - part.start)
    for system, name, part in compiled.fixed:
        count = part.stop - part.start
        signals[part] = [Signal(f"{block_name(system)}.{name}[{i}]") for i in range(count)]
    return distinct(signals)


def parameters_of_block(system: System, count: int) -> list[Signal]:
    """Names and units of the numeric parameters of a block; names have the prefix "block."."""
    dae, law = getattr(system, "dae", None), getattr(system, "law", None)
    own = list(getattr(system, "commands", ()))
    if dae is not None:
        own = parameter_names(dae, law)
        further = dict(getattr(system, "further_parameters", {}).values())
        places = {place: signal for signal, place in further.items()}
        own += [places.get(i, Signal(f"parameter[{i}]")) for i in range(len(own), count)]
    if len(own) != count:
        own = [Signal(f"parameter[{i}]") for i in range(count)]
    return [Signal(f"{block_name(system)}.{s.name}", s.unit) for s in own]


def block_name(system: System) -> str:
    """The name of a block, the same in every process: of one without a name its class."""
    name: str = system.get_name()
    return name.partition("@")[0].rpartition("/")[2] if "@" in name else name


def distinct(signals: Sequence[Signal]) -> list[Signal]:
    """Returns the signals with unique names; a number is appended to repeated names."""
    names, unique = set[str](), list[Signal]()
    for signal in signals:
        name, number = signal.name, 2
        while name in names:
            name, number = f"{signal.name}_{number}", number + 1
        names.add(name)
        unique.append(Signal(name, signal.unit))
    return unique


def parameter_names(dae: DaeSystem, law: TrackingLaw | None = None) -> list[Signal]:
    """Names and units of a system's parameters, derivatives of exogenous signals, and gains.

    Args:
        dae: The system.
        law: The law with the gains; None for no gains.
    """
    signals = [signal for p in dae.parameters for signal in p.signals]
    signals += [
        signal.derivative(order)
        for p in dae.exogenous.moving
        for order in range(1, len(p.derivatives) + 1)
        for signal in p.signals
    ]
    if law is not None:
        signals += [
            Signal(f"K of {law.system.output_signals[i].name} for {chain.name}")
            for j, chain in enumerate(law.coordinate_signals)
            for i in np.flatnonzero(law.gains.matrix[:, j])
        ]
    return signals
