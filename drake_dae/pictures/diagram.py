"""The block diagram of a Drake diagram, drawn by Graphviz."""

import shutil
import subprocess
from html import escape
from pathlib import Path

from pydrake.systems.framework import Diagram, InputPortIndex, OutputPortIndex, System
from pydrake.systems.primitives import Multiplexer, VectorLogSink

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
_COLORS |= dict.fromkeys(("task", "cascade", "governing"), _COLORS["control"])
"""Folder of a block's class in `drake_dae/systems` -> color; other blocks are grey."""


@checked(ModelError)
def save_diagram(diagram: Diagram, path: str | Path) -> None:
    """Draws the block diagram of a Drake diagram.

    Lines are labelled with the names of their ports; all connections from one block to another are
    one line. Logs are omitted. The output ports that the diagram exports are listed below it.

    Args:
        diagram: The diagram.
        path: A .svg, .png or .pdf, which Graphviz's `dot` draws, or a .dot, which contains the
            diagram in Graphviz's language.

    Raises:
        ModelError: The file has another suffix, or `dot` is not installed.
        OSError: The file cannot be written.
    """
    file, kind = Path(path), Path(path).suffix
    if kind not in SUFFIXES:
        raise ModelError(f"a block diagram is a {', '.join(SUFFIXES)}, got '{file.name}'")
    text = diagram_text(diagram)
    file.write_bytes(text.encode() if kind == ".dot" else _run_dot(text, kind))


def diagram_svg(diagram: Diagram) -> str | None:
    """Returns the block diagram as an <svg> element; None if `dot` is not installed."""
    if shutil.which("dot") is None:
        return None
    svg = _run_dot(diagram_text(diagram), ".svg").decode()
    return svg[svg.index("<svg") :]


def _run_dot(text: str, kind: str) -> bytes:
    """Returns the content of the file that Graphviz draws from a text in its language."""
    program = shutil.which("dot")
    if program is None:
        raise ModelError(
            f"Graphviz draws the {kind} of a block diagram, and its program `dot` is not "
            "installed; install graphviz (apt install graphviz), or write a .dot"
        )
    command = [program, f"-T{kind[1:]}"]
    process = subprocess.run(command, input=text.encode(), capture_output=True, check=False)
    if process.returncode != 0:
        raise ModelError(f"Graphviz: {process.stderr.decode(errors='replace').strip()}")
    return process.stdout


def diagram_text(diagram: Diagram) -> str:
    """Returns the block diagram in Graphviz's language, without logs and what stacks for them."""
    wires = [(reader, writer) for (reader, _), (writer, _) in diagram.connection_map().items()]
    logs = {block for block in diagram.GetSystems() if isinstance(block, VectorLogSink)}
    logs |= {
        stacks
        for stacks in diagram.GetSystems()
        if isinstance(stacks, Multiplexer)
        and {reader for reader, writer in wires if writer is stacks} <= logs
    }
    blocks = [block for block in diagram.GetSystems() if block not in logs]
    numbers = {block.get_name(): number for number, block in enumerate(blocks)}
    lines_between: dict[tuple[str, str], list[str]] = {}
    for (target, input_port), (source, output_port) in diagram.connection_map().items():
        pair = f"b{numbers.get(source.get_name())}", f"b{numbers.get(target.get_name())}"
        if "bNone" not in pair:
            output = source.get_output_port(output_port).get_name()
            entry = target.get_input_port(input_port).get_name()
            text = output if output == entry else f"{output} → {entry}"
            lines_between.setdefault(pair, []).append(text)
    plants = {f"b{i}" for i, block in enumerate(blocks) if isinstance(block, Plant)}
    observers = {f"b{i}" for i, block in enumerate(blocks) if _family(block) == "observing"}

    def rank(source: str, target: str) -> str:
        """Lines from the plant and to observers do not count: the plant is at the right end."""
        return ", constraint=false" if source in plants or target in observers else ""

    lines = [
        "digraph {",
        'rankdir=LR; nodesep=0.4; ranksep=0.9; fontname="sans-serif"; fontsize=10; labelloc=b',
        'node [shape=box, style="filled,rounded", fontname="sans-serif", fontsize=12]',
        'edge [fontname="sans-serif", fontsize=10, color="#444", fontcolor="#222"]',
        *(f"b{number} [{_block(block)}]" for number, block in enumerate(blocks)),
        *_inputs(diagram, numbers),
        *(
            f"{source} -> {target} "
            f"[label=<{'<BR/>'.join(map(escape, texts))}>{rank(source, target)}]"
            for (source, target), texts in lines_between.items()
        ),
        f"label=<{_caption(diagram)}>",
        "}",
    ]
    return "\n".join(lines) + "\n"


def _family(block: System) -> str:
    """Returns the folder of a block's class in `drake_dae/systems`; "" for other blocks."""
    names = type(block).__module__.split(".")
    return names[2] if names[:2] == ["drake_dae", "systems"] and len(names) > 2 else ""


def _block(block: System) -> str:
    """Returns the attributes of a block: its name and class, and the color of its family."""
    # Drake's default name contains "@" and an address in memory.
    name = "" if "@" in block.get_name() else f"<B>{escape(block.get_name())}</B><BR/>"
    kind = f'<FONT POINT-SIZE="9">{escape(type(block).__name__)}</FONT>'
    return f'label=<{name}{kind}>, fillcolor="{_COLORS.get(_family(block), "#eeeeee")}"'


def _inputs(diagram: Diagram, numbers: dict[str, int]) -> list[str]:
    """Returns the input ports of the diagram, and their lines to blocks."""
    lines = []
    for i in range(diagram.num_input_ports()):
        port = diagram.get_input_port(InputPortIndex(i))
        lines.append(f'in{i} [shape=plaintext, style="", label=<{escape(port.get_name())}>]')
        for block, entry in diagram.GetInputPortLocators(InputPortIndex(i)):
            if block.get_name() in numbers:
                name = escape(block.get_input_port(entry).get_name())
                lines.append(f"in{i} -> b{numbers[block.get_name()]} [label=<{name}>]")
    return lines


def _caption(diagram: Diagram) -> str:
    ports = [
        diagram.get_output_port(OutputPortIndex(i)).get_name()
        for i in range(diagram.num_output_ports())
    ]
    exported = f"<BR/>output ports: {escape(', '.join(ports))}" if ports else ""
    return f"{escape(diagram.get_name())}{exported}"
