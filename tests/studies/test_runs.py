"""Runs of a study against the same scenarios run alone, and how each ends."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from runs import run_scenario, scenario, some

from drake_dae import build_scenario
from drake_dae.errors import ScenarioError
from drake_dae.scenario.files import varied_data
from drake_dae.scenario.forms.typed_yaml import TAG
from drake_dae.scenario.rolled import for_rollout
from drake_dae.scenario.scenario import read_scenario, scenario_data
from drake_dae.scenario.start import start_scenario
from drake_dae.simulation.figures import figures_of, margins
from drake_dae.simulation.records.together import indexed_record
from drake_dae.simulation.summary import Limits
from drake_dae.studies.processes import next_place
from drake_dae.studies.results import Outcome, RunResult
from drake_dae.studies.runs import Runner
from drake_dae.studies.structures import (
    batches,
    lasting,
    structure_key,
    structures_of,
    study_data,
)

SHORT = ("duration=0.3", "compiled=false", "integrator.accuracy=1e-6")

# All of them live in a context of one closed loop.
NUMBERS = [
    {},
    {"start.errors.tool.z": 0.02},
    {"start.positions.joint1": 1.1},
    {"plant_parameters.link1.mass": 11.0},
    {"plant_parameters.link1.mass": [11.0]},
    {"plant_parameters": {"wall.position": [1.21, 0.0, 0.0]}},
    {"gains.all": [-8.0]},
    {"gains": {"outputs": {"tool.z": [-3.0, -5.0]}}},
    {"integrator.accuracy": 1e-4, "duration": 0.2},
    {"integrator.start_time": 0.5},
    {"write.plots": False, "description": "other"},
    {},
]


def alone(base, changes):
    """The figures of a variation in a closed loop of its own."""
    chosen = read_scenario(varied_data(base, changes))
    loop, _, record = run_scenario(chosen)
    one = indexed_record(record, None)
    return figures_of(one, margins(one, Limits.of(loop.plant.model)))[0]


def check(base, changes, result, tolerance=0.0):
    assert (result.outcome, result.reason) == (Outcome.FINISHED, "")
    figures = dict(result.figures)
    assert figures.pop("steps") >= 1
    expected = alone(base, changes)
    assert list(figures) == list(expected)
    np.testing.assert_allclose(
        list(figures.values()), list(expected.values()), rtol=tolerance, atol=tolerance
    )


@pytest.mark.slow
def test_runs_that_share_a_loop_equal_runs_alone():
    base = scenario_data(scenario("two_link_wall", *SHORT))
    assert len({structure_key(varied_data(base, changes), base) for changes in NUMBERS}) == 1
    runner = Runner(base)
    found = list(runner.run_all(list(enumerate(NUMBERS))))
    assert runner.builds == 1
    assert [result.run for result in found] == list(range(len(NUMBERS)))
    for changes, result in zip(NUMBERS, found, strict=True):
        # To the last bit, but where the nominal state of the model is another one, and a start is
        # found from there by Newton's method to round-off.
        check(base, changes, result, 1e-9 if "start.positions.joint1" in changes else 0.0)
    assert found[0].figures == found[-1].figures
    assert found[3].figures == found[4].figures != found[0].figures


@pytest.mark.slow
def test_seeds_of_the_sensor():
    base = scenario_data(scenario("two_link_measured_force", "duration=0.05", "compiled=false"))
    runner = Runner(base)
    seeds = [1, 2, 1]
    found = list(
        runner.run_all([(i, {"force_feedback.seed": seed}) for i, seed in enumerate(seeds)])
    )
    assert runner.builds == 1
    for seed, result in zip(seeds, found, strict=True):
        check(base, {"force_feedback.seed": seed}, result)
    assert found[0].figures == found[2].figures != found[1].figures


def test_seed_of_encoders_needs_no_loop_of_its_own():
    base = scenario_data(scenario("two_link_wall", "encoders={position_noise: 1.0e-5, seed: 1}"))
    keys = {structure_key(varied_data(base, {"encoders.seed": seed}), base) for seed in (1, 2)}
    assert len(keys) == 1


def test_what_drakes_contact_has_otherwise_needs_a_loop_of_its_own():
    """Its geometry and its masses are built in, and are not in a context."""
    base = scenario_data(scenario("two_link_wall", "plant=!MultibodyPlant {}"))
    moved = {"plant_parameters.wall.position": [1.21, 0.0, 0.0]}
    assert structure_key(varied_data(base, moved), base) != structure_key(base, base)


@pytest.mark.slow
def test_what_is_advised_is_advised_anew_where_the_contact_is_another_one():
    base = scenario_data(scenario("wall_point_contact"))
    assert base["gains"] is None
    stiff, later = ({"plant.stiffness": 1e6}, {"duration": 1.0})
    assert structure_key(varied_data(base, later), base) == structure_key(base, base)
    assert structure_key(varied_data(base, stiff), base) != structure_key(base, base)
    given = varied_data(base, {"gains": {"all": [-8.0]}})
    assert structure_key(given, base) != structure_key(base, base)


@pytest.mark.slow
def test_another_structure_is_built():
    base = scenario_data(scenario("two_link_wall", *SHORT))
    variations = [
        {"constraints.0.surface.point": [1.25, 0.0, 0.0]},
        {"references.tool.z.offset": 0.2},
        {"gains": {"_tag": "!Coefficients", "all": [16.0, 8.0]}},
        {"actuation": [{"_tag": "!DcMotors", "torque_constant": 0.5, "inductance": 1e-2,
                        "resistance": 1.0, "gear_ratio": 100.0}],
         "integrator.max_step_size": 1e-3},
    ]  # fmt: skip
    assert len({structure_key(varied_data(base, v), base) for v in [*variations, {}]}) == 5
    runner = Runner(base)
    for changes, result in zip(
        variations, runner.run_all(list(enumerate(variations))), strict=True
    ):
        check(base, changes, result)
    assert runner.builds == 4


@pytest.mark.slow
@pytest.mark.parametrize("total", some([None, 1.0]))
def test_what_goes_wrong_is_an_outcome_with_its_reason(total):
    """By Drake's Simulator, and by rollouts."""
    base = scenario_data(scenario("two_link_wall", *SHORT))
    far = {"references.tool.z.offset": 1.0, "references.tool.z.amplitudes": [0.9], "duration": 2.0}
    cases = [
        ({"start.errors.tool.z": 3.0}, Outcome.NO_START, "found no configuration"),
        ({"start.positions.joint1": 9.0}, Outcome.REFUSED, "outside its limits"),
        ({"plant_parameters.link7.mass": 1.0}, Outcome.REFUSED, "no parameter 'link7.mass'"),
        ({"gains": {"_tag": "!Coefficients", "all": [1.0]}}, Outcome.REFUSED, "gains: "),
        ({"constraints": []}, Outcome.REFUSED, ": "),
        ({"constraints": []}, Outcome.REFUSED, ": "),
        ({"gains.all": [4.0]}, Outcome.REFUSED, "gains: "),
        ({"duration": -1.0}, Outcome.REFUSED, "a duration must be positive"),
        (far, Outcome.FAILED, "the simulation cannot go on at t = "),
        ({}, Outcome.FINISHED, ""),
    ]
    runner = Runner(base, total)
    results = list(runner.run_all([(i, changes) for i, (changes, _, _) in enumerate(cases)]))
    assert runner.builds == 6  # A structure that is refused twice was sought once.
    for (_, outcome, words), result in zip(cases, results, strict=True):
        assert result.outcome is outcome, result
        assert words in result.reason
        assert bool(result.figures) == (outcome in (Outcome.FAILED, Outcome.FINISHED))
        assert RunResult.from_dict(result.to_dict()) == result
        if outcome is Outcome.FAILED:
            assert 0.0 < result.figures["end [s]"] < 2.0


UNTRACED = "plant=!OwnPlant {maker: 'members:SpringyPlant'}"


def test_what_no_rollout_has_is_reported_with_a_remedy():
    base = scenario_data(scenario("two_link_wall", *SHORT, UNTRACED))
    assert Runner(base).why_not({}) is None
    assert "only runs in Drake's Simulator" in str(Runner(base, 1.0).why_not({}))


@pytest.mark.slow
def test_tasks_vary_as_references_do():
    """Their gains are built in, also for rollouts, which give the same figures."""
    base = scenario_data(
        scenario("wall_polish", "duration=0.1", "compiled=false", "gains=!Poles {all: [-25.0]}")
    )
    slower = {"gains.all": [-20.0]}
    assert structure_key(varied_data(base, slower), base) != structure_key(base, base)
    (found,) = Runner(base).run_all([(0, slower)])
    check(base, slower, found)
    runner = Runner(base, 1.0)
    assert runner.why_not(slower) is None
    (rolled,) = runner.run_all([(0, slower)])
    assert rolled.outcome == found.outcome
    assert rolled.figures.keys() == found.figures.keys()


def test_how_long_runs_of_one_structure_last():
    base = scenario_data(scenario("two_link_wall", *SHORT))
    walls = [{"constraints.0.surface.point": [x, 0.0, 0.0]} for x in (1.2, 1.25)]
    starts = [{"start.errors.tool.z": z, "duration": 0.6} for z in (0.0, 0.01)]
    structures = structures_of(base, [*starts, *walls], True)
    assert lasting(structures) == pytest.approx((2 * 0.6 + 2 * 0.3) / 2)


def test_batches_have_one_structure_and_all_runs():
    base = scenario_data(scenario("two_link_wall"))
    walls = [1.2, 1.25, 1.3]
    runs = [
        (i, {"constraints.0.surface.point": [walls[i % 3], 0, 0], "start.errors.tool.z": 1e-5 * i})
        for i in range(3000)
    ]
    structures = structures_of(base, [changes for _, changes in runs], False)
    found = batches(structures, runs, workers=2)
    assert sorted(pair for batch in found for pair in batch) == runs
    for batch in found:
        assert 1 <= len(batch) <= 32
        assert len({run % 3 for run, _ in batch}) == 1
    assert max(map(len, found)) > 1
    # With few runs no worker waits for another one.
    assert [len(batch) for batch in batches(structures, runs[:5], workers=2)] == [1] * 5


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_a_worker_stays_with_a_structure_as_long_as_it_has_runs(workers):
    """Workers that take turns build each structure once, and one more for each further worker."""
    structure_of = [place // 10 for place in range(60)]
    waiting, last, builds = set(range(60)), [-1] * workers, 0
    while waiting:
        for worker in range(min(workers, len(waiting))):
            place = next_place(waiting, last[worker])
            waiting.remove(place)
            builds += last[worker] < 0 or structure_of[place] != structure_of[last[worker]]
            last[worker] = place
    assert 6 <= builds <= 6 + 2 * (workers - 1)


def test_the_data_of_a_run_are_complete_and_of_the_plant_that_a_rollout_runs():
    """Also where a variation gives a part of a plant, or keys that only the plant itself has."""
    base = scenario_data(scenario("wall_point_contact", "constraints.0.viscous_friction=3"))
    given = {"plant": {TAG: "!CompliantContact", "stiffness": 1e4}}
    assert study_data(base, given)["plant"]["radius"] == 0.01
    kinds = {
        model: study_data(base, {"plant.contact_model": model}, True)
        for model in ("point", "hydroelastic")
    }
    assert kinds["hydroelastic"]["plant"][TAG] == "!MultibodyPlant"
    rolled, _ = for_rollout(read_scenario(base))
    assert read_scenario(kinds["point"]).plant == rolled.plant
    # Drake's contact has no viscous friction.
    wanted = {"wall.viscous_friction": 0.0}
    assert kinds["point"]["plant_parameters"] == rolled.plant_parameters == wanted


@pytest.mark.slow
def test_a_run_of_compliant_contact_has_its_own_parameters_alone():
    """Not those of the study's scenario, which are its default."""
    text = "plant=!CompliantContact {}", "plant_parameters={wall.position: [0.702, 0, 0]}"
    base = scenario_data(scenario("wall_point_contact", "compiled=false", *text))
    runner, data = Runner(base), study_data(base, {"plant_parameters": {}})
    loop = runner.loop(data)
    own = loop.plant.GetMyContextFromRoot(start_scenario(read_scenario(data), loop))
    np.testing.assert_array_equal(loop.plant.get_parameter(own, "wall.position"), [0.7, 0.0, 0.0])


@pytest.mark.slow
def test_a_rollout_has_nothing_of_the_one_before_it():
    """Whose context it uses again: the same figures, bit by bit, as in a context of its own."""
    chosen = scenario(
        "two_link_wall",
        "plant=!CompliantContact {time_step: 0.001, friction: 0.3}",
        "force_feedback=!MeasuredForce {sample_period: 0.001, noise_deviation: 0.1}",
        "duration=0.1",
    )
    other = {
        "plant.friction": 0.1,
        "plant_parameters": {"link1.mass": 11.0, "wall.position": [1.201, 0.0, 0.0]},
        "gains.all": [-8.0],
        "start.errors.tool.z": 0.01,
        "force_feedback.seed": 3,
    }
    # The last two begin elsewhere, and have all other numbers of the run before them.
    starts = {"start.errors.tool.z": 0.02}, {"start.errors.tool.z": 0.01, "duration": 0.05}
    base, runs = scenario_data(chosen), list(enumerate([other, {}, *starts]))
    used = Runner(base, 1.0)
    found = [next(used.run_all([run])) for run in runs]
    assert used.builds == 1
    for run, after in zip(runs[1:], found[1:], strict=True):
        (fresh,) = Runner(base, 1.0).run_all([run])
        assert after.outcome == Outcome.FINISHED
        assert after.figures == fresh.figures


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
def test_runs_side_by_side_are_those_of_a_batch_of_one():
    """Also where some of them diverge, here by samples that are too slow for their gains."""
    chosen = scenario("two_link_wall", "duration=3", "sampling={period: 0.1}", "compiled=true")
    base = scenario_data(chosen)
    gains = [-1.0, -12.0, -2.0, -14.0, -10.0]
    runs = [(i, {"gains.all": [gain]}) for i, gain in enumerate(gains)]
    runs += [(5, {"gains.all": [-14.0], "may_diverge": True, "duration": 1.8})]
    runner = Runner(base, 1e6)
    together, records = list(runner.run_all(runs)), list(runner.records(runs))
    assert [r.run for r in together if r.outcome == Outcome.FAILED] == [1, 3]
    for run, result, (record, reason) in zip(runs, together, records, strict=True):
        if result.outcome == Outcome.FINISHED:  # Others enlarge the round-off of a step.
            (alone,) = runner.run_all([run])
            assert replace(alone, seconds=0.0) == replace(result, seconds=0.0)
        assert reason == result.reason
        one, figures = indexed_record(record, None), dict(result.figures)
        assert (figures.pop("steps", None) is None) == (result.outcome == Outcome.FAILED)
        limits = Limits.of(runner.loop(base).plant.model)
        assert figures == figures_of(one, margins(one, limits))[0]
    for record, reason in (records[1], records[3]):
        assert f"the run diverges: at t = {record.time[-1]:.6g} s" in reason


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
def test_runs_that_all_diverge_are_computed_once(monkeypatch):
    """None of them is repeated alone."""
    chosen = scenario("two_link_wall", "duration=3", "sampling={period: 0.1}", "compiled=true")
    runner = Runner(scenario_data(chosen), 1e6)
    repeated = []
    monkeypatch.setattr(Runner, "_alone", lambda _, run: repeated.append(run.number))
    results = list(
        runner.run_all([(i, {"gains.all": [gain]}) for i, gain in enumerate([-12, -14])])
    )
    assert [result.outcome for result in results] == [Outcome.FAILED] * 2
    assert repeated == []


def test_steps_do_not_begin_before_zero():
    """Drake's periodic events do not, so such a plant would stand still until then."""
    found = scenario("wall_point_contact", "compiled=false", "integrator.start_time=-1")
    with pytest.raises(ScenarioError, match=r"start_time: .* begin at 0 s"):
        build_scenario(found)
