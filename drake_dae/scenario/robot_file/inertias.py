"""Impossible inertias of a robot's file, and the nearest possible ones.

The moments d of an inertia about the centre of mass are d_i = s_j + s_k with the second moments
s >= 0 along the principal axes: so none exceeds the sum of the others. The nearest possible inertia
in the Frobenius norm has the same axes, and the s >= 0 for which d is nearest.
"""

from xml.etree.ElementTree import Element, SubElement

import numpy as np
from pydrake.multibody.tree import RotationalInertia

from drake_dae.arrays import FloatArray, number_in
from drake_dae.errors import ModelError

_ENTRIES = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
_ROWS, _COLUMNS = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]

_LEAST = 1e-9
"""The least second moment relative to the sum of all, so that none is negative by round-off."""


def nearest_inertia(inertia: FloatArray) -> FloatArray:
    """The possible inertia nearest to a symmetric matrix in the Frobenius norm, shape (3, 3)."""
    from scipy.optimize import nnls  # Imported here, since few runs need it.

    moments, axes = np.linalg.eigh(inertia)
    second, _ = nnls(np.ones((3, 3)) - np.eye(3), moments)
    second = np.maximum(second, _LEAST * second.sum())
    return np.asarray((axes * (second.sum() - second)) @ axes.T)


def mend_inertia(inertial: Element, kind: str, place: str) -> str:
    """Replaces an impossible inertia in an element <inertial> by the nearest possible one.

    Args:
        inertial: The element; changed.
        kind: ".urdf", ".sdf" or ".xml", the suffix of its file.
        place: Where it is, for messages.

    Returns:
        What was replaced; empty if nothing was.

    Raises:
        ModelError: A mass is negative, a number is none, or no possible inertia is near.
    """
    words = _mass_and_entries(inertial, kind)
    numbers = [number_in(word) for word in words]
    if None in numbers:
        raise ModelError(f"{place}: mass and inertia are numbers, got {', '.join(words)}")
    if len(numbers) != 7:
        return ""  # Drake reports it.
    mass, entries = numbers[0] or 0.0, np.array(numbers[1:], float)
    if mass < 0.0:
        raise ModelError(f"{place}: a mass is positive, got {mass:g} kg")
    if _is_possible(mass, entries):
        return ""
    inertia = np.empty((3, 3))
    inertia[_ROWS, _COLUMNS] = inertia[_COLUMNS, _ROWS] = entries
    nearest = nearest_inertia(inertia) if mass > 0.0 else np.zeros((3, 3))
    before, after = np.linalg.eigvalsh(inertia), np.linalg.eigvalsh(nearest)
    if mass > 0.0 and not np.trace(nearest) > 0.0:
        raise ModelError(
            f"{place}: the moments of inertia are {before} kg m^2, and near these is none that a "
            f"body of {mass:g} kg can have; mend them"
        )
    written = [repr(float(entry)) for entry in nearest[_ROWS, _COLUMNS]]
    matrix = inertial.find("inertia")
    if matrix is None:
        # A fullinertia cannot be combined with a quat, so a diagonal one remains diagonal.
        is_full = "fullinertia" in inertial.attrib
        key = "fullinertia" if is_full else "diaginertia"
        inertial.set(key, " ".join(written[: 6 if is_full else 3]))
    else:
        matrix.clear()
        for key, entry in zip(_ENTRIES, written, strict=True):
            if kind == ".urdf":
                matrix.set(key, entry)
            else:
                SubElement(matrix, key).text = entry
    was, now = (", ".join(f"{d:.3g}" for d in moments) for moments in (before, after))
    change = 100.0 * np.linalg.norm(nearest - inertia) / np.linalg.norm(inertia)
    return f"{place}: ({was}) kg m^2, nearest possible ({now}), changed by {change:.2g} %"


def _is_possible(mass: float, entries: FloatArray) -> bool:
    """Whether Drake accepts an inertia."""
    if mass == 0.0:
        return not np.any(entries)
    try:
        return bool(RotationalInertia(*entries.tolist()).CouldBePhysicallyValid())
    except RuntimeError:
        return False


def _mass_and_entries(inertial: Element, kind: str) -> list[str]:
    """Mass in kg, and xx, yy, zz, xy, xz and yz in kg m^2; fewer if some are missing."""
    if kind == ".xml":
        entries = inertial.get("fullinertia", inertial.get("diaginertia", "")).split()
        return [inertial.get("mass", "0"), *entries, *["0"] * 3][:7] if len(entries) > 2 else []
    mass, matrix = inertial.find("mass"), inertial.find("inertia")
    if matrix is None:
        return []
    if kind == ".urdf":
        weight = "0" if mass is None else mass.get("value", "0")
        return [weight, *(matrix.get(key, "0") for key in _ENTRIES)]
    # The defaults of SDFormat are those of the unit matrix.
    defaults = ("1", "1", "1", "0", "0", "0")
    pairs = zip(_ENTRIES, defaults, strict=True)
    return [inertial.findtext("mass", "1"), *(matrix.findtext(key, one) for key, one in pairs)]
