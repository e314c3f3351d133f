"""Scenario files: read with changes at dotted keys, and written."""

import pickle
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from drake_dae.arguments import checked
from drake_dae.errors import ScenarioError
from drake_dae.files import read_text
from drake_dae.scenario.forms.typed_yaml import MOST_TEXT, TAG, dump_yaml, load_lines, load_yaml
from drake_dae.scenario.scenario import Scenario, scenario_reader
from drake_dae.scenario.shipped import shipped_scenarios


def varied_data(data: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """A scenario's plain data with other values at dotted keys; parts without changes are shared.

    Raises:
        ScenarioError: There is no such place.
    """
    varied = dict(data)
    for part in {key.partition(".")[0] for key in changes} & varied.keys():
        varied[part] = pickle.loads(pickle.dumps(varied[part]))  # Thrice as fast as deepcopy.
    for key, value in changes.items():
        scenario_reader().put(varied, key, value)
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
            given twice, or values are not valid; all problems are listed, with their lines.
    """
    shipped = shipped_scenarios()
    path = shipped.get(str(path), Path(path))
    try:
        text = read_text(path, 4 * MOST_TEXT)
    except UnicodeDecodeError:
        raise ScenarioError((str(path), "the file is not UTF-8 text; save it as such")) from None
    except (OSError, ValueError) as error:  # A null byte in the path.
        raise ScenarioError((str(path), getattr(error, "strerror", None) or str(error))) from None
    _check_no_robot(path, text)
    data, line_of = load_lines(text, str(path))
    data = {} if data is None else data
    if isinstance(data, dict):
        # Drake's convention: keys with an underscore are a place for anchors.
        data = {key: data[key] for key in data if key == TAG or not key.startswith("_")}
    changed = []
    for setting in settings:
        key, separator, value = setting.partition("=")
        if not separator or not all(key.split(".")):
            raise ScenarioError((f"--set {setting}", "expected key=value, for example duration=5"))
        scenario_reader().put(data, key, load_yaml(value, key))
        changed.append(key)
    try:
        folder = Path().absolute() if path in shipped.values() else path.absolute().parent
    except OSError as error:
        raise ScenarioError(("", f"the working directory is gone: {error}")) from None

    def place_of(key: str) -> str:
        """Where a key stands in the file; empty if it is one of the settings."""
        is_set = any(f"{key}.".startswith(f"{other}.") for other in changed)
        line = None if is_set else line_of(key)
        return "" if line is None else f"[{path.name}:{line}]"

    return scenario_reader().read(data, folder, place_of)


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
    """Writes a scenario file that `load_scenario` reads back equal: what differs from defaults.

    Args:
        scenario: The scenario.
        path: The file to write.
        comment: A first line, with its "#"; empty for none.
    """
    head = f"{comment}\n" if comment else ""
    Path(path).write_text(head + dump_yaml(scenario_reader().write(scenario)), encoding="utf-8")
