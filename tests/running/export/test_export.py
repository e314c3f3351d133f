"""The law, the plant and the projection in C99, against Python."""

import ctypes
import re
import shutil
import subprocess

import numpy as np
import pytest
from runs import TASKS, each_scenario, scenario, some

from drake_dae import ClosedLoop, build_scenario
from drake_dae.cli import main
from drake_dae.errors import ModelError
from drake_dae.running import export_code

needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")

OPTIMIZED = {"two_link_wall", "two_link_motors", "seven_joint_wall"}
"""Others would take the compiler a minute together, and have the same values without."""


def compiled(folder, name, *options: str, flags: str = "-O1") -> str:
    """Compiles as strictly as can be, and links."""
    program = str(folder / "program")
    strict = ["-std=c99", "-Wall", "-Wextra", "-Wno-unused-parameter", "-Werror", "-pedantic"]
    sources = [str(folder / f"{name}.c"), *options, "-o", program, "-lm"]
    done = subprocess.run(
        ["cc", *strict, *flags.split(), *sources], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return program


def outcome(folder, name, flags: str = "-O1") -> "subprocess.CompletedProcess[str]":
    """What its own test program says."""
    program = compiled(folder, name, str(folder / f"test_{name}.c"), flags=flags)
    return subprocess.run([program], capture_output=True, text=True, check=False)


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize(
    "name",
    some(
        each_scenario(lambda name: name in TASKS),
        dear=("wall_hydroelastic", "wall_flexible_contact", "cart_wall"),
    ),
)
def test_the_test_program_passes(name, tmp_path):
    """To 1e-12 of the largest value in each vector, as the program says itself."""
    loop, context = build_scenario(scenario(name))
    files = export_code(loop, context, name, tmp_path)
    assert [path.name for path in files] == [
        f"{name}.h",
        f"{name}.c",
        f"test_{name}.c",
        "Makefile",
        "LICENSE.txt",
    ]
    done = outcome(tmp_path, name, "-O1" if name in OPTIMIZED else "-O0")
    assert done.returncode == 0, done.stdout
    count, off = re.fullmatch(r"passed: (\d+) samples, at most (\S+) off\n", done.stdout).groups()
    # Of the law, the plant, the residual and the projection, at ten states.
    assert int(count) >= 30
    assert float(off) <= 1e-12


@pytest.fixture(scope="module")
def two_link(tmp_path_factory):
    loop, context = build_scenario(scenario("two_link_measured_force"))
    folder = tmp_path_factory.mktemp("export")
    export_code(loop, context, "arm", folder)
    return loop, folder


@pytest.mark.slow
@needs_compiler
def test_the_test_program_finds_what_is_wrong(two_link, tmp_path):
    _, folder = two_link
    for path in folder.iterdir():
        shutil.copy(path, tmp_path)
    source = (tmp_path / "arm.c").read_text()
    # The first product of the law, in the last digits.
    wrong = re.sub(r"=\((a\d+)\*(a\d+)\);", r"=(1.00000001*\1*\2);", source, count=1)
    assert wrong != source
    (tmp_path / "arm.c").write_text(wrong)
    done = outcome(tmp_path, "arm")
    assert done.returncode == 1
    assert re.search(r"control\[\d\] of sample 0 is .*, and Python has", done.stdout)
    assert "FAILED" in done.stdout
    (tmp_path / "arm.c").write_text(source)
    with pytest.raises(AssertionError, match="-ffast-math"):
        outcome(tmp_path, "arm", "-O1 -ffast-math")


@pytest.mark.slow
@needs_compiler
def test_make_runs_it(two_link):
    _, folder = two_link
    if shutil.which("make") is None:
        pytest.skip("there is no make")
    done = subprocess.run(
        ["make", "-s", "-C", str(folder)], capture_output=True, text=True, check=True
    )
    assert done.stdout.startswith("./test_arm\npassed: ")


class Library:
    """The functions of an export, on NumPy arrays."""

    def __init__(self, loop: ClosedLoop, folder) -> None:
        program = compiled(folder, "arm", flags="-O1 -shared -fPIC")
        self._library, self.loop = ctypes.CDLL(program), loop

    def call(self, name: str, *arrays: np.ndarray) -> int:
        pointers = [array.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for array in arrays]
        return getattr(self._library, f"arm_{name}")(*pointers)

    def words(self, name: str, size: int) -> list[str | None]:
        found = (ctypes.c_char_p * (size + 1)).in_dll(self._library, f"arm_{name}")
        return [None if word is None else word.decode() for word in found]

    def numbers(self, name: str, size: int) -> np.ndarray:
        return np.array((ctypes.c_double * size).in_dll(self._library, f"arm_{name}"))


@pytest.fixture(scope="module")
def library(two_link):
    if shutil.which("cc") is None:
        pytest.skip("there is no C compiler")
    return Library(*two_link)


def test_names_units_and_defaults(library):
    law = library.loop.controller.law
    for name, signals in {
        "state": law.system.state_signals,
        "reference": law.reference_signals,
        "measured_force": law.system.constraint_input_signals,
    }.items():
        assert library.words(f"{name}_names", len(signals)) == [*(s.name for s in signals), None]
        assert library.words(f"{name}_units", len(signals)) == [*(s.unit for s in signals), None]
    default = law.all_parameters()
    np.testing.assert_array_equal(library.numbers("default_law_parameters", default.size), default)


def test_the_plant_has_its_own_parameters(tmp_path):
    """What the scenario's plant has and the law's model does not."""
    chosen = scenario("two_link_wall", "plant.parameters={link1.mass: [13.5]}")
    export_code(*build_scenario(chosen), "arm", tmp_path)
    source = (tmp_path / "arm.c").read_text()
    assert "arm_default_parameters[] = {13.5, 6.0, " in source
    assert "arm_default_law_parameters[] = {12.0, 6.0, " in source


def test_the_law_at_other_states(library):
    law = library.loop.controller.law
    parameters, random = law.all_parameters(), np.random.default_rng(1)
    p = law.system.num_controls
    for state in law.structure.states:
        reference, force = random.normal(size=len(law.reference_signals)), random.normal(size=1)
        control, error = np.zeros(p), np.zeros(p)
        given = (state.copy(), reference, force, parameters)
        assert library.call("law", *given, control, error) == 0
        wanted = law.function(*given)
        for found, value in zip((control, error), wanted, strict=True):
            np.testing.assert_allclose(found, value, rtol=0, atol=1e-12 * np.abs(value).max())


def test_the_projection(library):
    """From near and far: where Python finds a state C finds the same, and else it says so."""
    plant = library.loop.plant
    manifold, parameters = plant.structure.manifold, plant.dae.parameter_values
    random, refused = np.random.default_rng(2), 0
    for distance in (0.0, 1e-9, 1e-3, 0.3, 3.0):
        for state in plant.structure.states:
            start = state + distance * random.normal(size=state.size)
            found = start.copy()
            result = library.call("project", found, parameters)
            if result:
                refused += 1
                np.testing.assert_array_equal(found, start)
                assert distance > 1.0
                continue
            wanted = manifold.project(start, parameters)
            np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-12)
    assert refused < 12
    # What is not finite is refused, and left as it is.
    for bad in (np.nan, np.inf):
        state = np.full(plant.dae.num_states, bad)
        assert library.call("project", state, parameters) in (1, 3)


def test_useless_values_are_reported(library):
    law = library.loop.controller.law
    state = law.structure.states[0].copy()
    results = [np.zeros(2), np.zeros(2)]
    reference, parameters = np.zeros(len(law.reference_signals)), law.all_parameters()
    state[0] = np.nan
    given = [state, reference, np.zeros(1), parameters]
    assert library.call("law", *given, *results) == 1
    # An arm that points straight at the wall can not press against it: B(x) is singular.
    state[:] = 0.0
    assert library.call("law", *given, *results) == 2
    law.function.evaluate(*given)
    assert not law.function.is_valid
    assert law.function.is_finite or law.function.pivot < 1e-12


@pytest.mark.parametrize(
    ("name", "file", "prefix"),
    [
        ("My arm", "My_arm", "my_arm"),
        ("7_dof", "7_dof", "dae_7_dof"),
        ("_a__b", "_a__b", "a_b"),
        ("a.b-c", "a.b-c", "a_b_c"),
    ],
)
def test_names_become_names_of_c(name, file, prefix, tmp_path):
    loop, context = build_scenario(scenario("two_link_wall"))
    export_code(loop, context, name, tmp_path)
    assert f"int {prefix}_law(" in (tmp_path / f"{file}.h").read_text()
    for bad in ("", "...", "123"):
        with pytest.raises(ModelError, match=re.escape(repr(bad))):
            export_code(loop, context, bad, tmp_path)


def test_the_command(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["export", "two_link_wall"]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("written to two_link_wall_c99/: two_link_wall.h, two_link_wall.c")
    header = (tmp_path / "two_link_wall_c99" / "two_link_wall.h").read_text()
    assert re.search(r"^ +3  wall\.force  N \*/$", header, flags=re.MULTILINE)
    assert "enum { TWO_LINK_WALL_STATE_SIZE = 4 };" in header
    terms = (tmp_path / "two_link_wall_c99" / "LICENSE.txt").read_text()
    assert "CasADi" in terms
    assert "BSD 3-Clause" in terms
    # Only a law with samples has steps.
    told = printed.splitlines()[-1]
    assert told.startswith("not among them: the whole controller")
    (tmp_path / "file").touch()
    assert main(["export", "two_link_wall", "--out", "file"]) == 1
    assert "'file'" in capsys.readouterr().err
    # A Makefile of somebody else's remains, and no other file is written.
    code = tmp_path / "two_link_wall_c99"
    (code / "Makefile").write_text("all:")
    (code / "two_link_wall.h").unlink()
    assert main(["export", "two_link_wall"]) == 1
    assert "Makefile" in capsys.readouterr().err
    assert (code / "Makefile").read_text() == "all:"
    assert not (code / "two_link_wall.h").exists()
    assert main(["export", "two_link_wall", "--force"]) == 0
    assert (code / "Makefile").read_text() != "all:"


@pytest.mark.slow
@needs_compiler
def test_an_observer_is_among_what_holds_between_samples(tmp_path, capsys):
    """Law, limits and observer are in the update of the loop, so that nothing is left out."""
    words = ["estimator={rate: 20.0}", "sampling={period: 0.002}", "saturation=true"]
    words.append("sensors.force={sample_period: 0.002}")
    settings = [word for each in words for word in ("--set", each)]
    assert main(["export", "two_link_wall", *settings, "--out", str(tmp_path)]) == 0
    assert "not among them" not in capsys.readouterr().out
    assert "int two_link_wall_loop_update_0(" in (tmp_path / "two_link_wall.h").read_text()
    done = outcome(tmp_path, "two_link_wall", "-O0")
    assert done.returncode == 0, done.stdout
