"""The block diagram of a Drake diagram, drawn by Graphviz."""

import shutil
import subprocess
from html import escape
from pathlib import Path

from pydrake.systems.framework import Diagram, InputPortIndex, OutputPortIndex, System
from pydrake.systems.primitives import VectorLogSink

from drake_dae.arguments import checked
from drake_dae.errors import ModelError
from drake_dae.systems.plants.contract import Plant

SUFFIXES = (".svg", ".png", ".pdf", ".dot")

_COLORS = {
    "plants": "#d6e6f5",
    "control": "#fde5c8",
    "observing": "#e3d9f2",
    "sensing": "#d9f0d9",
}
_COLORS |= dict.fromkeys(("task", "cascade", "adaptive", "governing"), _COLORS["control"])
"""The folder of a block's class below `systems` -> its color; others are grey."""


@checked(ModelError)
def save_diagram(diagram: Diagram, path: str | Path) -> None:
    """Draws the blocks of a diagram and the wires between them.

    A wire has the names of its ports, and those between two blocks are one line. Logs are left out;
    the ports that the diagram exports stand below it.

    Args:
        diagram: The diagram.
        path: A .svg, .png or .pdf, which Graphviz's `dot` draws, or a .dot with its text alone.

    Raises:
        ModelError: The file has another suffix, or there is no `dot`.
        OSError: The file cannot be written.
    """
    file, kind = Path(path), Path(path).suffix
    if kind not in SUFFIXES:
        raise ModelError(f"a block diagram is a {', '.join(SUFFIXES)}, got '{file.name}'")
    text = diagram_text(diagram)
    file.write_bytes(text.encode() if kind == ".dot" else _drawn(text, kind))


def diagram_svg(diagram: Diagram) -> str | None:
    """The blocks of a diagram as an element of a page; None without `dot`."""
    if shutil.which("dot") is None:
        return None
    drawn = _drawn(diagram_text(diagram), ".svg").decode()
    return drawn[drawn.index("<svg") :]


def _drawn(text: str, kind: str) -> bytes:
    """What Graphviz makes of a text."""
    program = shutil.which("dot")
    if program is None:
        raise ModelError(
            f"a {kind} of a block diagram is drawn by Graphviz, and there is no `dot` here; "
            "install graphviz (apt install graphviz), or write a .dot"
        )
    command = [program, f"-T{kind[1:]}"]
    drawn = subprocess.run(command, input=text.encode(), capture_output=True, check=False)
    if drawn.returncode != 0:
        raise ModelError(f"Graphviz: {drawn.stderr.decode(errors='replace').strip()}")
    return drawn.stdout


def diagram_text(diagram: Diagram) -> str:
    """The blocks and wires of a diagram in Graphviz's language."""
    blocks = [one for one in diagram.GetSystems() if not isinstance(one, VectorLogSink)]
    numbers = {one.get_name(): place for place, one in enumerate(blocks)}
    wires: dict[tuple[str, str], list[str]] = {}
    for (target, entry), (source, leaving) in diagram.connection_map().items():
        pair = f"b{numbers.get(source.get_name())}", f"b{numbers.get(target.get_name())}"
        if "bNone" not in pair:
            given = source.get_output_port(leaving).get_name()
            taken = target.get_input_port(entry).get_name()
            text = given if given == taken else f"{given} → {taken}"
            wires.setdefault(pair, []).append(text)
    plants = {f"b{place}" for place, one in enumerate(blocks) if isinstance(one, Plant)}
    observers = {f"b{place}" for place, one in enumerate(blocks) if _family(one) == "observing"}

    def back(begin: str, end: str) -> str:
        """Wires from the plant and to observers go back, so that the plant stands at the right."""
        return ", constraint=false" if begin in plants or end in observers else ""

    lines = [
        "digraph {",
        'rankdir=LR; nodesep=0.4; ranksep=0.9; fontname="sans-serif"; fontsize=10; labelloc=b',
        'node [shape=box, style="filled,rounded", fontname="sans-serif", fontsize=12]',
        'edge [fontname="sans-serif", fontsize=10, color="#444", fontcolor="#222"]',
        *(f"b{number} [{_block(one)}]" for number, one in enumerate(blocks)),
        *_inputs(diagram, numbers),
        *(
            f"{begin} -> {end} [label=<{'<BR/>'.join(map(escape, texts))}>{back(begin, end)}]"
            for (begin, end), texts in wires.items()
        ),
        f"label=<{_caption(diagram)}>",
        "}",
    ]
    return "\n".join(lines) + "\n"


def _family(block: System) -> str:
    """The folder of a block's class below `systems`; "" for others."""
    names = type(block).__module__.split(".")
    return names[2] if names[:2] == ["drake_dae", "systems"] and len(names) > 2 else ""


def _block(block: System) -> str:
    """A block by its name and its class, in the color of its family."""
    # Drake's name of a block that has none holds an address.
    own = "" if "@" in block.get_name() else f"<B>{escape(block.get_name())}</B><BR/>"
    kind = f'<FONT POINT-SIZE="9">{escape(type(block).__name__)}</FONT>'
    return f'label=<{own}{kind}>, fillcolor="{_COLORS.get(_family(block), "#eeeeee")}"'


def _inputs(diagram: Diagram, numbers: dict[str, int]) -> list[str]:
    """The ports of the diagram that are not wired inside."""
    found = []
    for place in range(diagram.num_input_ports()):
        port = diagram.get_input_port(InputPortIndex(place))
        found.append(f'in{place} [shape=plaintext, style="", label=<{escape(port.get_name())}>]')
        for block, entry in diagram.GetInputPortLocators(InputPortIndex(place)):
            if block.get_name() in numbers:
                name = escape(block.get_input_port(entry).get_name())
                found.append(f"in{place} -> b{numbers[block.get_name()]} [label=<{name}>]")
    return found


def _caption(diagram: Diagram) -> str:
    ports = [
        diagram.get_output_port(OutputPortIndex(place)).get_name()
        for place in range(diagram.num_output_ports())
    ]
    exported = f"<BR/>output ports: {escape(', '.join(ports))}" if ports else ""
    return f"{escape(diagram.get_name())}{exported}"
