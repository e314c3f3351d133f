"""Physically impossible inertias of a file, and the nearest possible ones.

The moments d of an inertia about the centre of mass are d_i = s_j + s_k with the second moments
s >= 0 along the principal axes: so none exceeds the sum of the others. The nearest possible inertia
in the Frobenius norm has the same axes, and the s >= 0 for which d is nearest.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from pydrake.multibody.tree import RotationalInertia

from drake_dae.arrays import FloatArray
from drake_dae.errors import ModelError
from drake_dae.scenario.robot_file.readable.markup import blank, parsed

_INERTIAL = re.compile(r"<inertial\b[^>]*?(?:/>|>.*?</inertial\s*>)", re.DOTALL)
_ENTRIES = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
_PLACES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))

_LEAST = 1e-9
"""The least second moment relative to the sum of all, so that none is negative by round-off."""


@dataclass(frozen=True)
class RepairedInertia:
    """A physically impossible inertia and the nearest possible one.

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
    """Replaces impossible inertias in a text by the nearest possible ones; lines stay the same.

    Args:
        text: The text of a URDF, SDFormat or MJCF file without comments.
        file: The file; its suffix determines the format.

    Returns:
        The text, and the replaced inertias.

    Raises:
        ModelError: A mass is negative, or no possible inertia is near one.
    """
    root, form = parsed(text), _FORMS[file.suffix]
    inertials = root.iter("inertial")
    parents = {child: parent for parent in root.iter() for child in parent.iterfind("inertial")}
    repaired: list[RepairedInertia] = []

    def possible(block: re.Match[str]) -> str:
        element = next(inertials, None)
        mass_and_inertia = None if element is None else form.read(element)
        if element is None or mass_and_inertia is None:
            return block[0]
        mass, inertia = mass_and_inertia
        parent, line = parents[element], text.count("\n", 0, block.start()) + 1
        owner = f"{file}:{line}: {parent.tag} '{parent.get('name', '')}'"
        if mass < 0.0:
            raise ModelError(f"{owner}: a mass is positive, got {mass:g} kg")
        if _is_possible(mass, inertia):
            return block[0]
        nearest = nearest_inertia(inertia) if mass > 0.0 else np.zeros((3, 3))
        before, after = np.linalg.eigvalsh(inertia), np.linalg.eigvalsh(nearest)
        if mass > 0.0 and not np.trace(nearest) > 0.0:
            raise ModelError(
                f"{owner}: the moments of inertia are {before} kg m^2, and near these is none that "
                f"a body of {mass:g} kg can have; mend them"
            )
        change = float(np.linalg.norm(nearest - inertia) / np.linalg.norm(inertia))
        repaired.append(RepairedInertia(owner, tuple(before), tuple(after), change))
        return form.write(block[0], nearest)

    return _INERTIAL.sub(possible, text), repaired


def _is_possible(mass: float, inertia: FloatArray) -> bool:
    """Whether Drake accepts an inertia."""
    if mass == 0.0:
        return not np.any(inertia)
    try:
        entries = [float(inertia[i, j]) for i, j in _PLACES]
        return bool(RotationalInertia(*entries).CouldBePhysicallyValid())
    except RuntimeError:
        return False


_Read = tuple[float, FloatArray] | None
"""Mass in kg and inertia in kg m^2 about the centre of mass; None if missing or malformed."""


@dataclass(frozen=True)
class _InertiaForm:
    """How a format writes an inertia: functions that read and that replace it."""

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
    entries = [inertia.findtext(key, "10"[i > 2]) for i, key in enumerate(_ENTRIES)]
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
    """The numbers of these texts; None if some are no finite numbers, which Drake reports."""
    try:
        numbers = [float(mass), *map(float, entries)]
    except ValueError:
        return None
    inertia = np.zeros((3, 3))
    for (i, j), entry in zip(_PLACES, numbers[1:], strict=True):
        inertia[i, j] = inertia[j, i] = entry
    return (numbers[0], inertia) if np.all(np.isfinite(numbers)) else None


def _entries(inertia: FloatArray) -> Mapping[str, str]:
    return {k: repr(float(inertia[place])) for k, place in zip(_ENTRIES, _PLACES, strict=True)}


def _replaced(block: str, pattern: str, text: str) -> str:
    """A block with the matches of a pattern replaced, with the same number of lines."""
    return re.sub(pattern, lambda match: text + blank(match), block, flags=re.DOTALL)


_FORMS = {
    ".urdf": _InertiaForm(_read_urdf, _write_urdf),
    ".sdf": _InertiaForm(_read_sdf, _write_sdf),
    ".xml": _InertiaForm(_read_mjcf, _write_mjcf),
}
