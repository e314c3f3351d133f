"""Finds the files that a robot's files name, in packages as ROS finds them."""

import os
from importlib import import_module
from pathlib import Path
from urllib.parse import unquote

from pydrake.common import GetDrakePath
from pydrake.multibody.parsing import PackageMap

from drake_dae.arrays import brief, unknown_name
from drake_dae.errors import ModelError
from drake_dae.scenario.forms.keys import at
from drake_dae.scenario.robot_file.robot import Robot
from drake_dae.scenario.robot_file.xml_tree import read_xml
from drake_dae.scenario.shipped import FOLDER


class RobotFiles:
    """The file of a robot, and those that it names.

    A package is a folder above the file that names it, or a folder of its name in one of these,
    if it has a package.xml with the name; or it is in ROS_PACKAGE_PATH or AMENT_PREFIX_PATH.

    Attributes:
        main: The file.
        packages: The packages of Drake's parser.
        folders: The folders from which geometry is read: those of the model and its packages.
        missing: The packages that are not found.

    Args:
        robot: The key `robot` of the scenario.
        packages: The packages of Drake's parser; those that are found are added.

    Raises:
        ScenarioError, ModelError: There is no such file, robot or folder.
    """

    def __init__(self, robot: Robot, packages: PackageMap) -> None:
        self.missing: set[str] = set()
        self.packages = packages
        self._places = [
            *(Path(part) for part in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep)),
            *(Path(p, "share") for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)),
        ]
        packages.AddPackageXml(str(FOLDER / "models" / "package.xml"))
        for name, folder in robot.packages.items():
            with at(f"robot.packages.{name}"):
                try:
                    packages.Add(name, folder)
                except RuntimeError as error:
                    raise ModelError(f"no package in '{folder}': {error}") from None
        cache = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
        self.folders = [FOLDER / "models", *map(Path, robot.packages.values())]
        self.folders += [Path(GetDrakePath()), Path(cache) / "drake" / "package_map"]
        main = Path(robot.file)
        if robot.description:
            with at("robot.description"):
                main, described = described_robot(robot.description)
                self.folders += described[:2]
                self._places += described
        elif "://" in robot.file:
            main = self.needed(robot.file, Path())
        try:
            is_there = main.is_file()
        except (OSError, ValueError):  # A null byte.
            is_there = False
        if not is_there:
            raise ModelError(
                f"no file '{main}'; a relative path starts in the scenario's folder, that of a "
                "shipped scenario in the working directory"
            )
        own = main.resolve().parent
        inside = (path for path in (own, *own.parents) if (path / "package.xml").is_file())
        self.folders.append(next(inside, own))
        self.main = main

    def find(self, name: str, file: Path) -> Path | None:
        """The path of a URL or a name in a file; None if its package is unknown."""
        scheme, _, rest = name.rpartition("://")
        rest = rest.lstrip("/") if scheme in ("package", "model") else rest
        package = rest.split("/")[0]
        if not scheme:
            return file.resolve().parent / name
        if scheme == "file":
            return Path(unquote(rest))
        if scheme not in ("package", "model") or package in self.missing:
            return None
        if not self.packages.Contains(package):
            folder = self._folder_of(package, file)
            if folder is None:
                self.missing.add(package)
                return None
            self.packages.Add(package, str(folder))
            self.folders.append(folder)
        try:
            return Path(self.packages.ResolveUrl(f"package://{rest}"))
        except RuntimeError:
            return None

    def _folder_of(self, package: str, file: Path) -> Path | None:
        for above in file.resolve().parents if file.name else ():
            for folder in (above, above / package):
                if _package_name(folder) == package:
                    return folder
        ros = PackageMap.MakeEmpty()
        if os.environ.get("ROS_PACKAGE_PATH"):
            ros.PopulateFromRosPackagePath()
        if ros.Contains(package):
            return Path(ros.GetPath(package))
        inside = (place / package for place in self._places if str(place) != ".")
        return next((folder for folder in inside if folder.is_dir()), None)

    def needed(self, name: str, file: Path) -> Path:
        """The path of a URL or a name in a file."""
        path = self.find(name, file)
        if path is None:
            package = name.split("://")[-1].split("/")[0]
            raise ModelError(
                f"unknown package '{package}' in '{name}': it is neither beside the file, as a "
                "folder with a package.xml, nor in ROS_PACKAGE_PATH or AMENT_PREFIX_PATH; name its "
                f"folder under robot.packages, as packages: {{{package}: <folder>}}, so that "
                f"package://{package}/a is <folder>/a"
            )
        return path


def _package_name(folder: Path) -> str:
    """The name in a folder's package.xml; empty if there is none."""
    try:
        return (read_xml(folder / "package.xml").findtext("name") or "").strip()
    except ModelError:
        return ""


def described_robot(name: str) -> tuple[Path, list[Path]]:
    """The file of a robot of the package robot_descriptions, and folders that have its packages."""
    try:
        names = import_module("robot_descriptions").DESCRIPTIONS
    except ImportError:
        raise ModelError(
            "this takes the package robot_descriptions; pip install 'drake_dae[descriptions]', or "
            "name a file of your own as robot.file"
        ) from None
    if name not in names:
        raise ModelError(unknown_name("robot in robot_descriptions", name, names))
    try:
        module = import_module(f"robot_descriptions.{name}")
        file = Path(getattr(module, "URDF_PATH", None) or module.MJCF_PATH)
    except AttributeError:
        raise ModelError(
            f"'{name}' comes as neither URDF nor MJCF; name its URDF, which xacro makes, as "
            "robot.file"
        ) from None
    except Exception as error:  # Of git, of the network, of the disk.
        raise ModelError(
            f"'{name}' cannot be fetched: {brief(str(error))}. Clone it elsewhere, and let "
            "ROBOT_DESCRIPTIONS_CACHE name the folder, or name its file as robot.file"
        ) from None
    package, repository = (
        Path(getattr(module, key, file.parent)) for key in ("PACKAGE_PATH", "REPOSITORY_PATH")
    )
    return file, [package, repository, package.parent, repository.parent, file.parent]
