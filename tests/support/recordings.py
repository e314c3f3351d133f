"""What a Meshcat recording holds, read back from its HTML page.

The page has one Meshcat command after the other, each packed with MessagePack and written in
base64: set_object, set_transform, set_property, and set_animation for the recording.
"""

import base64
import json
import re
import struct
from dataclasses import dataclass

import numpy as np


def commands(page):
    """All commands of a page, as dictionaries."""
    packed = re.findall(r'base64,([A-Za-z0-9+/=]+)"\)', page)
    return [unpack(base64.b64decode(text)) for text in packed]


@dataclass
class Track:
    """A property of an object over time."""

    times: np.ndarray
    values: np.ndarray


def animation(page):
    """(path, property) -> Track."""
    (command,) = [c for c in commands(page) if c["type"] == "set_animation"]
    tracks = {}
    for item in command["animations"]:
        clip = item["clip"]
        for track in clip["tracks"]:
            name = track["name"].removeprefix(".")
            frames = np.array([key["time"] for key in track["keys"]], dtype=float)
            values = np.array([key["value"] for key in track["keys"]], dtype=float)
            tracks[item["path"], name] = Track(frames / clip["fps"], values)
    return tracks


def objects(page):
    """Path -> the object there."""
    return {c["path"]: c["object"] for c in commands(page) if c["type"] == "set_object"}


def transforms(page):
    """Path -> its transform at the end, shape (4, 4)."""
    return {
        c["path"]: np.array(c["matrix"]).reshape(4, 4, order="F")
        for c in commands(page)
        if c["type"] == "set_transform"
    }


def vertices(thing):
    """Of a line, m, shape (k, 3)."""
    array = thing["geometries"][0]["data"]["attributes"]["position"]["array"]
    return np.asarray(array, dtype=float).reshape(-1, 3)


def middles(thing):
    """Of a tube, the points of its line, m, shape (k, 3)."""
    return vertices(thing).reshape(-1, 6, 3).mean(axis=1)


def overlay(page):
    """What the page says besides Meshcat's own words."""
    (text,) = re.findall(r"const run = (.*);\n", page)
    return json.loads(text)


def unpack(data):
    """What MessagePack packed; the forms that Meshcat uses."""
    value, stop = _unpack(data, 0)
    assert stop == len(data)
    return value


_NUMBERS = {0xCA: ">f", 0xCB: ">d", 0xCC: ">B", 0xCD: ">H", 0xCE: ">I", 0xCF: ">Q"}
_NUMBERS |= {0xD0: ">b", 0xD1: ">h", 0xD2: ">i", 0xD3: ">q"}
_SIZES = {0xC4: (">B", "bytes"), 0xC5: (">H", "bytes"), 0xC6: (">I", "bytes")}
_SIZES |= {0xD9: (">B", "text"), 0xDA: (">H", "text"), 0xDB: (">I", "text")}
_SIZES |= {0xDC: (">H", "list"), 0xDD: (">I", "list"), 0xDE: (">H", "map"), 0xDF: (">I", "map")}
_SIZES |= {0xC7: (">B", "extension"), 0xC8: (">H", "extension"), 0xC9: (">I", "extension")}
_FIXED = {0xD4: 1, 0xD5: 2, 0xD6: 4, 0xD7: 8, 0xD8: 16}
_ARRAYS = {0x12: "<u1", 0x15: "<i4", 0x16: "<u4", 0x17: "<f4", 0x18: "<f8"}


def _unpack(data, at):
    head, at = data[at], at + 1
    if head < 0x80 or head >= 0xE0:
        return (head if head < 0x80 else head - 0x100), at
    if head in (0xC0, 0xC2, 0xC3):
        return {0xC0: None, 0xC2: False, 0xC3: True}[head], at
    if head in _NUMBERS:
        size = struct.calcsize(_NUMBERS[head])
        return struct.unpack_from(_NUMBERS[head], data, at)[0], at + size
    if head in _FIXED:
        size, kind = _FIXED[head], "extension"
    elif head in _SIZES:
        form, kind = _SIZES[head]
        size, at = struct.unpack_from(form, data, at)[0], at + struct.calcsize(form)
    elif head < 0x90:
        size, kind = head & 0x0F, "map"
    elif head < 0xA0:
        size, kind = head & 0x0F, "list"
    else:
        size, kind = head & 0x1F, "text"
    if kind == "text":
        return data[at : at + size].decode(), at + size
    if kind == "bytes":
        return data[at : at + size], at + size
    if kind == "extension":
        # Its type says what the numbers of an array are.
        code, at = data[at], at + 1
        return np.frombuffer(data[at : at + size], _ARRAYS[code]), at + size
    values = []
    for _ in range(size * (2 if kind == "map" else 1)):
        value, at = _unpack(data, at)
        values.append(value)
    return (dict(zip(values[::2], values[1::2], strict=True)) if kind == "map" else values), at
