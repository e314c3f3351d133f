"""`examples/gallery` adds cards to those of `drake-dae gallery`."""

import re

import gallery.__main__
import pytest
from gallery.__main__ import PAGE, SYSTEMS, main, robot_data, system_card
from runs import some

from drake_dae.commands.gallery import PICTURE
from drake_dae.errors import GeometryWarning
from drake_dae.scenario.shipped import shipped_scenarios


@pytest.mark.slow
@pytest.mark.parametrize("name", some(SYSTEMS))
def test_systems_that_are_no_robots_are_as_predicted(name, tmp_path):
    """Their constraint is algebra of first order, so that projection leaves round-off alone."""
    folder = tmp_path / name
    folder.mkdir()
    card = system_card(PAGE, folder)
    assert card.outcome == "good"
    assert card.remark.startswith("Tracked as predicted: ")
    assert float(re.findall(r"residual (\S+) at most", card.figures)[0]) < 1e-9
    assert "\n" not in card.description
    assert "DaeSystem.from_functions" in card.source
    for _, file in card.files:
        assert (folder / file).is_file()
    assert f'<img src="{name}/outputs.png"' in card.to_html(name)


def test_no_task_has_the_name_of_a_shipped_scenario():
    tasks = {path.stem for path in gallery.__main__.TASKS.glob("*.yaml")}
    assert len(tasks) > 5
    assert not tasks & set(shipped_scenarios())


@pytest.mark.slow
@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore", category=GeometryWarning)
def test_robots_of_manufacturers_and_tasks_have_cards(tmp_path, monkeypatch):
    """Of one of each kind: all take minutes."""
    if robot_data() is None:
        pytest.skip("pip install example-robot-data")
    monkeypatch.setattr(gallery.__main__, "VENDORS", {"ur5": gallery.__main__.VENDORS["ur5"]})
    monkeypatch.setattr(gallery.__main__, "SYSTEMS", {})
    monkeypatch.setattr(gallery.__main__, "shipped_scenarios", dict)
    monkeypatch.setenv("ROS_PACKAGE_PATH", "")
    assert main(["--out", str(tmp_path)]) == 0
    page = (tmp_path / "index.html").read_text("utf-8")
    names = re.findall(r'<article id="(\w+)">', page)
    assert {"quadruped", "ideal_peg", "ur5"} <= set(names)
    assert page.count("off prediction by") == len(names)
    assert all((tmp_path / name / PICTURE).stat().st_size > 10_000 for name in names)
