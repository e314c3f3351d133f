"""Rewrites URDF of vendors that Drake rejects or reads differently than other parsers.

Position limits of continuous joints and <mimic> of fixed joints are removed. A material without a
colour gets the first colour of that name, or none. Actuators of equal names get different names.
Transmissions to joints that do not exist are removed. "package:///" becomes "package://".
"""

import re
from collections import Counter
from collections.abc import Iterator

from drake_dae.errors import ModelError
from drake_dae.scenario.robot_file.readable.markup import blank

_JOINT = re.compile(
    r"<joint\b(?=[^>]*\bname\s*=\s*[\"']([^\"']*))(?=[^>]*\btype\s*=\s*[\"']([^\"']*))[^>]*"
    r"(?<!/)>.*?</joint\s*>",
    re.DOTALL,
)
_LIMIT = re.compile(r"<limit\b[^>]*>")
_BOUND = re.compile(r"\b(lower|upper)\s*=\s*[\"']\s*([^\"']*?)\s*[\"']")
_MIMIC = re.compile(r"<mimic\b[^>]*?(?:/>|>.*?</mimic\s*>)", re.DOTALL)
_MATERIAL = re.compile(
    r"<material\b[^>]*?\bname\s*=\s*[\"']([^\"']*)[\"'][^>]*?(?:/>|>(.*?)</material\s*>)", re.DOTALL
)
_TRANSMISSION = re.compile(r"<transmission\b[^>]*>.*?</transmission\s*>", re.DOTALL)
_DRIVEN = re.compile(r"<joint\b[^>]*\bname\s*=\s*[\"']([^\"']*)")
_ACTUATOR = re.compile(r"(<actuator\b[^>]*?\bname\s*=\s*[\"'])([^\"']*)")


def as_meant(text: str, without_limits: bool) -> str:
    """Rewrites the text of a URDF without comments; lines stay the same.

    Args:
        text: The text.
        without_limits: Whether empty intervals of limits are removed.

    Raises:
        ModelError: The lower limit of a joint is above the upper one, and `without_limits` is
            false.
    """
    text = _JOINT.sub(lambda joint: _joint(joint, without_limits), text)
    text = _with_first_materials(text)
    text = _without_idle_transmissions(text)
    text = re.sub(r"\bpackage:///+", "package://", text)
    return _with_names_of_their_own(text)


def _joint(joint: re.Match[str], without_limits: bool) -> str:
    text, (name, kind) = joint[0], joint.groups()
    if kind == "fixed":
        return _MIMIC.sub(blank, text)
    bounds = dict(_bounds(text))
    is_empty = len(bounds) == 2 and bounds["lower"] > bounds["upper"]
    if is_empty and kind != "continuous" and not without_limits:
        raise ModelError(
            f"joint '{name}' has limits from {bounds['lower']:g} to {bounds['upper']:g}, which "
            "leave it no room; mend them, or write leave_out: [empty_limits] under robot where the "
            "author means that it has none"
        )
    if kind == "continuous" or is_empty:
        return _LIMIT.sub(lambda limit: _BOUND.sub(blank, limit[0]), text)
    return text


def _bounds(joint: str) -> Iterator[tuple[str, float]]:
    limit = _LIMIT.search(joint)
    for side, value in _BOUND.findall(limit[0]) if limit else ():
        try:
            yield side, float(value)
        except ValueError:
            continue  # The error is left to Drake.


def _with_first_materials(text: str) -> str:
    """Writes the first colour of each name of a material into all materials of that name.

    Some vendors define several colours for a name, of which other parsers use one and Drake none,
    or use a name before they define its colour, or never define it.
    """
    colours: dict[str, str] = {}
    is_plain = True
    for name, body in _MATERIAL.findall(text):
        colour = " ".join(body.split())
        if colour:
            is_plain &= colours.setdefault(name, colour) == colour
        is_plain &= name in colours
    if is_plain:
        return text

    def first(material: re.Match[str]) -> str:
        name = material[1]
        colour = colours.get(name, "")
        return f'<material name="{name}">{colour}</material>' if colour else ""

    return _MATERIAL.sub(lambda material: first(material) + blank(material), text)


def _without_idle_transmissions(text: str) -> str:
    """Removes transmissions to joints that do not exist."""
    joints = {joint[1] for joint in _JOINT.finditer(text)}

    def without_idle(transmission: re.Match[str]) -> str:
        driven = set(_DRIVEN.findall(transmission[0]))
        return blank(transmission) if driven and not driven & joints else transmission[0]

    return _TRANSMISSION.sub(without_idle, text)


def _with_names_of_their_own(text: str) -> str:
    """Appends numbers to equal names of actuators."""
    taken = Counter(name for _, name in _ACTUATOR.findall(text))
    seen: Counter[str] = Counter()

    def named(actuator: re.Match[str]) -> str:
        head, name = actuator.groups()
        seen[name] += 1
        if seen[name] == 1:
            return actuator[0]
        number = seen[name]
        while f"{name}_{number}" in taken:
            number += 1
        taken[f"{name}_{number}"] += 1
        return f"{head}{name}_{number}"

    return _ACTUATOR.sub(named, text)
