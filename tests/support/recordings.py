"""What a Meshcat recording holds, read back from its HTML page.

The page has one Meshcat command after the other, each packed with MessagePack and written in
base64: set_object, set_transform, set_property, and set_animation for the recording.
"""

import base64
import json
import re
from typing import NamedTuple

import msgpack
import numpy as np

ARRAYS = {0x12: "<u1", 0x15: "<i4", 0x16: "<u4", 0x17: "<f4", 0x18: "<f8"}
"""Type of an extension -> that of the numbers in an array."""


def commands(page):
    """All commands of a page, as dictionaries."""
    packed = re.findall(r'base64,([A-Za-z0-9+/=]+)"\)', page)
    return [
        msgpack.unpackb(
            base64.b64decode(text), ext_hook=lambda code, data: np.frombuffer(data, ARRAYS[code])
        )
        for text in packed
    ]


class Track(NamedTuple):
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
