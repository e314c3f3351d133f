"""The benchmark that runs on another machine, with a GPU: here, on a processor as a device."""

import importlib.util
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from on_no_device import fake_cupy

FOLDER = Path(__file__).parents[2] / "benchmarks" / "gpu"


def loaded(name):
    """A file of the benchmark, which is no package."""
    spec = importlib.util.spec_from_file_location(f"gpu_{name}", FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("gcc") is None, reason="there is no gcc")
@pytest.mark.parametrize("name", ["link", pytest.param("sampled", marks=pytest.mark.thorough)])
def test_what_is_written_runs_elsewhere_and_is_compared(tmp_path, monkeypatch, name):
    """Differences by fused operations: 1e-13; a state that is not the expected one is found."""
    written, there = loaded("__main__"), loaded("there")
    monkeypatch.setattr(written, "CASES", {name: written.CASES[name]})
    monkeypatch.setattr(written, "DIFFERENT", 16)
    written.main(tmp_path)
    about = json.loads((tmp_path / name).with_suffix(".json").read_text())
    (tmp_path / name).with_suffix(".json").write_text(json.dumps({**about, "count": 40}))
    case = there.Case(tmp_path / name)
    speed, _, (difference, residual) = there.on_gpu(fake_cupy(), case, repeat=1)
    assert speed > 0.0
    assert difference < 1e-13
    assert residual < 1e-13
    assert there.on_processor(case, 1, seconds=0.0) > 0.0
    case.expected[3] += 1e-9
    rows = there.Case(tmp_path / name).expected
    assert case.check(rows, np.zeros(len(rows)))[0] > 1e-12
