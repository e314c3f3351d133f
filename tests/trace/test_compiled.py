"""Machine code: the same values as the interpreter, and what happens where there can be none."""

import os
import re
import shutil
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest

from drake_dae import DaeSystem
from drake_dae.errors import MachineCodeError, MachineCodeWarning, ModelError
from drake_dae.trace.compiled import attempts, find_compiler
from drake_dae.trace.functions import TracedFunction

needs_compiler = pytest.mark.skipif(
    not os.environ.get("CC") and shutil.which("cc") is None, reason="there is no C compiler"
)


def made(compiled, name="test", **options) -> TracedFunction:
    """A function with what may be not finite, and a matrix that may be singular."""
    x, p = ca.SX.sym("x", 3), ca.SX.sym("p", 2)
    outputs = {
        "y": ca.vertcat(ca.sqrt(x[0]), ca.sin(x[1]) / p[0], ca.fmin(x[2], p[1])),
        "z": ca.mtimes(x, p.T),
        "none": ca.SX(0, 1),
    }
    return TracedFunction(
        name, {"x": x, "p": p}, outputs, p[1] ** 2, "the square", compiled=compiled, **options
    )


X, P = np.array([1.0, 2.0, 3.0]), np.array([10.0, 20.0])


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache of a test's own."""
    folder = tmp_path / "kept" / "code"
    monkeypatch.setenv("DRAKE_DAE_CACHE", str(folder))
    return folder


def runs_interpreted(match: str) -> None:
    """A function warns, and has its values nevertheless."""
    function = made(True)
    with pytest.warns(MachineCodeWarning, match=match):
        values = function(X, P)
    assert not function.is_machine_code
    for one, two in zip(values, made(False)(X, P), strict=True):
        np.testing.assert_array_equal(one, two)
    function(X, P)  # Warnings are errors: it warns once.


@needs_compiler
@pytest.mark.parametrize(
    ("x", "p"),
    [(X, P), ([-1.0, 2.0, 3.0], P), (X, [10.0, 0.0]), ([1.0, 1e31, np.nan], [1.0, -np.inf])],
)
def test_values_that_are_not_finite_are_reported_alike(x, p, cache):
    code, interpreted = made(True), made(False)
    for one, two in zip(code(x, p), interpreted(x, p), strict=True):
        np.testing.assert_array_equal(one, two)
    assert code.is_machine_code
    assert not interpreted.is_machine_code
    for name in ("is_valid", "is_finite", "pivot"):
        np.testing.assert_equal(getattr(code, name), getattr(interpreted, name))
    assert code.failure() == interpreted.failure()


@needs_compiler
def test_the_choice(cache):
    for compiled in (True, False, "auto"):
        function = made(compiled)
        function.evaluate(X, P)
        assert function.is_machine_code == (compiled is True)
    assert not made(True, often=False).is_machine_code
    for bad in ("yes", 1, None):
        with pytest.raises(ModelError, match="compiled"):
            DaeSystem.from_functions(1, f=lambda x: -x, compiled=bad)


@pytest.mark.slow
@needs_compiler
def test_auto_compiles_what_was_called_so_often_that_it_pays(cache):
    function = made("auto")
    look, make = attempts("auto", function.num_operations)
    assert (look[1], make[1]) == (False, True)
    for _ in range(look[0] + make[0] - 1):
        function.evaluate(X, P)
    assert not function.is_machine_code
    function.evaluate(X, P)
    assert function.is_machine_code
    np.testing.assert_array_equal(function(X, P)[0], made(False)(X, P)[0])


def script(path, text: str) -> str:
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o700)
    return str(path)


def test_where_no_compiler_works(cache, monkeypatch, tmp_path):
    monkeypatch.setenv("CC", "/nowhere/cc")
    runs_interpreted("/nowhere/cc")
    monkeypatch.setenv("CC", "'")
    runs_interpreted("CC")
    monkeypatch.setenv("CC", script(tmp_path / "cc1", "echo 'error: out of order' >&2; exit 3"))
    runs_interpreted("cc1.*3")
    monkeypatch.setenv("CC", script(tmp_path / "cc2", "exit 0"))
    runs_interpreted("cc2")
    monkeypatch.setenv("CC", str(tmp_path))
    runs_interpreted(re.escape(str(tmp_path)))
    monkeypatch.delenv("CC")
    monkeypatch.setenv("PATH", "/nowhere")
    monkeypatch.setattr("drake_dae.trace.compiled.find_spec", lambda name: None)
    runs_interpreted("'cc'")
    assert not list(cache.glob("*"))


@pytest.mark.slow
def test_a_compiler_that_hangs_is_waited_for_once(cache, monkeypatch, tmp_path):
    """Whether it hangs when it is asked for its version or when it compiles; no clock is read.

    It ends with its child, which would hold its output open.
    """
    asked, module = tmp_path / "asked", "drake_dae.trace.compiled"
    hangs = f'echo "$@" >> {asked}; sleep 60; exit 1'
    only_version = f'case "$*" in *--version*|*-dM*) exit 0;; esac; {hangs}'
    monkeypatch.setattr(f"{module}._HANGING", {})
    # Long enough for a process to start; what it waits for never comes.
    monkeypatch.setattr(f"{module}.PATIENCE", 1.0)
    for name, does in (("cc1", hangs), ("cc2", only_version)):
        asked.write_text("")
        monkeypatch.setenv("CC", script(tmp_path / name, does))
        runs_interpreted(name)
        before = asked.read_text()
        runs_interpreted(name)
        assert asked.read_text() == before
        with pytest.raises(MachineCodeError, match=name):
            find_compiler()


@needs_compiler
def test_a_cache_that_others_can_write(cache, monkeypatch):
    made(True)(X, P)
    for mode in (0o777, 0o720):
        cache.chmod(mode)
        runs_interpreted(f"{mode:04o}.*{cache}")
    cache.chmod(0o700)
    monkeypatch.setattr(os, "getuid", lambda: 12345)
    runs_interpreted(re.escape(str(cache)))


PROCESS = """
import numpy as np, casadi as ca, sys
from drake_dae.trace.functions import TracedFunction
x = ca.SX.sym("x", 20)
f = TracedFunction("f", {"x": x}, {"y": ca.mtimes(x, ca.sin(x).T)}, compiled=True)
print(f(np.arange(20.0))[0].sum(), f.is_machine_code)
"""


@pytest.mark.slow
@needs_compiler
def test_processes_share_the_cache_and_code_is_kept_for_each_compiler(cache, monkeypatch):
    command = [sys.executable, "-W", "error", "-c", PROCESS]
    running = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    printed = [process.communicate(timeout=600)[0] for process in running]
    assert len(set(printed)) == 1
    assert printed[0].split()[1] == "True"
    assert cache.stat().st_mode & 0o777 == 0o700
    (file,) = cache.iterdir()
    assert file.suffix == ".so"
    assert file.stat().st_mode & 0o777 == 0o700
    monkeypatch.setenv("CC", f"{' '.join(find_compiler().command)} -g")
    assert subprocess.run(command, capture_output=True, text=True).stdout == printed[0]
    assert len(list(cache.iterdir())) == 2
