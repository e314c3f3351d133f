"""Pages in a browser without a screen: what stands in them when they are shown."""

import re
import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)

needs_browser = pytest.mark.skipif(BROWSER is None, reason="needs Chromium: apt install chromium")

_WORDS = (
    "--headless --no-sandbox --disable-gpu --enable-unsafe-swiftshader --no-first-run "
    "--disable-background-networking --disable-component-update --disable-sync"
)


def shown(page: Path, script: str = "", fragment: str = "", size: str = "900,700") -> str:
    """The last text that a script returns which is called again and again.

    Args:
        page: The page's file; a copy with the script is made beside it.
        script: The body of a function in JavaScript that returns a text.
        fragment: The end of the address, "#t=1".
        size: The window's width and height in pixels.
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
    with tempfile.TemporaryDirectory() as user:
        command = [str(BROWSER), *_WORDS.split(), f"--user-data-dir={user}"]
        command += [f"--window-size={size}", "--virtual-time-budget=8000", "--dump-dom"]
        address = copy.as_uri() + fragment
        done = subprocess.run(
            [*command, address], capture_output=True, text=True, timeout=120, check=True
        )
    (found,) = re.findall(r'<pre id="told">(.*?)</pre>', done.stdout, re.DOTALL)
    return found
