"""The shipped scenarios run with the errors that theory predicts, and read back as saved."""

import jsonschema
import numpy as np
import pytest
from runs import DEAR, IN_CONTACT, scenario_validator, some, untagged
from scenario_texts import run

from drake_dae import load_scenario
from drake_dae.scenario.form import load_yaml
from drake_dae.scenario.scenario import save_scenario
from drake_dae.scenario.shipped import find_scenario, shipped_scenarios

RIGID = ["two_link_wall", "seven_joint_wall", "seven_joint_dome", "two_arms", "five_bar"]
ACTUATED = {
    "two_link_flexible": 1e-9,
    "two_link_motors": 1e-9,
    "two_link_hydraulics": 1e-9,
    "two_link_flexible_motors": 1e-8,
    "seven_joint_flexible": 1e-7,
    "seven_joint_flexible_motors": 1e-4,
}
LONG = some(RIGID), some(ACTUATED, dear=("seven_joint_flexible_motors",), first=1)
RUN_LONG = [one.values[0] for one in (*LONG[0], *LONG[1]) if not one.marks]
# Drake's own contact, and those that open, have suites of their own: the former touches without a
# force at the start.
OTHERS = [
    pytest.param(name, marks=[pytest.mark.thorough] * (name in DEAR))
    for name in shipped_scenarios()
    if not name.startswith(IN_CONTACT) and name not in RUN_LONG
]


def run_from_start_errors(name, duration):
    """The scenario, its loop, record and distances from the predicted error."""
    scenario = load_scenario(find_scenario(name), [f"duration={duration}"])
    assert scenario.description
    loop, record, distance = run(scenario)
    assert record.time[-1] == pytest.approx(duration, abs=1e-9)
    for i, signal in enumerate(loop.plant.dae.output_signals):
        wanted = scenario.start.errors.get(signal.name, 0.0)
        # With a degree of 0 the law meets the reference at once, if its model is right.
        if loop.controller.law.degrees[i] or not scenario.plant.parameters:
            assert record["tracking_error"][0, i] == pytest.approx(wanted, abs=1e-9)
    return scenario, loop, record, distance


@pytest.mark.slow
@pytest.mark.parametrize("name", LONG[0])
def test_rigid_scenario_has_the_predicted_error(name):
    """In 3 s all outputs move and the start errors decay by 1e-4.

    The accuracy of 1e-8 in a step leaves less than 1e-6 along the way; the force has no dynamics,
    so that its error is round-off alone.
    """
    _, loop, record, distance = run_from_start_errors(name, 3.0)
    positions = len(loop.plant.model.position_signals)
    assert np.max(distance[:positions]) < 1e-6
    assert np.max(distance[positions:]) < 1e-11
    assert np.max(np.abs(record["constraint_residual"])) < 1e-8
    # The wall's, the dome's, what squeezes the box and what preloads the pin.
    assert np.all(record["constraint_force"][:, 0] > 0.0)
    limits = loop.plant.model.links
    assert np.all(np.abs(record["control"]) < limits.effort_limits)
    pairs = zip(limits.position_limits, limits.velocity_limits, strict=True)
    low, high = map(np.concatenate, pairs)
    links = record["state"][:, : low.size]
    assert np.all((low <= links) & (links <= high))


@pytest.mark.slow
@pytest.mark.parametrize("name", LONG[1])
def test_actuated_scenario_has_the_predicted_error(name):
    """In 1 s, relative to the start errors of some cm and 5 N.

    Steps and round-off leave 5e-11 to 8e-10 of the two-link arm's, and 1e-8 and 6e-6 of the
    seven-joint arm's, whose wrist is light. The tolerances leave a factor of ten.
    """
    scenario, loop, record, distance = run_from_start_errors(name, 1.0)
    signals = loop.plant.dae.output_signals
    errors = [abs(scenario.start.errors.get(signal.name, 0.03)) for signal in signals]
    assert np.max(distance / errors) < ACTUATED[name]
    assert np.all(record["constraint_force"] > 0.0)
    # By then the force error has fallen.
    assert np.abs(record["tracking_error"][-1, -1]) < 0.3 * 5.0


@pytest.mark.slow
@pytest.mark.parametrize("name", OTHERS)
def test_other_scenario_runs_from_its_start_errors(name):
    scenario, _, record, distance = run_from_start_errors(name, 0.3)
    assert np.max(np.abs(record["constraint_residual"])) < 1e-9
    if not scenario.plant.parameters:
        # Accuracy 1e-8 in a step; of the actuated ones see ACTUATED.
        assert np.max(distance) < 1e-5 * max(map(abs, scenario.start.errors.values()))


@pytest.mark.slow
@pytest.mark.parametrize("name", shipped_scenarios())
def test_a_saved_scenario_reads_back_equal_and_both_fit_the_schema(name, tmp_path):
    path, saved = find_scenario(name), tmp_path / "copy.yaml"
    scenario = load_scenario(path)
    save_scenario(scenario, saved, "# A comment.")
    assert saved.read_text().startswith("# A comment.\ndescription:")
    copy = load_scenario(saved)
    assert copy == scenario
    copy.integrator.accuracy *= 2.0
    assert copy != scenario
    for file in (path, saved):
        data = load_yaml(file.read_text(), name)
        scenario_validator().validate(untagged(data))
        data["constraints"][0]["nmae"] = "wall"
        with pytest.raises(jsonschema.ValidationError):
            scenario_validator().validate(untagged(data))
