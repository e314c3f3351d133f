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
