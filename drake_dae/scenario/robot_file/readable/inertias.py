"""Physically impossible inertias of a file, and the nearest possible ones.

The moments d of an inertia about the centre of mass are d_i = s_j + s_k with the second moments
s >= 0 along the principal axes: so none exceeds the sum of the others. The nearest possible inertia
in the Frobenius norm has the same axes, and the s >= 0 for which d is nearest.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from pydrake.multibody.tree import RotationalInertia

from drake_dae.arrays import FloatArray
from drake_dae.errors import ModelError

_INERTIAL = re.compile(r"<inertial\b[^>]*?(?:/>|>.*?</inertial\s*>)", re.DOTALL)
_ENTRIES = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
_PLACES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))

_LEAST = 1e-9
"""The least second moment relative to their sum, so that none is negative by round-off."""


@dataclass(frozen=True)
class RepairedInertia:
    """A physically impossible inertia.

    Attributes:
        owner: The file with the line, and the link or body.
        moments: Its principal moments about the centre of mass, kg m^2.
        possible: The moments of the nearest possible inertia.
        change: The Frobenius norm of the difference, relative to that of the inertia.
    """

    owner: str
    moments: tuple[float, ...]
    possible: tuple[float, ...]
    change: float

    def __str__(self) -> str:
        was, now = (", ".join(f"{d:.3g}" for d in m) for m in (self.moments, self.possible))
        if not any(self.possible):
            return f"{self.owner}: without mass no body has the moments of inertia ({was}) kg m^2"
        return (
            f"{self.owner}: no body can have the moments of inertia ({was}) kg m^2: none is "
            f"negative or exceeds the sum of the others. The nearest possible are ({now}), the "
            f"inertia changed by {100 * self.change:.2g} %"
        )


def nearest_inertia(inertia: FloatArray) -> FloatArray:
    """The possible inertia nearest to a symmetric matrix in the Frobenius norm, (3, 3)."""
    from scipy.optimize import nnls  # Imported here, since few runs need it.

    moments, axes = np.linalg.eigh(inertia)
    second, _ = nnls(np.ones((3, 3)) - np.eye(3), moments)
    second = np.maximum(second, _LEAST * second.sum())
    return np.asarray((axes * (second.sum() - second)) @ axes.T)


def possible_inertias(text: str, file: Path) -> tuple[str, list[RepairedInertia]]:
    """A file's text with possible inertias, line by line as before, and the changed inertias.

    Args:
        text: A URDF, SDFormat or MJCF file without comments.
        file: Its suffix determines which.

    Raises:
        ModelError: A mass is negative, or there is no possible inertia near one.
    """
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError:
        return text, []  # The error is left to Drake.
    form = _FORMS[file.suffix]
    found = list(_inertials(root))
    repaired: list[RepairedInertia] = []

    def kept(block: re.Match[str]) -> str:
        owner, element = next(places, ("", None))
        read = None if element is None else form.read(element)
        if read is None:
            return block[0]
        mass, inertia = read
        if not np.all(np.isfinite([mass, *inertia.flat])):
            return block[0]  # The error is left to Drake.
        line = text.count("\n", 0, block.start()) + 1
        place = f"{file}:{line}"
        if mass < 0.0:
            raise ModelError(f"{place}: {owner}: a mass is positive, got {mass:g} kg")
        if _is_possible(mass, inertia):
            return block[0]
        nearest = nearest_inertia(inertia) if mass > 0.0 else np.zeros((3, 3))
        if mass > 0.0 and not np.trace(nearest) > 0.0:
            raise ModelError(
                f"{place}: {owner}: the moments of inertia are "
                f"{np.linalg.eigvalsh(inertia)} kg m^2, and near these is none that a body of "
                f"{mass:g} kg can have; mend them"
            )
        repaired.append(_repaired(f"{place}: {owner}", inertia, nearest))
        return form.write(block[0], nearest)

    places = iter(found)
    return _INERTIAL.sub(kept, text), repaired


def _inertials(root: ElementTree.Element) -> Iterator[tuple[str, ElementTree.Element]]:
    """Each inertial with its owner, in the order of the file."""
    owners = {
        inertial: f"{parent.tag} '{parent.get('name', '')}'"
        for parent in root.iter()
        for inertial in parent.iterfind("inertial")
    }
    for inertial in root.iter("inertial"):
        yield owners[inertial], inertial


def _repaired(owner: str, inertia: FloatArray, nearest: FloatArray) -> RepairedInertia:
    was, now = np.linalg.eigvalsh(inertia), np.linalg.eigvalsh(nearest)
    change = np.linalg.norm(nearest - inertia) / np.linalg.norm(inertia)
    return RepairedInertia(owner, tuple(was), tuple(now), float(change))


def _is_possible(mass: float, inertia: FloatArray) -> bool:
    """Whether Drake accepts an inertia."""
    if mass == 0.0:
        return not np.any(inertia)
    try:
        entries = [float(inertia[place]) for place in _PLACES]
        return bool(RotationalInertia(*entries).CouldBePhysicallyValid())
    except RuntimeError:
        return False


def _matrix(entries: Sequence[float]) -> FloatArray:
    """The matrix of (xx, yy, zz, xy, xz, yz)."""
    matrix = np.zeros((3, 3))
    for (i, j), entry in zip(_PLACES, entries, strict=True):
        matrix[i, j] = matrix[j, i] = entry
    return matrix


_Read = tuple[float, FloatArray] | None
"""Mass in kg and inertia in kg m^2 about the centre of mass; None if missing."""


@dataclass(frozen=True)
class _Form:
    """The way in which a kind of file writes an inertia."""

    read: Callable[[ElementTree.Element], _Read]
    write: Callable[[str, FloatArray], str]


def _read_urdf(inertial: ElementTree.Element) -> _Read:
    mass, inertia = inertial.find("mass"), inertial.find("inertia")
    if mass is None or inertia is None:
        return None
    return _numbers(mass.get("value", "0"), [inertia.get(key, "0") for key in _ENTRIES])


def _write_urdf(block: str, inertia: FloatArray) -> str:
    entries = " ".join(f'{key}="{value}"' for key, value in _entries(inertia).items())
    return _replaced(block, r"<inertia\b[^>]*?(?:/>|>\s*</inertia\s*>)", f"<inertia {entries}/>")


def _read_sdf(inertial: ElementTree.Element) -> _Read:
    inertia = inertial.find("inertia")
    if inertia is None:
        return None
    defaults = (*("1",) * 3, *("0",) * 3)
    entries = [inertia.findtext(key, one) for key, one in zip(_ENTRIES, defaults, strict=True)]
    return _numbers(inertial.findtext("mass", "1"), entries)


def _write_sdf(block: str, inertia: FloatArray) -> str:
    entries = "".join(f"<{key}>{value}</{key}>" for key, value in _entries(inertia).items())
    return _replaced(block, r"<inertia\b.*?</inertia\s*>", f"<inertia>{entries}</inertia>")


def _read_mjcf(inertial: ElementTree.Element) -> _Read:
    entries = inertial.get("fullinertia", "").split() or inertial.get("diaginertia", "").split()
    if len(entries) not in (3, 6):
        return None
    return _numbers(inertial.get("mass", ""), [*entries, "0", "0", "0"][:6])


def _write_mjcf(block: str, inertia: FloatArray) -> str:
    # A fullinertia cannot be combined with a quat, so a diagonal inertia remains diagonal.
    key = "fullinertia" if "fullinertia" in block else "diaginertia"
    values = list(_entries(inertia).values())[: 6 if key == "fullinertia" else 3]
    return _replaced(block, rf"{key}\s*=\s*[\"'][^\"']*[\"']", f'{key}="{" ".join(values)}"')


def _numbers(mass: str, entries: Sequence[str]) -> _Read:
    try:
        return float(mass), _matrix([float(entry) for entry in entries])
    except ValueError:
        return None  # The error is left to Drake.


def _entries(inertia: FloatArray) -> Mapping[str, str]:
    return {k: repr(float(inertia[place])) for k, place in zip(_ENTRIES, _PLACES, strict=True)}


def _replaced(block: str, pattern: str, text: str) -> str:
    """A block with the matches of a pattern replaced, with the same number of lines."""
    return re.sub(pattern, lambda found: text + "\n" * found[0].count("\n"), block, flags=re.DOTALL)


_FORMS = {
    ".urdf": _Form(_read_urdf, _write_urdf),
    ".sdf": _Form(_read_sdf, _write_sdf),
    ".xml": _Form(_read_mjcf, _write_mjcf),
}
