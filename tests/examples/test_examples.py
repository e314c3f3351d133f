"""The examples run, keep their claims and leave their pictures."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest
from runs import some

pytestmark = pytest.mark.slow

EXAMPLES = Path(__file__).parents[2] / "examples"


def load(name):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


CLAIMS = {
    "two_link_by_hand": (1e-12, 1e-11),
    "urdf_arm": (1e-6, 1e-9),
    "textbook_robot": (1e-11,),
    "actuation_comparison": (1e-7,),
    "flexible_joints": (1e-7,),
    "dc_motors": (1e-9, 1e-4),
    "hydraulic_servos": (1e-7,),
    "flexible_motors": (1e-5, 1e-6),
    "drake_tools": (1e-6, 1e-4),
    "section_two": (1e-12, 1e-9, 1e-10),
    "unicycle": (1e-12,),
    "quadruple_tank": (1e-12, 1e-12),
    "own_diagram": (1e-9,),
}


DEAR = ("actuation_comparison", "flexible_joints", "dc_motors", "flexible_motors", "section_two")
"""Their claims are those of tests of actuation and of section 2."""


def test_every_example_has_its_claim():
    stems = {path.stem for path in EXAMPLES.glob("*.py")}
    assert {stem for stem in stems if not stem.startswith("notebook_")} == set(CLAIMS)


@pytest.mark.slow
@pytest.mark.parametrize("name", some(CLAIMS, of=1, dear=DEAR))
def test_example(name, tmp_path, capsys):
    figures = load(name).main(tmp_path)
    figures = figures if isinstance(figures, tuple) else (figures,)
    for figure, claim in zip(figures, CLAIMS[name], strict=True):
        assert 0.0 <= figure < claim
    printed = capsys.readouterr().out
    assert len(re.findall(r"claim: ", printed)) == len(CLAIMS[name])
    assert (tmp_path / f"{name}.png").stat().st_size > 10_000


@pytest.mark.slow
def test_a_folder_that_is_not_there(tmp_path):
    command = [sys.executable, EXAMPLES / "textbook_robot.py", tmp_path / "none"]
    found = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert (found.returncode, found.stdout) == (1, "")
    assert re.fullmatch(r"no folder '.*none'; the picture goes into .*\n", found.stderr)


@pytest.mark.slow
@pytest.mark.thorough
def test_an_example_runs_by_itself(tmp_path):
    subprocess.run(
        [sys.executable, EXAMPLES / "textbook_robot.py", tmp_path], check=True, timeout=600
    )
    assert (tmp_path / "textbook_robot.png").exists()
