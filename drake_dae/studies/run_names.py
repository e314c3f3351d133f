"""The names of the runs of a study, and the commands that repeat them."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from drake_dae.scenario.forms.typed_yaml import dump_yaml
from drake_dae.studies.variations import Variation


def run_name(changes: Variation) -> str:
    """Returns a name of a run from its values: "link1.mass=9.6, tool.z=0.05".

    A key is shortened to its last two parts, or more if needed to distinguish it from other keys.
    """
    parts = {key: key.split(".") for key in changes}

    def short(key: str) -> str:
        for count in range(2, len(parts[key]) + 1):
            tail = parts[key][-count:]
            if not any(other[-count:] == tail for name, other in parts.items() if name != key):
                return ".".join(tail)
        return key

    return ", ".join(f"{short(key)}={_in_brief(value)}" for key, value in changes.items())


def _in_brief(value: Any) -> str:
    return f"{value:.5g}" if isinstance(value, float) else setting("", value)[1:]


def setting(key: str, value: Any) -> str:
    """Returns a change as "key=value", in the form that the command line accepts."""
    return f"{key}={dump_yaml({'v': value}, on_one_line=True).strip()[4:-1]}"


def rerun_commands(made: Sequence[str], variations: Sequence[Variation], folder: Path) -> list[str]:
    """For each run of a study the command that makes its record, plots and animation.

    Args:
        made: The words of the command that runs the scenario, without what varies.
        variations: What varies in each run.
        folder: The folder of the study, in which that of a run is made.
    """
    return [
        shlex.join(
            [
                *made,
                *(part for item in changes.items() for part in ("--set", setting(*item))),
                *("--set", "write.plots=true"),
                *("--out", str(folder / f"run{number}")),
            ]
        )
        for number, changes in enumerate(variations)
    ]
