"""What Python writes in C for a part of a loop: its functions, vectors and names."""

import re
from collections.abc import Callable, Mapping, Sequence

import casadi as ca
import numpy as np
from pydrake.systems.framework import System

from drake_dae.arrays import FloatArray
from drake_dae.compiler.compiled import CompiledDiagram
from drake_dae.compiler.rates import UpdateRate
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.system.system import DaeSystem
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.errors import ModelError
from drake_dae.running.export.text import braced, comment, string


def prefix_of(name: str) -> str:
    """A name in letters that C takes, with which all others begin.

    Raises:
        ModelError: It has no letters.
    """
    if not re.search("[A-Za-z]", name):
        raise ModelError(f"a name of C has letters of A to Z, got {name!r}")
    prefix = re.sub("[^A-Za-z0-9]+", "_", name).strip("_").lower()
    return f"dae_{prefix}" if prefix[0].isdigit() else prefix


def file_of(name: str) -> str:
    """A name in letters that every file system takes."""
    return re.sub(r"[^\w.-]+", "_", name, flags=re.ASCII)


def members(vectors: Mapping[str, Sequence[Signal]]) -> str:
    """Vectors as members of a struct, each with names and units of its entries."""
    lines = []
    for name, signals in vectors.items():
        width = max(len(comment(signal.name)) for signal in signals)
        lines.append(f"  double {name}[{len(signals)}];")
        entries = [
            f"{i:3d}  {comment(signal.name).ljust(width)}  {comment(signal.unit)}".rstrip()
            for i, signal in enumerate(signals)
        ]
        lines.append("    /* " + "\n       ".join(entries) + " */")
    return "\n".join([*lines, ""])


def identifiers(vectors: Mapping[str, tuple[Signal, ...]]) -> dict[str, tuple[Signal, ...]]:
    """The same under names of C; vectors without entries are left out, which C has not."""
    found = dict[str, tuple[Signal, ...]]()
    for name, signals in vectors.items():
        if not signals:
            continue
        word = re.sub(r"\W+", "_", name, flags=re.ASCII)
        word = f"v_{word}" if not word or word[0].isdigit() else word
        while word in found:
            word += "_"
        found[word] = signals
    return found


def called(symbol: str, function: ca.Function, given: Sequence[str], results: Sequence[str]) -> str:
    """A block of C that calls what CasADi generated.

    Args:
        symbol: What it is called.
        function: The function.
        given, results: Its arguments and results in C.
    """
    arguments = list(given[: function.n_in()])
    return f"""  {{
    const double *arg[{max(1, function.sz_arg())}] = {braced(arguments or ["0"])};
    double *res[{max(1, function.sz_res())}] = {braced(list(results))};
    {symbol}(arg, res, 0, 0, 0);
  }}
"""


def numbers(values: FloatArray, spare: bool = True) -> str:
    """A list of C; what is no number is NAN.

    Args:
        values: Its entries.
        spare: Whether it has one entry more, as where there may be none, which C has not.
    """
    texts = [repr(x) if np.isfinite(x) else "NAN" for x in values.tolist()]
    return braced([*texts, "0.0"] if spare else texts)


def updates(
    rates: Sequence[UpdateRate], own: str, call: Callable[[int], str], due: Callable[[int], str]
) -> dict[str, str]:
    """The functions of all rates, and for each kind a block that calls those that are due at once.

    Args:
        rates: The rates.
        own: The first parameter of the functions, a pointer: its type and its name.
        call: Number of a rate -> what computes its values and whether they are of use, from time,
            own and before.
        due: Number of a rate -> whether it is due.
    """
    pointer = own.split("*")[1]
    found = {"updates": "", "unrestricted": "", "discrete": ""}
    for number, rate in enumerate(rates):
        count = len(rate.places)
        listed = ", ".join(map(str, [*rate.places, 0]))
        found["updates"] += f"""/* From t = {rate.offset:g} s on each {rate.period:g} s. */
static int update_{number}({own}, double time, const double *before, double *held) {{
  static const int places[] = {{{listed}}};
  double values[{count + 1}], valid = 0.0;
  int i;
{call(number)}  for (i = 0; i < {count}; i++) held[places[i]] = values[i];
  return isfinite(valid) != 0;
}}
"""
    for kind in ("unrestricted", "discrete"):
        chosen = [i for i, each in enumerate(rates) if each.is_unrestricted is (kind[0] == "u")]
        if chosen:
            lines = [
                "  {\n    double before[HELD + 1];\n    memcpy(before, held, sizeof(before));\n"
            ]
            lines += [
                f"    if ({due(i)}) good &= update_{i}({pointer}, time, before, held);\n"
                for i in chosen
            ]
            found[kind] = "".join([*lines, "  }\n"])
    return found


def named(prefix: str, what: str, signals: Sequence[Signal]) -> str:
    """Names and units as lists of C that end with a null pointer."""
    lines = []
    for kind in ("name", "unit"):
        texts = [string(getattr(signal, kind)) for signal in signals]
        lines.append(f"const char *const {prefix}_{kind}s_of_{what}s[] = {braced([*texts, '0'])};")
    return "\n".join([*lines, ""])


def parameter_signals(compiled: CompiledDiagram) -> list[Signal]:
    """Names and units of the parameters of all blocks, without inputs; no name comes twice."""
    first = compiled.inputs[0][1].start if compiled.inputs else compiled.sizes["parameters"]
    found = [Signal("")] * first
    for system, part in compiled.parameters:
        found[part] = parameters_of_block(system, part.stop - part.start)
    for system, name, part in compiled.fixed:
        count = part.stop - part.start
        found[part] = [Signal(f"{block_name(system)}.{name}[{i}]") for i in range(count)]
    return distinct(found)


def parameters_of_block(system: System, count: int) -> list[Signal]:
    """Names and units of the numeric parameters of a block, with the block's name before them."""
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
    """The same signals; where a name was there before, a number follows it."""
    names, found = set[str](), list[Signal]()
    for signal in signals:
        name, number = signal.name, 2
        while name in names:
            name, number = f"{signal.name}_{number}", number + 1
        names.add(name)
        found.append(Signal(name, signal.unit))
    return found


def parameter_names(dae: DaeSystem, law: TrackingLaw | None = None) -> list[Signal]:
    """Names and units of a system's parameters, of the derivatives of those that move, and gains.

    Args:
        dae: The system.
        law: The law whose gains follow; None where there are none.
    """
    found = [signal for p in dae.parameters for signal in p.signals]
    found += [
        signal.derivative(order)
        for p in dae.exogenous.moving
        for order in range(1, len(p.derivatives) + 1)
        for signal in p.signals
    ]
    if law is not None:
        found += [
            Signal(f"K of {law.system.output_signals[i].name} for {chain.name}")
            for j, chain in enumerate(law.coordinate_signals)
            for i in np.flatnonzero(law.gains.matrix[:, j])
        ]
    return found
