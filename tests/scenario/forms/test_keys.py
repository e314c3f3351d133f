"""What goes wrong in a scenario is reported with the keys of a scenario."""

import re

import pytest
from runs import scenario

from drake_dae import build_scenario
from drake_dae.dae.states.family import Deciding
from drake_dae.dae.structure.assumptions import Violation, ViolationKind
from drake_dae.errors import AssumptionError, ScenarioError
from drake_dae.scenario.forms.keys import violated

PYTHON = re.compile(
    r"drop_constraints|share_forces|dynamic_extension|with_bounds|plant\.\w+\(|Finalize"
)


@pytest.mark.parametrize("cause", ViolationKind)
@pytest.mark.parametrize(("assumption", "key"), [(2, "constraints"), (5, "outputs")])
def test_no_remedy_is_a_call_of_python(cause, assumption, key):
    deciding = Deciding(("wall.stiffness",), (1.0,), (0.0,))
    error = violated(Violation(assumption, cause, ("tool.z",), 2, deciding=deciding).error())
    ((found, text),) = error.problems
    assert found == key
    assert text.startswith(f"Assumption ({assumption}): ")
    assert not PYTHON.search(text), text


def test_other_messages_are_unchanged():
    assert violated(AssumptionError("no integrators", 5)).problems == (
        ("outputs", "no integrators"),
    )


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
        ("two_link_wall", "outputs.0.axes=xz", ["outputs: ", "Name in `forces`"]),
    ],
)
def test_a_robot_that_cannot_start_is_sent_to_its_keys(name, setting, words):
    with pytest.raises(ScenarioError) as caught:
        build_scenario(scenario(name, setting))
    message = str(caught.value)
    assert [word for word in words if word not in message] == [], message
    assert not PYTHON.search(message)
