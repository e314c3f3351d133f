"""Draws the pictures of the demo: the robot in motion, its path, its errors. `make pictures`.

The motion is filmed in Chromium, from the animation that the run leaves.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

from drake_dae.cli import main as command

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
SCENARIO, SECONDS, FRAME = "seven_joint_wall", 6.25, 0.25
"""What is filmed, for how long, and the time between pictures, in s."""

WINDOW, SIZE, COLOURS = (720, 560), (540, 420), 128

LINES = ("#1a33cc", "#1a9933", "#d9261a", "#b01510")
"""The colours of paths, arrows and labels, which are thin."""

# Waits for the animation, and holds it at one moment.
HOLD = """<style>.dg { display: none }</style><script>
  (function wait() {
    if (!(viewer.animator.duration > 0)) { return setTimeout(wait, 20); }
    viewer.animator.pause();
    viewer.animator.seek(TIME);
    viewer.set_dirty();
  })();
</script></body>"""


def held(page: str, time: float) -> str:
    """The page of an animation that shows one moment, in s after its start."""
    head, _, tail = page.rpartition("</body>")
    return f"{head}{HOLD.replace('TIME', repr(time))}{tail}"


def find_browser() -> str:
    """The path of Chromium, or of what is one."""
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        sys.exit(f"no browser to film with; install one of {', '.join(BROWSERS)}")
    return found


def photograph(browser: str, page: Path, picture: Path, profile: Path) -> Image.Image:
    """What the browser shows of a page."""
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader"]
    flags += ["--no-first-run", "--disable-background-networking", "--hide-scrollbars"]
    flags += [f"--user-data-dir={profile}", f"--window-size={WINDOW[0]},{WINDOW[1]}"]
    flags += ["--virtual-time-budget=3000", f"--screenshot={picture}", page.as_uri()]
    subprocess.run([browser, *flags], check=True, capture_output=True, timeout=120)
    return Image.open(picture).convert("RGB").resize(SIZE, Image.Resampling.LANCZOS)


def film(browser: str, page: str, file: Path, place: Path) -> None:
    """An animated GIF of the page of an animation."""
    pictures = []
    for number in range(round(SECONDS / FRAME)):
        (place / "held.html").write_text(held(page, number * FRAME), encoding="utf-8")
        pictures.append(
            photograph(browser, place / "held.html", place / "held.png", place / "profile")
        )
    # One palette for all, or the background flickers; thin lines keep their colours.
    sample = pictures[-1].copy()
    for number, colour in enumerate(LINES):
        sample.paste(colour, (0, 40 * number, SIZE[0], 40 * (number + 1)))
    palette = sample.quantize(COLOURS)
    frames = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    frames[0].save(
        file, save_all=True, append_images=frames[1:], duration=int(1000 * FRAME), loop=0
    )


def main(folder: Path) -> None:
    """Runs the scenario, and leaves its pictures in the folder."""
    browser = find_browser()
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        if command(["simulate", SCENARIO, "--out", str(place / "run")]):
            sys.exit(1)
        for kind in ("errors", "path"):
            shutil.copy(place / "run" / f"{kind}.png", folder / f"{SCENARIO}_{kind}.png")
        page = (place / "run" / "animation.html").read_text(encoding="utf-8")
        film(browser, page, folder / f"{SCENARIO}.gif", place)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
    print(f"pictures of {SCENARIO} are in {sys.argv[1]}")
