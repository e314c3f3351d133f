"""What goes wrong in a scenario is reported with the keys of a scenario."""

import pytest
from runs import scenario

from drake_dae import build_scenario
from drake_dae.errors import ScenarioError


@pytest.mark.parametrize(
    ("name", "setting", "words"),
    [
        (
            "two_link_wall",  # A stretched arm that touches the wall.
            "start={positions: {joint1: 0.927295218, joint2: 0}}",
            ["outputs: Assumption (4)", "start.positions"],
        ),
        (
            "seven_joint_wall",
            "start={positions: {joint1: 0}}",
            ["outputs: Assumption (5)", "start.positions"],
        ),
    ],
)
def test_a_robot_that_cannot_start_is_sent_to_its_keys(name, setting, words):
    with pytest.raises(ScenarioError) as caught:
        build_scenario(scenario(name, setting))
    message = str(caught.value)
    assert [word for word in words if word not in message] == [], message
