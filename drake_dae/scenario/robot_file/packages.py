"""Finds the packages that a robot's files name, "package://<name>/...", as ROS finds them."""

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from pydrake.multibody.parsing import PackageMap

from drake_dae.errors import ModelError
from drake_dae.files import read_bytes
from drake_dae.scenario.forms.keys import at
from drake_dae.scenario.robot_file.readable.markup import without_comments
from drake_dae.scenario.shipped import FOLDER

_URL = re.compile(r"\b(?:package|model)://([^/\s\"'<>]+)[^\s\"'<>,}\]]*")
_MODEL = (".urdf", ".sdf", ".xml", ".yaml", ".yml")
"""The suffixes of files that may contain names of packages."""


def add_packages(packages: Mapping[str, str], package_map: PackageMap) -> None:
    """Adds the shipped package and those of `robot.packages`.

    Raises:
        ScenarioError: A folder does not exist, or the name is one of Drake's.
    """
    package_map.AddPackageXml(str(FOLDER / "models" / "package.xml"))
    for name, folder in packages.items():
        with at(f"robot.packages.{name}"):
            try:
                package_map.Add(name, folder)
            except RuntimeError as error:
                raise ModelError(f"no package in '{folder}': {error}") from None


def find_packages(
    file: str, package_map: PackageMap, places: Sequence[Path] = ()
) -> tuple[list[Path], dict[str, str]]:
    """Adds the packages that a file names, and those that its included files name.

    A package is searched near the file that names it: a folder above the file, or a subfolder of
    the package's name in such a folder, that has a package.xml with the name. Then it is searched
    in ROS_PACKAGE_PATH by the name in its package.xml, and last as a subfolder of its name in the
    folders of ROS_PACKAGE_PATH and in `places`.

    Args:
        file: A path, or a URL of a package.
        package_map: The known packages; the packages that are found are added.
        places: Folders with packages as subfolders of their names.

    Returns:
        The folders of the added packages; and the packages that are not found: name -> a file that
        names it, or "" for `file` itself.
    """
    folders: list[Path] = []
    missing: dict[str, str] = {}
    ros: PackageMap | None = None
    waiting, searched = [(file, Path())], set()
    while waiting:
        url, origin = waiting.pop()
        for name in _URL.findall(url):
            if not package_map.Contains(name) and name not in missing:
                ros = ros or _ros_packages()
                folder = _beside(name, origin) if origin.name else None
                if folder is None and ros.Contains(name):
                    folder = Path(ros.GetPath(name))
                if folder is None:
                    inside = (place / name for place in (*_ros_folders(), *places))
                    folder = next((path for path in inside if path.is_dir()), None)
                if folder is None:
                    missing[name] = str(origin) if origin.name else ""
                    continue
                package_map.Add(name, str(folder))
                folders.append(folder)
        path = _path(url, package_map)
        if path is None or path in searched or path.suffix not in _MODEL or not path.is_file():
            continue
        searched.add(path)
        text = without_comments(path.read_text("utf-8", errors="replace"))
        waiting.extend((match[0], path) for match in _URL.finditer(text))
    return folders, missing


def explained(missing: Mapping[str, str]) -> str:
    """The error message for packages that are not found."""
    name, origin = next(iter(missing.items()))
    where = (
        f", which '{Path(origin).name}' names, is neither beside it" if origin else " is neither"
    )
    others = f" (nor are {', '.join(list(missing)[1:])})" if len(missing) > 1 else ""
    key = "{" + f"{name}: <folder>" + "}"
    return (
        f"unknown package '{name}'{where}, as a folder with a package.xml, nor in "
        f"ROS_PACKAGE_PATH{others}; name its folder under robot.packages, as packages: {key}, "
        f"so that package://{name}/a is <folder>/a"
    )


def _path(url: str, package_map: PackageMap) -> Path | None:
    """The file of a path or a URL; None if the package is unknown."""
    if "://" not in url:
        return Path(url)
    try:
        return Path(package_map.ResolveUrl(url))
    except RuntimeError:
        return None


def _beside(name: str, file: Path) -> Path | None:
    """The folder of a package above a file, or beside a folder above it; None if there is none."""
    for above in file.resolve().parents:
        for folder in (above, above / name):
            if _package_name(folder / "package.xml") == name:
                return folder
    return None


def _package_name(file: Path) -> str:
    """The name in a package.xml; empty if there is none."""
    try:
        text = without_comments(read_bytes(file).decode("utf-8", errors="replace"))
    except (OSError, ValueError):
        return ""
    match = re.search(r"<name>\s*([^<]*?)\s*</name>", text)
    return match[1] if match else ""


def _ros_folders() -> list[Path]:
    """The folders in ROS_PACKAGE_PATH."""
    return [Path(part) for part in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if part]


def _ros_packages() -> PackageMap:
    """The packages in ROS_PACKAGE_PATH."""
    packages = PackageMap.MakeEmpty()
    if os.environ.get("ROS_PACKAGE_PATH"):
        packages.PopulateFromRosPackagePath()
    return packages
