"""Rollouts on a GPU: their source compiled for the processor, for a device, and refused."""

import shutil
import subprocess
import sys

import numpy as np
import pytest
from on_no_device import fake_cupy
from runs import scenario

from drake_dae import build_scenario, rollout, start_values
from drake_dae.errors import ModelError
from drake_dae.running.rollout.lanes.library import source
from drake_dae.running.rollout.program import program_of

FIXED = [
    "integrator.integration_scheme=runge_kutta3",
    "integrator.use_error_control=false",
    "integrator.max_step_size=0.01",
]


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
@pytest.mark.parametrize(
    ("settings", "seconds", "fails"),
    [
        (FIXED, 0.2, False),
        (["integrator.accuracy=1e-6", "integrator.max_step_size=0.01"], 0.2, False),
        ([*FIXED, "references.tool.z.amplitudes=[3.0]"], 0.6, True),
    ],
)
@pytest.mark.parametrize("compiled", [False, True])
def test_a_thread_makes_the_same_run(monkeypatch, settings, seconds, fails, compiled):
    """To 1e-13 of the largest value, as side by side; what fails goes on here, in its words."""
    monkeypatch.setitem(sys.modules, "cupy", fake_cupy())
    chosen = scenario("two_link_wall", *settings)
    loop, context = build_scenario(chosen)
    start, parameters = start_values(loop, context)
    manifold = loop.plant.structure.manifold
    starts = [manifold.settle(start + shift) for shift in np.linspace(-0.02, 0.02, 70)]
    given = loop, starts, parameters, np.linspace(0.0, seconds, 5)
    ours = rollout(*given, config=chosen.integrator, device="cuda", compiled=compiled)
    theirs = [
        rollout(loop, one, *given[2:], config=chosen.integrator, compiled=True)[0]
        for one in starts[::23]
    ]
    for one, other in zip(ours[::23], theirs, strict=True):
        assert one.steps == other.steps
        assert type(one.failure) is type(other.failure)
        assert (one.failure is not None) == fails
        for name, recorded in other.record.signals.items():
            if not fails:
                scale = max(1.0, np.abs(recorded.values).max())
                np.testing.assert_allclose(one.record[name], recorded.values, 0.0, 1e-13 * scale)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("nvcc") is None, reason="there is no compiler for GPUs")
@pytest.mark.parametrize(
    "settings",
    [[], pytest.param(["sampling={period: 0.002, delay: 0.001}"], marks=pytest.mark.slow)],
)
def test_the_source_is_cuda(tmp_path, settings):
    loop, _ = build_scenario(scenario("two_link_wall", *settings))
    file = tmp_path / "code.cu"
    file.write_text(source(program_of(loop)))
    command = ["nvcc", "-ptx", str(file), "-o", str(tmp_path / "code.ptx")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert ".entry run_on_device" in (tmp_path / "code.ptx").read_text()


def test_without_a_device_one_sentence_says_so(monkeypatch):
    chosen = scenario("two_link_wall", *FIXED)
    loop, context = build_scenario(chosen)
    given = loop, *start_values(loop, context), [0.0, 0.1]
    for module, told in ((None, "CuPy, which is not installed"), (fake_cupy(0), "CuPy finds none")):
        monkeypatch.setitem(sys.modules, "cupy", module)
        with pytest.raises(ModelError, match=f'device="cuda" needs .*{told}; .*leave out device'):
            rollout(*given, config=chosen.integrator, device="cuda")
    with pytest.raises(ModelError, match="device must be 'cpu' or 'cuda', got 'gpu'"):
        rollout(*given, config=chosen.integrator, device="gpu")


def test_a_diagram_that_changes_is_refused_on_a_device(monkeypatch):
    monkeypatch.setitem(sys.modules, "cupy", fake_cupy())
    chosen = scenario("two_link_wall", "plant=!Unilateral {}", *FIXED)
    loop, context = build_scenario(chosen)
    with pytest.raises(ModelError, match='does not run with device="cuda": a block in it changes'):
        rollout(loop, *start_values(loop, context), [0.0, 0.1], device="cuda")
