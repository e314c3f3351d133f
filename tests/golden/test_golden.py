"""No result changes unless it is meant to: records of runs, of theory and of advice.

Steps are fixed: with error control two correct versions differ by 1e-5. `recording.py` writes the
records anew; the commit that does so says why, and by how much they moved.
"""

import json
import shutil
from importlib.metadata import version

import numpy as np
import pytest
from c_loop import CLoop, code_of
from golden.cases import CASES, FIXTURE
from golden.recording import (
    SIGNALS,
    analysis_of,
    built,
    config_of,
    gains_found,
    rollout_of,
    run_of,
    times_of,
    values_at,
)
from runs import DEAR, some

KEPT = np.load(FIXTURE)

OTHER_DRAKE = str(KEPT["drake"]) != version("drake")

IDEAL, CONTACT = 1e-10, 1e-6
"""Of the largest value of each signal: round-off that some hundred steps amplify; and what the
iterations of Drake's contact solver leave."""


def params(names):
    return [pytest.param(name, marks=[pytest.mark.slow] * CASES[name].is_slow) for name in names]


def assert_near(found, wanted, tolerance):
    """Column by column; a column that is round-off is compared with the largest of all."""
    size = np.maximum(np.max(np.abs(wanted), axis=0), 1e-3 * np.max(np.abs(wanted)))
    off = np.max(np.abs(found - wanted) / size)
    assert off < tolerance, f"moved by {off:.2g}"


@pytest.mark.parametrize("name", params(CASES))
def test_theory_run_and_rollouts_are_as_recorded(name):
    """A, B, alpha, beta, law and residual at 20 consistent states; then all signals of a run."""
    case, wanted = CASES[name], KEPT[f"run/{name}"]
    loop, context = built(case)
    kept = {key.rsplit("/", 1)[1]: KEPT[key] for key in KEPT.files if key.startswith(f"at/{name}/")}
    for key, value in values_at(loop, kept["states"]).items() if kept else ():
        size = np.max(np.abs(kept[key]), initial=1e-300)
        np.testing.assert_allclose(value, kept[key], rtol=0, atol=1e-11 * size, err_msg=key)
    for compiled in (False, True) if case.rolls else ():
        if compiled and shutil.which("cc") is None:
            continue
        found = rollout_of(case, loop, context, compiled)
        assert_near(found, wanted, CONTACT if case.amplifies else 1e-9)
    if case.contact and OTHER_DRAKE:
        pytest.skip(f"recorded with Drake {KEPT['drake']}, whose contact solver makes the steps")
    loose = case.contact or case.amplifies
    assert_near(run_of(case, loop, context), wanted, CONTACT if loose else IDEAL)


@pytest.mark.parametrize("name", params(["two_link_wall", "seven_joint_wall"]))
def test_exported_c_is_as_recorded(name, tmp_path):
    """All signals of the loop in C, whose rows come after a projection, recorded ones before."""
    if shutil.which("cc") is None:
        pytest.skip("there is no C compiler")
    loop, context = built(CASES[name])
    c, found = CLoop(code_of(loop, context), tmp_path, config_of(CASES[name]), "-O1"), []
    for time in times_of(CASES[name])[::2]:
        assert c.advance(time) == 0
        found.append({signal: c.output(signal) for signal in SIGNALS})
    columns = np.vstack([np.hstack([row[signal] for signal in SIGNALS]) for row in found])
    assert_near(columns, KEPT[f"run/{name}"], 1e-9)  # As of rollouts.


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", some(sorted(n for n in CASES if f"analysis/{n}" in KEPT), of=8, dear=DEAR)
)
def test_the_analysis_is_as_recorded(name):
    wanted = dict(leaves(json.loads(str(KEPT[f"analysis/{name}"]))))
    found = dict(leaves(analysis_of(name)))
    assert found.keys() == wanted.keys()
    for key, value in wanted.items():
        if isinstance(value, float):  # Searched along paths, in steps.
            # Round-off of libraries and processors decides in which step the descent to the least
            # critical friction ends, within 1 %.
            descended = ".critical_friction." in key or ".contact_margin." in key
            rel = 1e-2 if descended else 1e-6
            assert found[key] == pytest.approx(value, rel=rel, abs=1e-9), key
        else:
            assert found[key] == value, key


@pytest.mark.slow
def test_computed_gains_are_as_recorded():
    wanted, found = json.loads(str(KEPT["gains"])), gains_found()
    assert found.keys() == wanted.keys()
    for key, values in wanted.items():
        np.testing.assert_allclose(found[key], values, rtol=1e-9, err_msg=key)


def leaves(value, path=""):
    """The entries of nested lists and dictionaries, by their path."""
    if isinstance(value, dict):
        for key, part in value.items():
            yield from leaves(part, f"{path}.{key}")
    elif isinstance(value, list):
        yield f"{path}.length", len(value)
        for index, part in enumerate(value):
            yield from leaves(part, f"{path}.{index}")
    else:
        yield path, value
