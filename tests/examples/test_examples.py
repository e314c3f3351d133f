"""The examples run, keep their claims and leave their pictures."""

import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from numpy.testing import assert_allclose
from runs import some

pytestmark = pytest.mark.slow

EXAMPLES = Path(__file__).parents[2] / "examples"


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
    figures = runpy.run_path(str(EXAMPLES / f"{name}.py"))["main"](tmp_path)
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
def test_the_notebook_of_a_first_contact(capsys):
    found = runpy.run_path(str(EXAMPLES / "notebook_first_contact.py"))
    assert found["off"] < 1e-8
    assert "<title>A two-link arm on a wall</title>" in found["page"]
    assert found["page"]._repr_html_().startswith('<iframe srcdoc="&lt;!DOCTYPE html&gt;')
    assert "from 0 to 3 s" in repr(found["record"])
    assert "errors are off the predicted ones by" in capsys.readouterr().out


@pytest.mark.slow
def test_the_notebook_of_theory():
    """The hoop pulls the bead by its weight and more: m (g cos + v^2 / r)."""
    found = runpy.run_path(str(EXAMPLES / "notebook_theory.py"))
    assert found["hoop"] < 1e-9
    assert found["off"] < 1e-8
    x, z, vx, vz = found["record"]["state"].T
    # Along the hoop's inner normal (-x, -z): v g = -force, u pushes along x.
    pull = 9.81 * z - found["record"]["control"][:, 0] * x - vx**2 - vz**2
    assert_allclose(found["record"]["constraint_force"][:, 0], pull, atol=1e-7)
