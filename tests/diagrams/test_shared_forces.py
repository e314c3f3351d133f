"""A scenario whose constraints are redundant: a law steers their sum, and the split is shown."""

import numpy as np
import pytest
from runs import run_scenario, scenario

from drake_dae import build_scenario, load_scenario
from drake_dae.analysis import LimitKind
from drake_dae.errors import ScenarioError
from drake_dae.scenario.judging import find_feasibility
from drake_dae.scenario.shipped import find_scenario

WALL = "{name: wall, frame: tool, surface: !Plane {point: [1.2, 0, 0], normal: [-1, 0, 0]}}"
LINE = "!Sinusoids {offset: 0.3, amplitudes: [0.3], frequencies: [1.5]}"
PUSH = "!Sinusoids {offset: 20.0, amplitudes: [5.0], frequencies: [2.0]}"
TWICE = [
    f"constraints=[{WALL}, {WALL.replace('wall', 'board')}]",
    "forces=[!ForceCombination {name: press, weights: {wall.force: 1, board.force: 1}}]",
    "duration=0.3",
    f"references={{tool.z: {LINE}, press: {PUSH}}}",
]


def test_a_wall_and_a_board_on_it_share_what_a_law_presses():
    """The compliant board has a third of it; else the run is that with the wall alone."""
    chosen = scenario("two_link_wall", *TWICE, "compliances={board.force: 2.0}")
    _, _, record = run_scenario(chosen)
    _, _, alone = run_scenario(scenario("two_link_wall", "duration=0.3"))
    names = [signal.name for signal in record.signals["constraint_force"].signals]
    assert names == ["wall.force", "board.force"]
    wall, board = record["constraint_force"].T
    np.testing.assert_allclose(wall, 2.0 * board, rtol=1e-12)
    np.testing.assert_allclose(wall + board, record["controlled_output"][:, 1], rtol=1e-12)
    np.testing.assert_allclose(record["state"][-1], alone["state"][-1], atol=1e-12)
    np.testing.assert_allclose((wall + board)[-1], alone["constraint_force"][-1, 0], rtol=1e-9)


def test_what_is_foreseen_is_what_all_constraints_bear():
    foreseen = find_feasibility(scenario("two_link_wall", *TWICE, "compliances={}"))
    assert [r.signal.name for r in foreseen.of(LimitKind.FORCE)] == ["wall.force", "board.force"]
    wall, board = foreseen.of(LimitKind.FORCE)
    assert wall.least == pytest.approx(board.least, rel=1e-12)
    assert 7.0 < wall.least < 13.0


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (TWICE, "constraints: .*compliances"),
        ([*TWICE, "compliances={bord.force: 2.0}"], r"compliances.bord.force: .*boar"),
        ([*TWICE, "compliances={wall.force: 0.0}"], "compliances.wall.force: "),
        ([TWICE[0], TWICE[2], "compliances={}", "outputs=[]"], "wall.force"),
    ],
)
def test_refused_with_key_and_remedy(settings, words):
    with pytest.raises(ScenarioError, match=words):
        build_scenario(load_scenario(find_scenario("two_link_wall"), settings))
