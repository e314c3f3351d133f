"""`examples/gallery` shows scenarios on one page."""

import re
from pathlib import Path

import gallery.__main__
import pytest
from gallery.__main__ import MISSING, main

from drake_dae.scenario.shipped import shipped_scenarios


def test_card_of_a_robot_that_is_not_installed_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setattr(gallery.__main__, "robot_data", lambda: None)
    quadruped = Path(gallery.__main__.HERE.parent / "tasks" / "quadruped.yaml")
    assert main([str(quadruped), "--out", str(tmp_path)]) == 0
    assert MISSING.format(name="quadruped") in (tmp_path / "index.html").read_text("utf-8")


@pytest.mark.slow
def test_cards_show_runs_and_keep_markup_as_text(tmp_path, capsys):
    text = shipped_scenarios()["two_link_wall"].read_text("utf-8")
    marked = tmp_path / "marked.yaml"
    marked.write_text(re.sub("^description: .*", "description: <b>bold</b> & more", text), "utf-8")
    out = tmp_path / "gallery"
    assert main([str(marked), "--out", str(out)]) == 0
    assert "runs marked" in capsys.readouterr().out
    page = (out / "index.html").read_text("utf-8")
    assert "&lt;b&gt;bold&lt;/b&gt; &amp; more" in page
    assert "<b>bold" not in page
    # It can be steered where zig is installed, and says what is missing where not.
    assert ("bench.html" in page) != ("pip install" in page)
    assert '<b class="good">good</b>: every output is at its reference' in page
    for file in re.findall(r'(?:href|src)="([^"]+)"', page):
        assert (out / file).is_file(), file
    # What has not changed does not run again.
    assert main([str(marked), "--out", str(out)]) == 0
    assert "runs marked" not in capsys.readouterr().out
