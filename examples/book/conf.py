"""The Sphinx configuration of the book, which `make docs` builds."""

import re
from pathlib import Path
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert

import drake_dae

project = "drake_dae"
copyright = "the drake_dae developers"
release = drake_dae.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
myst_enable_extensions = ["dollarmath", "colon_fence", "attrs_inline"]
myst_heading_anchors = 3
default_role = "code"
html_theme = "furo"
html_title = "drake_dae"
html_copy_source = False
html_show_sphinx = False
html_static_path = ["_static"]
html_css_files = ["book.css"]
html_search_scorer = str(Path(__file__).with_name("search.js"))  # Sphinx opens it as given.
html_math_renderer = "mathml"
napoleon_use_ivar = True
add_module_names = False
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
copybutton_prompt_text = "$ "
python_use_unqualified_type_names = True


_MATRIX = re.compile(r"<mo>&#x00028;</mo>(<mtable>.*?</mtable>)<mo>&#x00029;</mo>")


def _mathml(node: nodes.Element, display: str) -> str:
    """Returns MathML; book.css draws the parentheses of matrices: few fonts have tall ones."""
    return _MATRIX.sub(r'<mrow class="matrix">\1</mrow>', convert(node.astext(), display=display))


def _inline(translator: Any, node: nodes.math) -> None:
    translator.body.append(_mathml(node, "inline"))
    raise nodes.SkipNode


def _display(translator: Any, node: nodes.math_block) -> None:
    translator.body.append(f"<p>{_mathml(node, 'block')}</p>")
    raise nodes.SkipNode


_ITEM = re.compile(r"\s*(-|\d+\.)\s")
_SECTION = re.compile(r"\s*(Args|Attributes|Raises|Returns|Yields|Warns):$")


def _plain_text(app: Any, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """Converts a plain text docstring to reStructuredText; indented text is a literal block."""
    converted: list[str] = []
    # The indentation of the line before a literal block; -1 outside of one, -2 in a section.
    indent = -1
    for i, line in enumerate(lines):
        depth = len(line) - len(line.lstrip())
        if _SECTION.match(line):
            indent = -2
        elif indent >= 0 and line.strip() and depth <= indent:
            indent = -1
        if indent < 0:
            line = re.sub(r"([|*]|(?<=\w)_(?!\w))", r"\\\1", re.sub(r"``?", "`", line))
            following = next((other for other in lines[i + 1 :] if other.strip()), "")
            deeper = len(following) - len(following.lstrip()) > depth
            if indent == -1 and line.strip() and deeper and not _ITEM.match(line):
                line = line.rstrip() + (":" if line.rstrip().endswith(":") else " ::")
                converted += [line, ""]
                indent = depth
                continue
        converted.append(line)
    lines[:] = converted


_ARRAY_LIKE = re.compile(r"_Buffer \| .*?_NestedSequence\[complex \| bytes \| str\]")


def _signature(
    app: Any, what: str, name: str, value: Any, options: Any, text: str | None, result: str | None
) -> tuple[str | None, str | None]:
    """Replaces NumPy's long union of types by the name ArrayLike."""
    return text and _ARRAY_LIKE.sub("ArrayLike", text), result and _ARRAY_LIKE.sub(
        "ArrayLike", result
    )


def _bases(app: Any, name: str, value: Any, options: Any, bases: list[Any]) -> None:
    """Omits `object` from the list of base classes."""
    bases[:] = [base for base in bases if base is not object]


def setup(app: Any) -> None:
    """Registers these functions; equations are MathML, which needs no script and no font."""
    app.add_html_math_renderer("mathml", (_inline, None), (_display, None))
    app.connect("autodoc-process-docstring", _plain_text, priority=400)
    app.connect("autodoc-process-signature", _signature)
    app.connect("autodoc-process-bases", _bases)
