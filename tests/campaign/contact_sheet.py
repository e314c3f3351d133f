"""Every shipped scenario at three moments, as its page and as a film, on one picture to look at.

    python tests/campaign/contact_sheet.py [--out runs/sheet] [NAME...]

Each scenario is rolled out, its animation is opened in Chromium without a screen at a tenth, a half
and nine tenths of its time, and its film is drawn at four moments. The output ends with the names
of the pictures. A run or a page that fails is named, and the exit code is 1.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from matplotlib.figure import Figure
from PIL import Image

from drake_dae import Record
from drake_dae.scenario.shipped import shipped_scenarios

SHARES = (0.1, 0.5, 0.9)
SIZE = (640, 520)
WORDS = (
    "--headless --no-sandbox --disable-gpu --enable-unsafe-swiftshader --no-first-run "
    "--disable-background-networking --disable-component-update --disable-sync "
    "--virtual-time-budget=6000"
)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="scenarios or files; all shipped ones by default")
    parser.add_argument("--out", type=Path, default=Path("runs/sheet"))
    options = parser.parse_args()
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    if browser is None:
        print("error: no Chromium here; apt install chromium", file=sys.stderr)
        return 1
    failed, rows = [], []
    for name in options.names or shipped_scenarios():
        folder = options.out / Path(name).stem
        print(folder.name, flush=True)
        try:
            rows.append((folder.name, pictures_of(name, folder, browser)))
        except (subprocess.SubprocessError, OSError) as error:
            failed.append(f"{name}: {error}")
    for place in range(0, len(rows), 8):
        print(draw(rows[place : place + 8], options.out / f"sheet{place // 8 + 1}.png"))
    print(*failed, sep="\n", file=sys.stderr)
    return 1 if failed else 0


def pictures_of(name: str, folder: Path, browser: str) -> list[Path]:
    """Runs a scenario, and the pictures of three moments of its page and of its film."""
    shutil.rmtree(folder, ignore_errors=True)
    command = [sys.executable, "-m", "drake_dae"]
    run = [*command, "simulate", name, "--rollout", "--set", "write.plots=false"]
    subprocess.run([*run, "--out", folder], check=True, stdout=subprocess.DEVNULL)
    subprocess.run(
        [*command, "render", folder, "--out", folder / "strip.png"],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    times = Record.load(folder / "record.npz").time
    found = []
    for share in SHARES:
        moment = times[0] + share * (times[-1] - times[0])
        picture = folder / f"page{share:.0%}.png".replace("%", "")
        address = (folder / "animation.html").resolve().as_uri()
        with tempfile.TemporaryDirectory() as user:
            page = [browser, *WORDS.split(), f"--user-data-dir={user}"]
            page += [f"--window-size={SIZE[0]},{SIZE[1]}", f"--screenshot={picture.resolve()}"]
            subprocess.run(
                [*page, f"{address}#t={moment:.3f}"], check=True, timeout=120, capture_output=True
            )
        found.append(picture)
    return [*found, folder / "strip.png"]


def draw(rows: list[tuple[str, list[Path]]], path: Path) -> Path:
    """A row for each scenario: its page at the moments, and its film."""
    figure = Figure(figsize=(22.0, 3.0 * len(rows)), layout="constrained")
    grid = figure.subplots(len(rows), len(SHARES) + 1, squeeze=False, width_ratios=[1, 1, 1, 3.9])
    for axes, (name, files) in zip(grid, rows, strict=True):
        for axis, file in zip(axes, files, strict=True):
            with Image.open(file) as picture:
                axis.imshow(picture)
            axis.set_axis_off()
        axes[0].set_title(name, fontsize=10, loc="left")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
    return path


if __name__ == "__main__":
    sys.exit(main())
