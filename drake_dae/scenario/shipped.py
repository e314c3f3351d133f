"""The files that come with drake_dae; they are found and listed without Drake."""

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from drake_dae import diagrams
from drake_dae.errors import ModelError, ScenarioError

FOLDER = Path(diagrams.__file__).resolve().parent
DEFAULT_SCENARIO = "seven_joint_wall"


def shipped_scenarios() -> dict[str, Path]:
    """Name -> file of the scenarios that come with drake_dae."""
    return {path.stem: path for path in sorted((FOLDER / "scenarios").glob("*.yaml"))}


def find_scenario(name: str) -> Path:
    """The file of a shipped scenario, or a path as it is."""
    shipped = shipped_scenarios()
    if name in shipped:
        return shipped[name]
    path = Path(name)
    with suppress(OSError, ValueError):  # Such as a null byte.
        if path.is_file():
            return path
    if path.name == name and not path.suffix:
        raise ScenarioError(("", _unknown("scenario", name, shipped)))
    raise ScenarioError((name, "there is no such file; `drake-dae list` names shipped scenarios"))


def shipped_model(name: str) -> Path:
    """A robot's file that comes with drake_dae, as "two_link_arm.urdf".

    Raises:
        ModelError: There is no such file.
    """
    files = sorted((FOLDER / "models").iterdir())
    shipped = {file.name: file for file in files if file.suffix in (".urdf", ".yaml")}
    if str(name) not in shipped:
        raise ModelError(_unknown("model", str(name), shipped))
    return shipped[str(name)]


def _unknown(kind: str, name: str, known: Iterable[str]) -> str:
    from drake_dae.arrays import unknown_name  # It loads NumPy, which takes as long as `list`.

    return unknown_name(kind, name, known)


def description(path: Path) -> str:
    """The description of a shipped scenario: its first line, in plain YAML."""
    with path.open(encoding="utf-8") as file:
        key, _, text = file.readline().partition(": ")
    assert key == "description", path
    return text.strip().strip("\"'")
