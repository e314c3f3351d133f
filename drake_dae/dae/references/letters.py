"""Letters of single strokes, drawn for this library, on a grid that is 9 high.

A stroke is a row of points, each as its digits x and y. Most letters are one stroke, which retraces
itself instead of lifting the tool.
"""

from collections.abc import Iterator

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.errors import ReferenceSignalError

HEIGHT = 9
"""The height of capital letters, in cells of the grid."""

_GAP, _SPACE = 3, 4
"""The gap between two letters and the width of a space, in cells."""

_GLYPHS = {
    "A": "00 39 60/53 13",
    "B": "00 09 49 58 56 45 05 45 64 61 40 00",
    "C": "67 49 29 07 02 20 40 62",
    "D": "00 09 39 66 63 30 00",
    "E": "69 09 05 45 05 00 60",
    "F": "69 09 05 45 05 00",
    "G": "67 49 29 07 02 20 40 62 64 34",
    "H": "09 00 05 65 69 60",
    "I": "09 00",
    "J": "69 62 40 20 02",
    "K": "09 00 03 69 25 60",
    "L": "09 00 60",
    "M": "00 09 34 69 60",
    "N": "00 09 60 69",
    "O": "39 29 07 02 20 40 62 67 49 39",
    "P": "00 09 49 68 65 44 04",
    "Q": "39 29 07 02 20 40 62 67 49 39/32 60",
    "R": "00 09 49 68 65 44 04 34 60",
    "S": "67 49 29 07 06 25 44 63 62 40 20 02",
    "T": "09 69 39 30",
    "U": "09 02 20 40 62 69",
    "V": "09 30 69",
    "W": "09 20 36 40 69",
    "X": "09 60/69 00",
    "Y": "09 34 69 34 30",
    "Z": "09 69 00 60",
    "0": "39 29 07 02 20 40 62 67 49 39",
    "1": "06 39 30",
    "2": "07 29 49 67 66 00 60",
    "3": "07 29 49 67 66 35 64 62 40 20 02",
    "4": "50 59 03 63",
    "5": "69 09 05 45 63 62 40 20 02",
    "6": "67 49 29 07 02 20 40 62 63 45 25 03",
    "7": "09 69 20",
    "8": "25 06 07 29 49 67 66 45 25 03 02 20 40 62 63 45",
    "9": "02 20 40 62 67 49 29 07 06 24 44 66",
    "-": "04 44",
    "+": "04 44/26 22",
    ".": "00 01",
    ",": "01 00",
    "!": "09 03/01 00",
    "?": "07 29 49 67 66 34 33/31 30",
}


def strokes(text: str) -> Iterator[FloatArray]:
    """Generates the strokes of a text from left to right, shape (k, 2), in cells of the grid.

    Small letters are written as capital ones.

    Raises:
        ReferenceSignalError: There is no letter, or an unknown one.
    """
    if not text.strip():
        raise ReferenceSignalError("text: empty, at least one letter is needed")
    offset = 0.0
    for letter in text.upper():
        if letter == " ":
            offset += _SPACE + _GAP
            continue
        if letter not in _GLYPHS:
            raise ReferenceSignalError(
                f"text: no letter '{letter}'; there are {''.join(_GLYPHS)} and the space"
            )
        parts = [
            np.array([[float(digit) for digit in point] for point in part.split()])
            for part in _GLYPHS[letter].split("/")
        ]
        for part in parts:
            yield part + np.array([offset, 0.0])
        offset += max(part[:, 0].max() for part in parts) + _GAP
