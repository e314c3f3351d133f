"""The notebooks, which are kept as scripts with cells, run and show what they promise."""

import re
import runpy
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
NOTEBOOKS = sorted(EXAMPLES.glob("notebook_*.py"))


@pytest.mark.slow
def test_first_contact(capsys):
    found = runpy.run_path(str(EXAMPLES / "notebook_first_contact.py"))
    assert found["off"] < 1e-8
    page = found["page"]
    assert "<title>A two-link arm on a wall</title>" in page
    shown = page._repr_html_()
    assert shown.startswith('<iframe srcdoc="&lt;!DOCTYPE html&gt;')
    assert "from 0 to 3 s" in repr(found["record"])
    assert "errors are off the predicted ones by" in capsys.readouterr().out


@pytest.mark.slow
def test_theory(capsys):
    """The hoop pulls the bead by its weight and more: m (g cos + v^2 / r)."""
    found = runpy.run_path(str(EXAMPLES / "notebook_theory.py"))
    assert found["hoop"] < 1e-9
    assert found["off"] < 1e-8
    x, z, vx, vz = found["record"]["state"].T
    # Along the hoop's inner normal (-x, -z): v g = -force, u pushes along x.
    control = found["record"]["control"][:, 0]
    pull = 9.81 * z - control * x - vx**2 - vz**2
    np.testing.assert_allclose(found["record"]["constraint_force"][:, 0], pull, atol=1e-7)
    assert "the hoop pulls with up to" in capsys.readouterr().out


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_says_what_it_is_and_has_cells(path):
    text = path.read_text(encoding="utf-8")
    assert re.match(r"# # .*\n#\n# A notebook that is kept as a script: VS Code", text)
    assert len(re.findall(r"^# %% .{10,}", text, flags=re.MULTILINE)) > 5
