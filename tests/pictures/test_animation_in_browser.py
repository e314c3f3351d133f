"""Animations in a browser: labels apart, the moment of the address, and runs beside each other.

What an animation does with the time that the page around it says is looked at by hand: messages
stop the virtual time of a browser without a screen.
"""

import json

import numpy as np
import pytest
from browser import needs_chromium, shown
from runs import scenario, some

from drake_dae import build_scenario, make_animation, simulate
from drake_dae.cli import main
from drake_dae.pictures.side_by_side import side_by_side

LABELS = """
return JSON.stringify({
  clock: document.getElementById('run-clock').textContent,
  top: document.getElementById('run').getBoundingClientRect().bottom,
  bar: document.getElementById('run-bar').getBoundingClientRect().top,
  boxes: [...document.querySelectorAll('.run-force')].filter(one => one.style.display !== 'none')
    .map(one => one.getBoundingClientRect()).map(one => [one.left, one.top, one.right, one.bottom]),
  tips: viewer.scene_tree.find(['contact']).object.children.map(one => {
    const force = one.children.find(other => other.name === 'force');
    const place = force.getWorldPosition(force.position.clone()).project(viewer.camera);
    const pane = viewer.dom_element;
    return [(0.5 + 0.5 * place.x) * pane.offsetWidth,
      pane.offsetTop + (0.5 - 0.5 * place.y) * pane.offsetHeight];
  }),
});
"""


def page_of(name, path, *settings):
    case = scenario(name, *settings)
    loop, context = build_scenario(case)
    simulate(loop.diagram, context, case.duration, case.integrator)
    path.write_text(make_animation(loop, loop.record(context), context), "utf-8")
    return path


SIZES = [("biped", "900,700"), ("three_fingers", "420,760")]


@needs_chromium
@pytest.mark.slow
@pytest.mark.parametrize(("name", "size"), some(SIZES))
def test_labels_cover_neither_each_other_nor_where_forces_act(name, size, tmp_path):
    page = page_of(name, tmp_path / "page.html", "duration=1.0")
    said = json.loads(shown(page, LABELS, "#t=0.5", size))
    assert said["clock"].startswith("t = 0.50 s")
    boxes, tips = np.array(said["boxes"]), np.array(said["tips"])
    assert len(boxes) == len(tips) >= 3
    for number, (left, top, right, bottom) in enumerate(boxes):
        for other in boxes[:number]:
            assert right <= other[0] or other[2] <= left or bottom <= other[1] or other[3] <= top
        covers = (tips > [left, top]).all(axis=1) & (tips < [right, bottom]).all(axis=1)
        assert not covers.any()
        # Between title and bar, which cover nothing of the scene.
        assert said["top"] <= top
        assert bottom <= said["bar"]


@needs_chromium
@pytest.mark.slow
def test_pages_beside_each_other_are_told_one_time(tmp_path):
    """Two pages that answer with what they are told stand in for animations."""
    pages = {"first": tmp_path / "a page.html", "<b>second": tmp_path / "b.html"}
    for page in pages.values():
        page.write_text(
            "<body><script>window.addEventListener('message', event => "
            "window.parent.postMessage('told ' + event.data.after, '*'))</script></body>"
        )
    both = tmp_path / "both.html"
    both.write_text(side_by_side(pages, 0.5, tmp_path), "utf-8")
    assert "<b>second" not in both.read_text("utf-8")
    hear = """
      window.heard = window.heard || (window.addEventListener('message', event => {
        const place = [...document.querySelectorAll('iframe')].findIndex(
          frame => frame.contentWindow === event.source);
        window.heard[place] = event.data;
      }), {});
      window.heard.names = [...document.querySelectorAll('figcaption')].map(one => one.textContent);
      return JSON.stringify(window.heard);
    """
    heard = json.loads(shown(both, hear, "#t=0.25"))
    assert (heard["0"], heard["1"]) == ("told 0.25", "told 0.25")
    assert heard["names"] == ["first", "&lt;b&gt;second"]  # As the text of the page has it.


def test_play_writes_a_page_for_several_runs_and_refuses_what_makes_none(
    tmp_path, monkeypatch, capsys
):
    opened = []
    monkeypatch.setattr("webbrowser.open", lambda address: opened.append(address) or True)
    monkeypatch.chdir(tmp_path)
    given = ["--set", "duration=0.05", "--set", "write.plots=false", "--rollout"]
    for name in ("one", "other"):
        assert main(["simulate", "two_link_wall", *given, "--out", name]) == 0
    assert main(["play", "one", "other"]) == 0
    assert opened == [(tmp_path / "compare.html").as_uri()]
    page = (tmp_path / "compare.html").read_text("utf-8")
    assert '["one", "one/animation.html"], ["other", "other/animation.html"]' in page
    assert main(["play", "one", "other", "--out", "other/both.html"]) == 0
    assert "../one/animation.html" in (tmp_path / "other" / "both.html").read_text("utf-8")
    capsys.readouterr()
    for words, said in (
        (["one", "one"], "a run is named twice"),
        (["one", "none"], "no folder 'none'"),
        (["one", "other", "--out", "x.png"], "a page is an .html"),
    ):
        assert main(["play", *words]) == 1
        assert said in capsys.readouterr().err
