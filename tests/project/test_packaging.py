"""A wheel built from the sdist is complete, and runs without the checkout."""

import os
import runpy
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]


def run(*command: str | Path, cwd: Path) -> str:
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    result = subprocess.run(
        command,
        cwd=cwd,
        env=environment | {"PYTHONNOUSERSITE": "1", "MPLBACKEND": "agg"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    assert result.returncode == 0, f"{' '.join(map(str, command))}\n{result.stdout}"
    return result.stdout


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with the sdist, and the wheel that `python -m build` makes of it."""
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, ROOT, cwd=folder)
    return folder


@pytest.fixture(scope="module")
def wheel(dist: Path) -> Path:
    (path,) = dist.glob("*.whl")
    return path


def test_sdist_holds_what_is_tracked_and_what_its_readers_are_sent_to(dist: Path) -> None:
    """The book, the tests and the Makefile work in it; the workplace of this checkout stays out."""
    (path,) = dist.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        names = {name.split("/", 1)[1] for name in archive.getnames()}
    expected = {
        Path(folder, file).relative_to(ROOT).as_posix()
        for top in ("drake_dae", "tests", "examples")
        for folder, _, files in os.walk(ROOT / top)
        for file in files
        if "__pycache__" not in folder and not file.startswith(".")
    }
    expected |= {one.name for one in ROOT.iterdir() if one.suffix in (".md", ".cff", ".toml")}
    assert names == expected | {".ci/readme.py", "LICENSE", "Makefile", "PKG-INFO", ".gitignore"}


def test_wheel_from_sdist_holds_every_file_of_the_package(wheel: Path) -> None:
    expected = {
        Path(folder, file).relative_to(ROOT).as_posix()
        for folder, _, files in os.walk(ROOT / "drake_dae")
        for file in files
        if Path(folder).name != "__pycache__" and not file.startswith(".")
    }
    # Each kind of file, and the folder that the link at the top leads to.
    diagrams = {name for name in expected if name.startswith("drake_dae/diagrams/")}
    assert {Path(name).suffix for name in diagrams} >= {".py", ".urdf", ".xml", ".yaml"}
    packed = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert packed == expected


def test_links_lead_to_an_address_where_one_is_given() -> None:
    readme = runpy.run_path(str(ROOT / ".ci" / "readme.py"))["readme"]
    text = "![seen](a/b.gif) [one](c.md) [two](https://d.org)"
    expected = "![seen](https://e.org/p/raw/v1.2/a/b.gif) [one](https://e.org/p/blob/v1.2/c.md)"
    assert readme(text, "https://e.org/p/", "1.2").startswith(f"{expected} [two](https://d.org)")
    assert readme(text).startswith("seen (`a/b.gif`) one (`c.md`) [two](https://d.org)")


def test_installed_wheel_simulates_a_shipped_scenario(wheel: Path, tmp_path: Path) -> None:
    venv.create(tmp_path / "venv", with_pip=False, symlinks=True)
    python = tmp_path / "venv" / "bin" / "python"
    install = ("-m", "pip", "--python", python, "install", "--no-deps", "--no-index", wheel)
    run(sys.executable, *install, cwd=tmp_path)
    # Third parties come from the running environment, as plain folders on the path: the .pth file
    # of an editable drake_dae in there is not read.
    (site_packages,) = (tmp_path / "venv").glob("lib/python*/site-packages")
    borrowed = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    (site_packages / "third_parties.pth").write_text("\n".join(borrowed) + "\n")
    location = run(python, "-c", "import drake_dae; print(drake_dae.__file__)", cwd=tmp_path)
    assert Path(location.strip()).is_relative_to(site_packages)

    command = (tmp_path / "venv" / "bin" / "drake-dae", "simulate", "two_link_wall")
    out = tmp_path / "run"
    run(*command, "--out", out, "--set", "duration=0.2", cwd=tmp_path)
    assert any(out.iterdir())
