"""Every shipped scenario as page and as live bench, at three moments, on one contact sheet.

It is to be looked at: `python tests/campaign/benches.py --out sheet` needs Chromium, and for pages
drake_dae[compiler]. What fails is printed, and the exit code is then 1.
"""

import argparse
import subprocess
import sys
import threading
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image, ImageDraw

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from browser import CHROMIUM, OPTIONS, with_script

from drake_dae import build_commanded, load_scenario, write_page
from drake_dae.errors import DrakeDaeError, ModelError
from drake_dae.running.bench.live import Server
from drake_dae.scenario.shipped import find_scenario, shipped_scenarios

MOMENTS = {
    "start": "await run(0.05);",
    "commanded": """
  await run(0.5);
  const names = bench.data.controls.map(({ label }) => label);
  bench.data.controls.forEach(({ kind, low, high }, i) => {
    if (kind === "reference") bench.panel.set(i, 0.3 * high);
    if (kind === "surface" && names[i].endsWith("[0]")) bench.panel.set(i, 0.3 * low);
  });
  await run(1.5);""",
    "pushed": """
  await run(1);
  const body = bench.data.bodies.findLast(({ name }) => name in bench.data.pushes);
  if (body) {
    const link = viewer.scene_tree.find(body.path).object;
    const at = viewer.scene.worldToLocal(link.getWorldPosition(new MeshCat.THREE.Vector3()));
    const pixel = bench.view.on_screen(at);
    point("pointerdown", pixel);
    point("pointermove", besides(pixel, 40, -40));
  }
  await run(0.15);""",
}
"""What is done before each picture."""

SHOWN = """
  bench.fresh = true;
  return { time: now().time, off: bench.off, failure: bench.failure };
"""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("sheet"), help="folder for the sheets")
    parser.add_argument("--only", nargs="*", default=list(shipped_scenarios()))
    parser.add_argument("--kind", choices=("page", "live", "both"), default="both")
    parser.add_argument(
        "--size", default="900x640", help="of the window in pixels; 390x780 is a phone"
    )
    options = parser.parse_args()
    size = tuple(map(int, options.size.split("x")))
    if not CHROMIUM:
        print("there is no Chromium")
        return 1
    options.out.mkdir(parents=True, exist_ok=True)
    failures = 0
    for kind in ("page", "live"):
        if options.kind in (kind, "both"):
            rows = [(name, *_pictures(kind, name, size)) for name in options.only]
            _sheet(rows, size, options.out / f"{kind}_{options.size}.png")
            failures += sum(bool(failed) for _, _, failed in rows)
    return int(failures > 0)


def _pictures(kind: str, name: str, size: tuple[int, ...]) -> tuple[list[Image.Image], str]:
    """The pictures of a scenario, and what failed."""
    print(kind, name, flush=True)
    scenario = load_scenario(find_scenario(name))
    try:
        built = build_commanded(scenario)
        with TemporaryDirectory() as folder:
            if kind == "live":
                return _live(built, scenario, name, Path(folder), size), ""
            file = Path(folder) / "page.html"
            try:
                write_page(built.loop, built.context, file, None, name)
            except ModelError as error:
                print(f"  refused: {error}", flush=True)
                return [], ""
            text, found = file.read_text(), []
            for body in MOMENTS.values():
                file.write_text(with_script(text, body + SHOWN))
                found.append(_picture(file.as_uri(), Path(folder), size))
            return found, ""
    except (DrakeDaeError, RuntimeError) as error:
        print(f"  {error}", flush=True)
        return [], str(error)


def _live(built, scenario, name: str, folder: Path, size: tuple[int, ...]) -> list[Image.Image]:
    found = []
    with Server(built.loop, built.context, scenario.integrator, name) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        text = server.page
        try:
            for body in MOMENTS.values():
                server.page = with_script(text, body + SHOWN)
                found.append(_picture(server.address, folder, size))
        finally:
            server.shutdown()
            thread.join()
    return found


def _picture(address: str, folder: Path, size: tuple[int, ...]) -> Image.Image:
    shot = folder / "shot.png"
    more = f"--window-size={size[0]},{size[1]}", f"--user-data-dir={folder / 'profile'}"
    command = [CHROMIUM, *OPTIONS, *more, "--hide-scrollbars", "--virtual-time-budget=8000"]
    command += [f"--screenshot={shot}", address]
    subprocess.run(command, capture_output=True, check=True, timeout=300)
    with Image.open(shot) as image:
        return image.convert("RGB")


def _sheet(
    rows: list[tuple[str, list[Image.Image], str]], size: tuple[int, ...], file: Path
) -> None:
    """Writes the pictures of all scenarios, a row for each."""
    width, height = size[0] // 2, size[1] // 2
    sheet = Image.new("RGB", (width * len(MOMENTS), (height + 16) * len(rows)), "white")
    pen = ImageDraw.Draw(sheet)
    for row, (name, pictures, failed) in enumerate(rows):
        top = row * (height + 16)
        pen.text(
            (4, top + 2), f"{name}: {failed or 'refused' if not pictures else ''}"[:200], "black"
        )
        for column, picture in enumerate(pictures):
            sheet.paste(picture.resize((width, height)), (column * width, top + 16))
    sheet.save(file)
    print(f"written: {file}")


if __name__ == "__main__":
    sys.exit(main())
