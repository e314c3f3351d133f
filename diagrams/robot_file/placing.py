"""Links that a robot's file holds in the world, set free where the user says where they stand."""

import re
from collections.abc import Collection, Iterator
from pathlib import Path
from xml.etree import ElementTree

from drake_dae.diagrams.robot_file.urdf import blank

_JOINT = re.compile(r"<joint\b[^>]*(?<!/)>.*?</joint\s*>", re.DOTALL)
_BODY = re.compile(r"<body\b[^>]*?\bname\s*=\s*[\"']([^\"']*)[\"'][^>]*(?<!/)>")
_HOLDING = ("fixed", "floating")
"""Joints to the world in whose place another one can stand."""


def world_links(text: str, file: Path) -> list[str]:
    """The names of the links that a file fixes to the world.

    Args:
        text: A URDF, SDFormat or MJCF file without comments.
        file: Its name tells which it is.
    """
    if file.suffix == ".xml":
        return [body.get("name", "") for body in _fixed_bodies(text)]
    held = (_held(joint[0]) for joint in _JOINT.finditer(text))
    return [link for kind, link in held if kind == "fixed"]


def released(text: str, file: Path, links: Collection[str]) -> str:
    """A file's text in which no joint of it leads from the world to some links, same lines.

    The arguments are those of `world_links`, and the names of the links.
    """
    if not links:
        return text
    if file.suffix == ".xml":
        fixed = {body.get("name", "") for body in _fixed_bodies(text)} & set(links)
        return _BODY.sub(lambda b: b[0] + "<freejoint/>" * (b[1] in fixed), text)

    def kept(joint: re.Match[str]) -> str:
        kind, link = _held(joint[0])
        return blank(joint) if kind in _HOLDING and link in links else joint[0]

    return _JOINT.sub(kept, text)


def _held(joint: str) -> tuple[str, str]:
    """The kind of a joint from the world and the link that it holds; empty for other joints."""
    try:
        element = ElementTree.fromstring(joint)
    except ElementTree.ParseError:
        return "", ""
    ends = [
        "" if end is None else end.get("link", (end.text or "").strip())
        for end in (element.find("parent"), element.find("child"))
    ]
    return (element.get("type", ""), ends[1]) if ends[0] == "world" else ("", "")


def _fixed_bodies(text: str) -> Iterator[ElementTree.Element]:
    """The bodies that stand in the world of an MJCF file without a joint."""
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError:
        return  # Drake says what is wrong.
    for body in root.iterfind("worldbody/body"):
        if body.find("joint") is None and body.find("freejoint") is None:
            yield body
