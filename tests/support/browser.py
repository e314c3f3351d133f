"""Pages in a headless Chromium: a script runs in a page, and what it finds comes back."""

import json
import re
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from html import unescape
from pathlib import Path

import pytest

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), ""
)

needs_chromium = pytest.mark.skipif(not CHROMIUM, reason="needs Chromium: apt install chromium")

OPTIONS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)

# How long a page has, in ms of its own time, which passes as fast as it computes.
BUDGET = "--virtual-time-budget=60000"

# What scripts of tests call. Balls and links are taken with pointer events, as a hand does.
HELPERS = """
const sleep = (ms) => new Promise((done) => setTimeout(done, ms));
const slider = (label) => document.querySelector(`input[data-control="${label}"]`);
function slide(label, value) {
  slider(label).value = value;
  slider(label).dispatchEvent(new Event("input"));
}
function point(kind, [clientX, clientY]) {
  const canvas = viewer.renderer.domElement;
  const told = { clientX, clientY, pointerId: 1, bubbles: true, cancelable: true };
  canvas.dispatchEvent(new PointerEvent(kind, told));
}
const now = () => bench.samples.at(-1);
// The clock of a page stands still; time passes by these steps alone.
async function run(seconds) {
  for (let ticks = Math.round(seconds / bench.data.tick); ticks > 0; ticks -= 30) {
    await bench.advance(Math.min(ticks, 30));
  }
  if (bench.failure) throw new Error(bench.failure);
  bench.draw();
}
const place = (ball) => bench.view.on_screen(ball.position);
const besides = ([x, y], dx, dy) => [x + dx, y + dy];
"""

LOW_CONTRAST = Path(__file__).with_name("low_contrast.js").read_text("utf-8")

_RESULT = re.compile(r'<pre id="result"[^>]*>(.*?)</pre>', re.DOTALL)


def with_script(page: str, body: str) -> str:
    """The text of a page of a bench with the body of an async function, which has `HELPERS`."""
    script = (
        f'<script type="module">{HELPERS}\n'
        "const shown = document.createElement('pre');\nshown.id = 'result';\n"
        "shown.style.display = 'none';\n"
        "async function main() {\n"
        "  while (!window.bench?.isReady) await sleep(20);\n"
        "  bench.isRunning = false;\n  await sleep(100);\n"
        f"{body}\n}}\n"
        "main().catch((error) => ({ failed: String(error.stack) })).then((found) => {\n"
        "  shown.textContent = JSON.stringify(found);\n  document.body.append(shown);\n});\n"
        "</script>"
    )
    before, mark, after = page.rpartition("</body>")
    return before + script + mark + after


def dumped(address: str, *flags: str) -> str:
    """The text of a page when its virtual time is over, in a profile of its own."""
    with tempfile.TemporaryDirectory() as profile:
        command = [CHROMIUM, *OPTIONS, f"--user-data-dir={profile}", *flags, "--dump-dom", address]
        done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert done.stdout, f"the page has no text: {done.stderr[-2000:]}"
    return done.stdout


def in_page(page: str, body: str, file: Path, width: int = 1000, height: int = 700):
    """What a script, as of `with_script`, returns in a page that is written to a file."""
    file.write_text(with_script(page, body), encoding="utf-8")
    found = _RESULT.search(dumped(file.as_uri(), f"--window-size={width},{height}", BUDGET))
    assert found, "the page has no result"
    result = json.loads(unescape(found[1]))
    assert not (isinstance(result, dict) and "failed" in result), result
    return result


def low_contrast(page: Path) -> dict[str, float]:
    """Texts with a contrast that is too low, light or dark; a page of some length is asserted."""
    low: dict[str, float] = {}
    for flags in ((), ("--blink-settings=preferredColorScheme=0",)):
        has_text, found = json.loads(unescape(shown(page, LOW_CONTRAST, flags=flags)))
        assert has_text
        low |= found
    return low


def shown(
    page: Path,
    script: str = "",
    fragment: str = "",
    size: str = "900,700",
    flags: Sequence[str] = (),
) -> str:
    """The last text that a script returns which is called again and again.

    Args:
        page: The page's file; a copy with the script is made beside it.
        script: The body of a function in JavaScript that returns a text.
        fragment: The end of the address, "#t=1".
        size: The window's width and height in pixels.
        flags: Further options of Chromium.
    """
    told = (
        '<pre id="told"></pre><script>{ const tell = () => { try {'
        f"document.getElementById('told').textContent = (() => {{ {script} }})();"
        "} catch (error) { document.getElementById('told').textContent = 'error: ' + error; }"
        "}; tell(); setInterval(tell, 200); }</script>"
    )
    text = page.read_text("utf-8")
    head, end, tail = text.rpartition("</body>")
    copy = page.with_name(f"told-{page.name}")
    copy.write_text(f"{head}{told}{end}{tail}", "utf-8")
    text = dumped(
        copy.as_uri() + fragment, *flags, f"--window-size={size}", "--virtual-time-budget=8000"
    )
    (found,) = re.findall(r'<pre id="told">(.*?)</pre>', text, re.DOTALL)
    return found
