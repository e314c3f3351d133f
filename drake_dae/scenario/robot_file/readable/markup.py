"""The text of XML files, changed so that the numbers of its lines stay the same."""

import re
from xml.etree import ElementTree


def blank(match: re.Match[str]) -> str:
    """The line breaks of a text, so that line numbers in messages remain right."""
    return "\n" * match[0].count("\n")


def without_comments(text: str) -> str:
    """The text of an XML file with its comments replaced by line breaks."""
    return re.sub(r"<!--.*?-->", blank, text, flags=re.DOTALL)


def parsed(text: str | bytes) -> ElementTree.Element:
    """The root of an XML text; an empty element if it is malformed, which Drake reports."""
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError:
        return ElementTree.Element("malformed")
