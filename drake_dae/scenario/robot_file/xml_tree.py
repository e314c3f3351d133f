"""XML of robot files as a tree whose elements know their lines, without entities and comments."""

from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat
from xml.sax.saxutils import escape, quoteattr

from drake_dae.errors import ModelError
from drake_dae.files import read_bytes

DEEPEST = 200
"""The largest number of elements inside each other."""


class Node(Element):
    """An element of XML, and its line in the file; 0 if it is not of this file."""

    line = 0


def check_included(file: Path, within: tuple[Path, ...]) -> None:
    """Refuses a file that others include, if it is one of them."""
    if file.resolve() in within:
        names = " -> ".join(path.name for path in (*within, file))
        raise ModelError(f"'{file.name}' includes itself: {names}")


def read_xml(file: Path) -> Node:
    """The root of an XML file.

    Like Drake it takes prefixes that are not declared, such as `drake:`, as parts of names.
    """
    try:
        data = read_bytes(file)
    except (OSError, ValueError) as error:
        raise ModelError(f"no file '{file}': {getattr(error, 'strerror', error)}") from None
    text = data.lstrip()  # Drake takes blank lines before the declaration.
    skipped, depth = data[: len(data) - len(text)].count(b"\n"), 0
    builder, parser = TreeBuilder(element_factory=Node), expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > DEEPEST:
            raise ModelError(f"'{file.name}' nests more than {DEEPEST} elements")
        node = builder.start(tag, attributes)
        node.line = skipped + parser.CurrentLineNumber  # type: ignore[attr-defined]

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    def refuse_entity(name: str, *_: object) -> None:
        raise ModelError(f"'{file.name}' declares the entity '{name}': none are read")

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler, parser.EntityDeclHandler = builder.data, refuse_entity
    try:
        parser.Parse(text, True)
    except expat.ExpatError as error:
        line = skipped + error.lineno
        raise ModelError(f"{file}:{line}: no XML: {expat.ErrorString(error.code)}") from None
    root: Node = builder.close()  # type: ignore[assignment]
    return root


def write_xml(root: Element) -> str:
    """The text of a tree, whose elements stand in the lines that they had."""
    pieces: list[str] = []
    line = 1

    def put(node: Element) -> None:
        nonlocal line
        breaks = max(0, getattr(node, "line", 0) - line)
        attributes = "".join(f" {name}={quoteattr(value)}" for name, value in node.items())
        text = escape((node.text or "").strip())
        pieces.append("\n" * breaks + f"<{node.tag}{attributes}>{text}")
        line += breaks + text.count("\n")
        for child in node:
            put(child)
        pieces.append(f"</{node.tag}>")

    put(root)
    return "".join(pieces)
