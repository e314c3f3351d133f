"""`examples/gallery` shows scenarios on one page."""

import re

import pytest
from gallery.__main__ import main

from drake_dae.scenario.shipped import shipped_scenarios


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
    assert '<b class="good">good</b>: every output is at its reference' in page
    for file in re.findall(r'(?:href|src)="([^"]+)"', page):
        assert (out / file).is_file(), file
    # What has not changed does not run again.
    assert main([str(marked), "--out", str(out)]) == 0
    assert "runs marked" not in capsys.readouterr().out
