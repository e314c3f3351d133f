"""The text of XML files, changed so that the numbers of its lines stay the same."""

import re
from xml.etree import ElementTree
from xml.parsers import expat


def blank(match: re.Match[str]) -> str:
    """The line breaks of a text, so that line numbers in messages remain right."""
    return "\n" * match[0].count("\n")


def without_comments(text: str) -> str:
    """The text of an XML file with its comments replaced by line breaks."""
    return re.sub(r"<!--.*?-->", blank, text, flags=re.DOTALL)


def parsed(text: str | bytes) -> ElementTree.Element:
    """The root of an XML text; an empty element if it is malformed, which Drake reports.

    Like Drake it takes prefixes that are not declared, such as `drake:`, as parts of names.
    """
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError:
        pass
    builder, parser = ElementTree.TreeBuilder(), expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(text, True)
        return builder.close()
    except (expat.ExpatError, AssertionError):  # An assertion of what has no element.
        return ElementTree.Element("malformed")
