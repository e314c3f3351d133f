"""Runs of a sweep against the same scenarios run alone, and how each ends."""

import pytest
from runs import scenario, some

from drake_dae.errors import ScenarioError
from drake_dae.scenario.scenario import scenario_data, varied_data
from drake_dae.studies.study import Outcome
from drake_dae.studies.sweep import Runner, structure_of

SHORT = ("duration=0.3", "compiled=false", "integrator.accuracy=1e-6")
COMPUTED = "plant=!CompliantContact {time_step: 0.001}", "sampling={period: 0.001}", "law.gains="


LOADED = (
    "plant=!CompliantContact {time_step: 0.001, stiffness: 1.0e5, friction: 0.3}",
    "sampling={period: 0.001, delay: 0.001}",
    "sensors.force={sample_period: 0.001, noise_deviation: 0.1}",
    "sensors.encoders={position_noise: 1.0e-5}",
    "estimator={rate: 20}",
    "plant.payloads=[{frame: tool, mass: 0.2}]",
    "plant.disturbances=[{frame: tool, force: [1, 0, 0]}]",
    "duration=0.05",
    "compiled=false",
)


@pytest.fixture(scope="module", params=some([None, 1.0]))
def loaded(request):
    """Scenario, runner and first result, by Drake's Simulator and by rollouts."""
    base = scenario_data(scenario("two_link_wall", *LOADED))
    runner = Runner(base, request.param)
    return base, request.param, runner, runner.run({})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("start.errors.tool.z", 0.02),
        ("plant.parameters.link1.mass", 11.0),
        ("integrator.start_time", 0.5),
        ("plant.friction", 0.1),
        ("plant.stiffness", 5e4),
        ("plant.payloads.0.mass", 0.4),
        ("plant.disturbances.0.force.2", 2.0),
        ("plant.parameters.wall.position", [1.201, 0.0, 0.0]),
        ("sensors.force.seed", 3),
        ("sensors.force.bias", 0.5),
        ("sensors.force.noise_deviation", 0.5),
        ("sensors.encoders.seed", 3),
        ("law.gains.all", [-3.0]),
    ],
)
def test_each_value_of_a_context_is_that_of_its_run(loaded, key, value):
    """And not of the run before, or of the loop: as in a loop that is built with the value."""
    base, lasting, runner, first = loaded
    found, again = runner.run({key: value}), runner.run({})
    assert runner.builds == 1
    assert first.outcome == Outcome.FINISHED, first
    assert first == again
    wanted = Runner(varied_data(base, {key: value}), lasting).run({})
    assert found.figures.keys() == wanted.figures.keys()
    for name, number in wanted.figures.items():  # Round-off of constants that are folded.
        assert found.figures[name] == pytest.approx(number, rel=1e-6, abs=1e-9), name
    assert found.figures != first.figures


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {"start.positions.joint1": 1.1},
        {"plant.parameters": {"wall.position": [1.21, 0.0, 0.0]}},
        {"integrator.accuracy": 1e-4, "duration": 0.2},
    ],
)
def test_runs_that_share_a_loop_equal_runs_alone(changes):
    """To 1e-9: from another nominal state a start is found by Newton's method to round-off."""
    base = scenario_data(scenario("two_link_wall", *SHORT))
    runner = Runner(base)
    first, found, again = (runner.run(each) for each in ({}, changes, {}))
    assert runner.builds == 1
    assert first == again
    wanted = Runner(varied_data(base, changes)).run({})
    assert found.figures == pytest.approx(wanted.figures, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize(
    ("settings", "variation"),
    [
        # Its geometry and its masses are built in.
        (("plant=!MultibodyPlant {}",), {"plant.parameters.wall.position": [1.21, 0.0, 0.0]}),
        # Another kind of plant may have other values in a context.
        ((), {"plant": {"_tag": "!CompliantContact"}, "plant.parameters.link1.mass": 11.0}),
        ((), {"references.tool.z.offset": 0.2}),
        ((), {"constraints.0.surface.point": [1.25, 0.0, 0.0]}),
        ((), {"law.gains": {"_tag": "!Coefficients", "all": [16.0, 8.0]}}),
        # Gains are computed for the stiffness, and for the robot where it starts.
        (COMPUTED, {"plant.stiffness": 1e4}),
        (COMPUTED, {"start.positions.joint1": 1.1}),
    ],
)
def test_what_is_built_in_has_a_loop_of_its_own(settings, variation):
    base = scenario("two_link_wall", *SHORT, *settings)
    assert structure_of(variation, base) == variation
    found = structure_of({**variation, "duration": 1.0, "start.errors.tool.z": 0.0}, base)
    assert found.keys() >= variation.keys()
    assert found == variation or variation.keys() & {"plant", "plant.stiffness"}


@pytest.mark.slow
@pytest.mark.parametrize("total", some([None, 1.0]))
def test_what_goes_wrong_is_an_outcome_with_its_reason(total):
    """By Drake's Simulator, and by rollouts."""
    base = scenario_data(scenario("two_link_wall", *SHORT))
    far = {"references.tool.z.offset": 1.0, "references.tool.z.amplitudes": [0.9], "duration": 2.0}
    cases = [
        ({"start.errors.tool.z": 3.0}, Outcome.REFUSED, "tool.z"),
        ({"start.positions.joint1": 9.0}, Outcome.REFUSED, "joint1"),
        ({"law.gains": {"_tag": "!Coefficients", "all": [1.0]}}, Outcome.REFUSED, "gains: "),
        ({"duration": -1.0}, Outcome.REFUSED, "duration"),
        (far, Outcome.FAILED, "t = "),
        ({}, Outcome.FINISHED, ""),
    ]
    runner = Runner(base, total)
    for changes, outcome, words in cases:
        result = runner.run(changes)
        assert result.outcome is outcome, result
        assert words in result.reason
        assert bool(result.figures) == (outcome in (Outcome.FAILED, Outcome.FINISHED))
        if outcome is Outcome.FAILED:
            assert 0.0 < result.figures["end [s]"] < 2.0


UNTRACED = "plant=!OwnPlant {maker: 'members:SpringyPlant'}"


def test_what_no_rollout_has_is_reported():
    base = scenario_data(scenario("two_link_wall", *SHORT, UNTRACED))
    Runner(base).check({})
    with pytest.raises(ScenarioError, match="Simulator"):
        Runner(base, 1.0).check({})
