"""Reading and writing of scenario files, with changes at dotted keys."""

import pickle
import re
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from drake_dae import references
from drake_dae.arguments import checked
from drake_dae.errors import ScenarioError
from drake_dae.files import read_text
from drake_dae.scenario.forms.typed_yaml import (
    MOST_TEXT,
    TAG,
    dump_yaml,
    load_yaml,
    put_entry,
    set_entry,
)
from drake_dae.scenario.scenario import Scenario, scenario_reader
from drake_dae.scenario.shipped import shipped_scenarios
from drake_dae.systems.task import phases


def varied_data(data: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """A scenario's plain data with other values at dotted keys; parts without changes are shared.

    Raises:
        ScenarioError: There is no such place.
    """
    varied = dict(data)
    for part in {key.partition(".")[0] for key in changes} & varied.keys():
        varied[part] = pickle.loads(pickle.dumps(varied[part]))  # Thrice as fast as deepcopy.
    for key, value in changes.items():
        put_entry(varied, key, value, scenario_reader().free_names)
    return varied


@checked(lambda text: ScenarioError(("", text)))
def load_scenario(path: str | Path, settings: Sequence[str] = ()) -> Scenario:
    """Reads a scenario file.

    Args:
        path: The file, or the name of a shipped scenario such as "two_link_wall".
        settings: Changes "key=value" with dotted keys, for example "integrator.accuracy=1e-8" or
            "constraints.0.surface.point=[0.7, 0, 0]". Relative file names are in the folder of the
            scenario; for a shipped one, which names no such files, in the working directory.

    Raises:
        ScenarioError: There is no such file, its YAML is broken, or keys are unknown, missing or
            given twice, or values are not valid; all problems are listed.
    """
    path = shipped_scenarios().get(str(path), Path(path))
    try:
        text = read_text(path, 4 * MOST_TEXT)
    except UnicodeDecodeError:
        raise ScenarioError((str(path), "the file is not UTF-8 text; save it as such")) from None
    except (OSError, ValueError) as error:  # A null byte in the path.
        raise ScenarioError((str(path), getattr(error, "strerror", None) or str(error))) from None
    _check_no_robot(path, text)
    data = load_yaml(text, str(path))
    data = {} if data is None else data
    if isinstance(data, dict):
        # Drake's convention: keys with an underscore are a place for anchors.
        data = {key: data[key] for key in data if key == TAG or not key.startswith("_")}
    for setting in settings:
        set_entry(data, setting, scenario_reader().free_names)
    is_shipped = path in shipped_scenarios().values()
    try:
        folder = Path().absolute() if is_shipped else path.absolute().parent
    except OSError as error:
        raise ScenarioError(("", f"the working directory is gone: {error}")) from None
    scenario = scenario_reader().read(data, folder)
    # Absolute, so that the scenario as run can be written anywhere.
    robot = scenario.robot
    file = robot.file
    try:
        here = folder.resolve()
        if file and not file.startswith("package://"):
            file = str((here / file).resolve())
        packages = {name: str((here / folder).resolve()) for name, folder in robot.packages.items()}
    except (OSError, RuntimeError, ValueError) as error:
        # A link that leads to itself; a null byte.
        raise ScenarioError(("robot", f"no path: {error}")) from None

    def located(value: Any) -> Any:
        """A value with absolute file names in its references."""
        if isinstance(value, Mapping):
            return {name: located(inner) for name, inner in value.items()}
        if isinstance(value, list):
            return [*map(located, value)]
        if isinstance(value, phases.Phase):
            return replace(
                value, **{f.name: located(getattr(value, f.name)) for f in fields(value)}
            )
        return value.in_folder(here) if isinstance(value, references.Reference) else value

    task = scenario.task
    return replace(
        scenario,
        robot=replace(robot, file=file, packages=packages),
        references=located(scenario.references),
        exogenous=located(scenario.exogenous),
        task=None if task is None else replace(task, phases=located([*task.phases])),
    )


_ROBOT = re.compile(r"<(?:robot|sdf|mujoco)\b|^directives\s*:", re.MULTILINE)


def _check_no_robot(path: Path, text: str) -> None:
    """Checks that a text is not a robot's file; the error says how to make a scenario of it."""
    is_markup = text.lstrip().startswith("<")
    match = _ROBOT.search(text) if is_markup or "directives" in text else None
    if match is None or is_markup == match[0].startswith("directives"):
        return
    problem = (
        f"this is a robot, not a scenario; `drake-dae new {path}` writes a scenario with it, and "
        "in one of your own it is robot.file"
    )
    raise ScenarioError((str(path), problem))


def save_scenario(scenario: Scenario, path: str | Path, comment: str = "") -> None:
    """Writes a scenario file that `load_scenario` reads back equal.

    Args:
        scenario: The scenario.
        path: The file to write.
        comment: A first line, with its "#"; empty for none.
    """
    head = f"{comment}\n" if comment else ""
    Path(path).write_text(head + dump_yaml(scenario_reader().write(scenario)), encoding="utf-8")
