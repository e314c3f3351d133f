"""Files that a user names: opened if they are files, and read if they are not too large."""

import errno
import os
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from drake_dae.errors import ModelError

MOST_BYTES = 1 << 28
"""The largest size of a file of data: so many bytes of numbers take gigabytes in Python."""

MESHES = (".obj", ".stl", ".ply", ".off", ".dae", ".gltf", ".glb")
"""Kinds of meshes that are read: none of them is packed."""

MOST_RECORDED = 1 << 31
"""The largest size of a record, unpacked."""


def open_file(path: str | Path) -> BinaryIO:
    """Opens a file for reading: no pipe, which may block for ever, and no device without end."""
    if os.path.exists(path) and not os.path.isfile(path):
        raise OSError(errno.EINVAL, "it is a directory, a pipe or a device", str(path))
    return open(path, "rb")


def check_file(
    path: str | Path, error: type[Exception], most: int = MOST_BYTES
) -> tuple[str, int, int]:
    """Checks the size of a file that another library will read, and of an archive what is packed.

    Returns its name, the time of its last change in ns, and its size in bytes.
    """
    try:
        with open_file(path) as file:
            status = os.fstat(file.fileno())
            size = status.st_size
            if size <= most and zipfile.is_zipfile(file):
                members = zipfile.ZipFile(file).infolist()
                size = max(size, sum(member.file_size for member in members))
    except (OSError, ValueError, zipfile.BadZipFile) as cause:
        raise error(f"no file '{path}': {getattr(cause, 'strerror', None) or cause}") from None
    if size > most:
        raise error(f"'{path}' has {size:,} bytes, unpacked; at most {most:,} are read")
    return str(path), status.st_mtime_ns, status.st_size


def read_bytes(path: str | Path, most: int = MOST_BYTES) -> bytes:
    """The bytes of a file of at most this size."""
    with open_file(path) as file:
        data = file.read(most + 1)
    if len(data) > most:
        text = f"it is larger than {most:,} bytes, the most that is read"
        raise OSError(errno.EFBIG, text, str(path))
    return data


def read_text(path: str | Path, most: int = MOST_BYTES) -> str:
    """The text of a file in UTF-8, without a byte order mark, and with single line feeds."""
    text = read_bytes(path, most).decode("utf-8-sig")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_mesh(file: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The vertices of a mesh, shape (n, 3), in its unit, and its triangles, shape (k, 3)."""
    check_file(file, ModelError)
    if file.suffix.lower() not in MESHES:
        raise ModelError(f"'{file.name}' is none of the meshes that are read: {', '.join(MESHES)}")
    try:
        import trimesh
    except ImportError:
        raise ModelError(f"'{file.name}': pip install 'drake_dae[meshes]' to read meshes") from None
    try:
        mesh: Any = trimesh.load(file, force="mesh")
        vertices, triangles = np.array(mesh.vertices, float), np.array(mesh.faces, np.int64)
        corners = vertices[triangles]
        if not (corners.size and corners.shape[1:] == (3, 3) and np.all(np.isfinite(corners))):
            raise ValueError("it has no triangles, or no numbers")
    except Exception as error:  # trimesh has no exceptions of its own.
        reason = " ".join(str(error).split())[:200]
        raise ModelError(f"no mesh in '{file.name}': {reason}") from None
    return vertices, triangles


def check_unwritten(files: Iterable[Path], force: bool) -> None:
    """The rule of all commands: a file is replaced by --force alone, and what is no file never."""
    there = [path for path in files if os.path.lexists(path)]
    for path in there:
        if path.is_symlink() or not path.is_file():
            text = "is a link, a folder or a device, which is never replaced; choose another name"
            raise ModelError(f"'{path}' {text}")
    if there and not force:
        names = ", ".join(f"'{path}'" for path in there)
        raise ModelError(f"not overwritten: {names}; choose another name, or --force")
