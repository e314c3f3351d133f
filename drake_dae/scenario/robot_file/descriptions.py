"""Robots of the package robot_descriptions, by their names."""

from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from drake_dae.arrays import brief
from drake_dae.errors import ModelError


class Description(NamedTuple):
    """A robot of robot_descriptions.

    Attributes:
        file: Its URDF or MJCF file.
        folders: Folders that contain its packages, under their names.
    """

    file: Path
    folders: tuple[Path, ...]


def find_description(name: str) -> Description:
    """Finds the robot with a name such as "panda_description"; clones it if necessary.

    Raises:
        ModelError: There is no such robot, it cannot be cloned, or robot_descriptions is not
            installed.
    """
    try:
        names = import_module("robot_descriptions").DESCRIPTIONS
    except ImportError:
        raise ModelError(
            "this takes the package robot_descriptions; pip install 'drake_dae[descriptions]', or "
            "name a file of your own as robot.file"
        ) from None
    if name not in names:
        near = get_close_matches(name, names, n=1)
        hint = f"did you mean '{near[0]}'? " if near else ""
        raise ModelError(
            f"robot_descriptions has no '{name}'; {hint}python -m robot_descriptions list names all"
        )
    try:
        module = import_module(f"robot_descriptions.{name}")
    except Exception as error:  # Of git, of the network, of the disk.
        raise ModelError(
            f"'{name}' cannot be fetched: {brief(str(error))}. It is cloned when it is first used; "
            "without a network clone it elsewhere, and let ROBOT_DESCRIPTIONS_CACHE name the "
            "folder, or name the robot's own file as robot.file"
        ) from None
    file = getattr(module, "URDF_PATH", None) or getattr(module, "MJCF_PATH", None)
    if file is None:
        raise ModelError(
            f"'{name}' comes as neither URDF nor MJCF; make a URDF of it, as xacro does, and name "
            "it as robot.file"
        )
    return Description(Path(file), _folders(module, Path(file)))


def _folders(module: Any, file: Path) -> tuple[Path, ...]:
    """The folders in which the loaders of robot_descriptions look for packages."""
    package, repository = (
        Path(getattr(module, key, file.parent)) for key in ("PACKAGE_PATH", "REPOSITORY_PATH")
    )
    folders = (package, repository, package.parent, repository.parent, file.parent)
    return tuple(dict.fromkeys(folders))
