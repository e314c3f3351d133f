"""The table of `examples/between_contacts`: the plan of the DAE keeps its claims."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).parents[2] / "examples" / "between_contacts"

FILES = ("__main__", "collocation", "drake_plans", "crocoddyl_plan", "task")


@pytest.fixture
def example(monkeypatch):
    """The modules, which find each other as in `python examples/between_contacts`."""
    monkeypatch.syspath_prepend(FOLDER)
    spec = importlib.util.spec_from_file_location("between_contacts", FOLDER / "__main__.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module
    for name in FILES[1:]:
        sys.modules.pop(name, None)


@pytest.mark.slow
def test_the_plan_of_the_dae_keeps_its_claims(example, tmp_path, capsys):
    found = example.main(tmp_path, with_peers=False)
    assert found.between < 1e-6
    assert found.misses < 1e-5
    assert found.least > 4.9
    assert found.most < 50.1
    assert capsys.readouterr().out == (tmp_path / "between_contacts.md").read_text()


@pytest.mark.slow
@pytest.mark.thorough
def test_the_plans_of_drake_are_judged_alike(example, tmp_path):
    """With a force that is an input the tool leaves the wall between the samples, by 0.3 mm."""
    own = example.main(tmp_path)
    lines = (tmp_path / "between_contacts.md").read_text().splitlines()[2:]
    cells = {line.split("|")[1].split(",")[0:2][-1].strip(): line.split("|") for line in lines}
    eliminated, as_input = cells["force eliminated"], cells["force an input"]
    # All have the same optimum: the limits of the force act.
    assert float(eliminated[2]) == pytest.approx(own.cost, rel=1e-4)
    assert float(as_input[2]) < 0.995 * own.cost
    assert float(eliminated[4]) < 1e-6
    assert float(as_input[4]) > 1e-4


def test_points_and_weights_are_exact_for_polynomials(example):
    """Radau IIA of s points: quadrature to degree 2 s - 2, derivatives to degree s; to 1e-13."""
    points = np.array(example.collocation.ca.collocation_points(4, "radau"))
    slopes, weights = example.collocation.tables(points)
    for k in range(7):
        assert weights @ points**k == pytest.approx(1.0 / (k + 1), abs=1e-13)
    for k in range(1, 5):
        values = np.append(0.0, points) ** k
        np.testing.assert_allclose(values @ slopes, k * points ** (k - 1), atol=1e-12)
