"""The pictures of the README, and what draws them."""

import shutil
from pathlib import Path

import draw_pictures
import pytest
from PIL import Image

PICTURES = Path(__file__).parents[1] / "examples" / "pictures"


def test_a_moment_of_an_animation_is_held():
    page = draw_pictures.held("<body>scene</body></html>", 1.25)
    assert page.endswith("</script></body></html>")
    assert "viewer.animator.seek(1.25);" in page


def test_without_a_browser_it_says_what_to_install(monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda _: None)
    with pytest.raises(SystemExit, match="no browser to film with; install one of chromium, "):
        draw_pictures.main(PICTURES)


def test_the_demo_is_in_motion():
    with Image.open(PICTURES / "seven_joint_wall.gif") as film:
        assert film.n_frames == 25
        assert film.info["loop"] == 0
    for kind in ("errors", "path"):
        assert (PICTURES / f"seven_joint_wall_{kind}.png").read_bytes().startswith(b"\x89PNG")
