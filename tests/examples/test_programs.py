"""Examples that are programs: a short piece of each."""

import importlib.util
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from drake_dae import load_scenario
from drake_dae.scenario.build import build_completed, for_rollout, roll_scenario
from drake_dae.scenario.shipped import find_scenario
from drake_dae.scenario.start import start_scenario

pytestmark = pytest.mark.slow


@contextmanager
def loaded(name):
    """The program of the folder `examples/name` as a module, with this name while it is loaded."""
    file = Path(__file__).parents[2] / "examples" / name / "__main__.py"
    spec = importlib.util.spec_from_file_location(name, file)
    sys.modules[name] = module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
        yield module
    finally:
        del sys.modules[name]


def test_a_row_of_unknown_friction_has_figures():
    """In 0.3 s the contact has begun: not the accuracy of the table, which `make` prints."""
    with loaded("unknown_friction") as example:
        row = example.figures(example.Condition("both", settings=example.FAINT, load=0.5), 0.3)
    assert 0.0 < row.position < 50.0
    assert 0.0 < row.force < 10.0
    assert 0.1 < row.roughness < 1.0
    assert 0.0 < row.friction < 1.0


@pytest.fixture
def example():
    with loaded("arms") as module:
        if not module.DATA.exists():
            pytest.skip("pip install example-robot-data")
        yield module


def found_off(chosen, loop, record, rows, at):
    """The distances of the estimated surface from the true one along the way of a tool, m.

    The estimate is that of the row `at`, and the way that of the rows `rows`.
    """
    dae = loop.controller.law.system
    distance = dae.trace("distance", {"value": dae.k})
    own, sought = chosen.plant.parameters, chosen.estimator.parameters
    places = {name: np.array(own[name]) for name in sought if name in own}
    truth = dae.with_values(places).parameter_values
    names = [signal.name.partition("[")[0] for signal in record.signals["identified"].signals]
    found = {n: record["identified"][at][[m == n for m in names]] for n in places}
    values = dae.with_values(found).parameter_values
    return np.array(
        [
            distance(x, values)[0].item() - distance(x, truth)[0].item()
            for x in record["state"][rows]
        ]
    )


def rolled(example, *settings):
    """The loop, the rollout and the changes of phase of a run."""
    file = find_scenario("polish_unknown_part")
    chosen, _ = for_rollout(load_scenario(file, [*example.settings(), *settings]))
    completed, loop = build_completed(chosen)
    found = roll_scenario(completed.scenario, loop, start_scenario(completed.scenario, loop))
    return loop, found, loop.changes(found.record)


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::drake_dae.errors.GeometryWarning")
def test_the_arm_finds_and_polishes_a_part_that_is_5_mm_and_5_degrees_off(example):
    """On springs, since a rollout has no hydroelastic contact.

    Within 0.1 mm under the tool at each time, and 0.1 mm rms along the whole way.
    """
    plant = "plant=!CompliantContact {friction: 0.3, radius: 0.01}"
    loop, found, changes = rolled(example, plant)
    assert found.failure is None
    assert changes[-1].phase == "done"
    record, times = found.record, {change.phase: change.time for change in changes}
    chosen = load_scenario(find_scenario("polish_unknown_part"), example.settings())
    polish = (record.time > times["polish"]) & (record.time < times["Release"])
    rows = np.flatnonzero(polish)[::50]
    errors = [found_off(chosen, loop, record, np.array([row]), row)[0] for row in rows]
    assert np.abs(found_off(chosen, loop, record, rows, 0)).max() > 5e-3
    assert np.abs(errors).max() < 1e-4
    way = [found_off(chosen, loop, record, rows, row) for row in rows]
    assert np.sqrt(np.mean(np.square(way))) < 1e-4
    names = [signal.name for signal in record.signals["tracking_error"].signals]
    late = record.time[polish] > times["polish"] + 1.0  # After the transition.
    force = record["tracking_error"][polish][late, names.index("part.force")]
    assert np.sqrt(np.mean(force**2)) < 0.05
