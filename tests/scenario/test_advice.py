"""What a scenario with Drake's contact uses where nothing is said, and its observer."""

import re
from dataclasses import replace

import numpy as np
import pytest
from arms import numbers
from runs import scenario, scenario_model

from drake_dae import build_scenario, contact_gains, load_scenario, simulate
from drake_dae.dae import Parameter, advised_gains
from drake_dae.dae.disturbance import estimated_within
from drake_dae.errors import ScenarioError
from drake_dae.scenario import build
from drake_dae.scenario import parts as parts
from drake_dae.scenario.build import build_completed, roll_scenario
from drake_dae.scenario.completion import Completed
from drake_dae.scenario.gains import (
    advised,
    estimates_all,
    estimating_all,
    sensed_contact,
    stated_errors,
)
from drake_dae.scenario.judging import judge_run
from drake_dae.scenario.model import scenario_structure
from drake_dae.scenario.scenario import Scenario, save_scenario
from drake_dae.scenario.start import start_scenario

PLANT = "plant=!MultibodyPlant {time_step: 1.0e-3, stiffness: 1.0e5, friction: 0.3}"
STILL = "references={tool.z: 0.3, wall.force: 20}"
LATE = "sampling={period: 1.0e-3, delay: 1.0e-3}"


def two_link(*settings: str) -> Scenario:
    found = scenario("two_link_wall", "duration=0.02", PLANT, STILL, LATE, "law.gains=", *settings)
    found.start.errors.clear()
    return found


def advice(found: Scenario) -> Completed:
    model = scenario_model(found)
    return advised(found, model, scenario_structure(model))


def chosen(found: Scenario) -> Scenario:
    return advice(found).scenario


@pytest.mark.slow
def test_what_is_left_out_is_advised_and_reported():
    found = two_link("constraints.0.friction=0.0")
    completed, loop = build_completed(found)
    assert len(completed.notes) == 1
    assert "1e+05 N/m" in completed.notes[0]
    assert "identifies: friction, loads, tilts and places" in completed.notes[0]
    model = scenario_model(found)
    structure = scenario_structure(model)
    mobility = structure.constraint_matrix(structure.states[0]).item()
    wanted = contact_gains(1e5, mobility, 1e-3, 1)
    run = completed.scenario
    assert run.law.integral == ["tool.z", "wall.force"]
    assert run.law.gains.outputs["tool.z"] == pytest.approx(wanted.position_gains(3), rel=1e-2)
    assert run.law.gains.outputs["wall.force"] == [pytest.approx(wanted.force_gain, rel=1e-2)]
    assert run.law.constraint_damping.all == [pytest.approx(-wanted.constraint_damping, rel=1e-2)]
    assert run.estimator.rate == pytest.approx(wanted.observer_rate, rel=1e-2)
    assert run.estimator.force_rate == pytest.approx(wanted.observer_force_rate, rel=1e-2)
    assert run.sensors.force == parts.MeasuredForce(sample_period=1e-3)
    assert loop.observer is not None
    assert loop.signals["friction"][0].name == "wall.friction"


def test_an_estimator_estimates_what_it_can_unless_parameters_are_named():
    named = {}
    for settings in ((), ("estimator.parameters=[]",)):
        _, loop = build_completed(two_link("constraints.0.friction=0.0", *settings))
        named[settings] = {
            signal.name for signal in loop.observer.further_signals.get("identified", ())
        }
    joints = {f"joint{i}.{kind}" for i in (1, 2) for kind in ("coulomb", "viscous")}
    tilts = {f"wall.{key}[{i}]" for key in ("rpy", "position") for i in range(3)}
    load = {"tool_load.mass", *(f"tool_load.center[{i}]" for i in range(3))}
    assert named == {
        (): {*joints, *tilts, *load, "wall.friction"},
        ("estimator.parameters=[]",): set(),
    }
    assert loop.signals["friction"][0].name == "wall.friction"


@pytest.mark.parametrize(
    ("settings", "is_free"),
    [
        ([], True),
        (["constraints.0.surface=!Sphere {center: [2.2, 0, 0.3], radius: 1.0}"], False),
        (["estimator.state_rate=200"], True),
        (["plant=!IdealConstraints {}"], False),
        (["estimator.parameters=[link2.mass]"], False),
    ],
)
def test_it_is_estimated_on_planes_that_give_way(settings, is_free):
    found = two_link("estimator.rate=20", *settings)
    assert estimates_all(found, scenario_model(found)) == is_free


def test_ranges_end_where_a_parameter_has_no_meaning():
    mass, friction, angle = (
        Parameter("mass", 0.1, positive=True),
        Parameter("friction", 0.1, nonnegative=True),
        Parameter("angle", 0.1),
    )
    ranges = dict.fromkeys(["mass", "friction", "angle"], 1.0)
    low, high = estimated_within([mass, friction, angle], ranges)
    np.testing.assert_allclose(low, [1e-4, 0.0, -0.9], rtol=1e-12)
    np.testing.assert_allclose(high, 1.1, rtol=1e-12)


def test_what_cannot_be_estimated_refuses_no_run(monkeypatch):
    def impossible(scenario, model):
        return replace(estimating_all(scenario, model), bounds={"tool_load.mass": (2.0, 3.0)})

    monkeypatch.setattr(build, "estimating_all", impossible)
    completed, loop = build_completed(two_link("constraints.0.friction=0.0"))
    assert any("tool_load.mass" in note for note in completed.notes)
    assert loop.signals["friction"][0].name == "wall.friction"


def test_encoders_are_estimated_at_rates_for_their_noise():
    """What is predicted is printed; coarser encoders have slower rates and larger errors."""
    fine, coarse = (
        advice(two_link(f"sensors.encoders={{resolution: {size}}}"))
        for size in ("1.0e-6", "1.0e-3")
    )
    assert "estimate of the state" in fine.notes[0]
    assert "the best for one direction alone" in fine.notes[0]
    assert fine.scenario.estimator.state_rate > coarse.scenario.estimator.state_rate
    differences = chosen(two_link("sensors.encoders={resolution: 1.0e-6, velocity_bandwidth: 500}"))
    assert differences.estimator.state_rate is None
    own = chosen(two_link("sensors.encoders={resolution: 1.0e-6}", "estimator={rate: 20.0}"))
    assert own.estimator.state_rate is None


def test_a_roughness_without_use_is_refused():
    with pytest.raises(ScenarioError, match="encoders"):
        chosen(two_link("law.largest_roughness=1.0"))
    with pytest.raises(ScenarioError, match="-1"):
        chosen(two_link("sensors.encoders={resolution: 1.0e-5}", "law.largest_roughness=-1.0"))


def test_largest_errors_bound_what_is_predicted_or_say_what_forbids_them():
    free, bound = (
        advice(two_link("sensors.encoders={resolution: 1.0e-5}", *more))
        for more in ((), ("law.largest_errors={position: 1.0e-3}",))
    )
    assert bound.scenario.law.gains.outputs["tool.z"] < free.scenario.law.gains.outputs["tool.z"]
    assert bound.scenario.law.largest_errors is None
    with pytest.raises(ScenarioError, match="gains: "):
        chosen(
            two_link(
                "sensors.encoders={resolution: 1.0e-5}", "law.largest_errors={position: 1.0e-7}"
            )
        )
    with pytest.raises(ScenarioError, match="largest_errors: "):
        chosen(two_link("law.largest_errors={force: 0.1}"))
    with pytest.raises(ScenarioError, match="force"):
        chosen(two_link("sensors.encoders={resolution: 1.0e-5}", "law.largest_errors={force: 0}"))


def test_the_stated_errors_are_those_of_the_linear_model_and_the_bias_of_the_sensor():
    """Gains are rounded to three digits."""
    found = two_link(
        "sensors.encoders={resolution: 1.0e-5}", "sensors.force={sample_period: 1.0e-3, bias: 0.7}"
    )
    model = scenario_model(found)
    structure = scenario_structure(model)
    efforts = model.control_limits[np.isfinite(model.control_limits)]
    best = advised_gains(sensed_contact(found, model, structure, 1e5), 3e-3 * efforts.max())
    position, force = stated_errors(advised(found, model, structure).scenario, model, structure)
    assert position == pytest.approx(best.free.error, rel=0.01)
    assert force == pytest.approx(np.hypot(best.contact.error, 0.7), rel=0.01)


@pytest.mark.slow
def test_a_run_beyond_twice_its_stated_errors_says_which_assumption_failed():
    """A force of 20 + 5 sin(w t): 5 w / sqrt(2) N/s rms, of which 10 N/s are assumed."""
    told = {}
    for frequency in (1.0, 40.0):
        wanted = f"!Sinusoids {{offset: 20, amplitudes: [5], frequencies: [{frequency}]}}"
        moves = f"references={{tool.z: 0.3, wall.force: {wanted}}}"
        completed, loop = build_completed(two_link(moves, "duration=0.8", "plant.friction=0"))
        context = start_scenario(completed.scenario, loop)
        simulate(loop.diagram, context, 0.8, completed.scenario.integrator)
        told[frequency] = judge_run(completed.scenario, loop, context, loop.record(context)).notes
    assert not told[1.0]
    slope = float(re.search(r"changes by (\S+) N/s rms", told[40.0][-1])[1])
    assert slope == pytest.approx(5.0 * 40.0 / 2.0**0.5, rel=0.1)


@pytest.mark.slow
def test_scenario_as_run_says_all_and_needs_no_advice(tmp_path):
    run = chosen(two_link("constraints.0.friction=0.0"))
    save_scenario(run, tmp_path / "run.yaml")
    again = load_scenario(tmp_path / "run.yaml")
    assert again == run
    completed, _ = build_completed(again)
    assert completed.notes == ()
    assert completed.scenario == run


def test_nothing_is_advised_behind_springs():
    springs = "actuation=[!FlexibleJoints {stiffness: 8000.0, inertia: 1.0}]"
    found = two_link(springs, "plant=!CompliantContact {}")
    with pytest.raises(ScenarioError, match="gains: ") as told:
        advice(found)
    assert "wall_flexible_contact" in str(told.value)


def test_friction_that_jams_the_contact_is_told():
    """mu A_nt = A_nn at the start, which the path hardly leaves, in one direction of sliding."""
    wave = "!Sinusoids {offset: 0.3, amplitudes: [0.005], frequencies: [3]}"
    moves = f"references={{tool.z: {wave}, wall.force: 20}}"
    given = "constraints.0.friction=0", "duration=2.1", moves
    completed, loop = build_completed(two_link(*given, "plant.friction=1.3"))
    known = numbers("two_link", loop.plant.structure.states[0][:2], np.zeros(2))
    moved = np.linalg.solve(known.mass, known.constraint_jacobian[0])
    critical = abs(known.constraint_jacobian[0] @ moved / (known.output_jacobian[0] @ moved))
    told = re.search(r"wall\.friction of (\S+) or more", completed.notes[1])
    assert float(told[1]) == pytest.approx(critical, rel=0.1)
    free, _ = build_completed(two_link(*given, f"plant.friction={0.8 * critical}"))
    assert len(free.notes) == 1


@pytest.mark.slow
def test_gains_without_a_margin_are_told():
    """Of half the stiffness, for which twice of it are stable; none are a problem before a run."""
    sensed = "sensors.encoders={resolution: 1.0e-5}", "sampling={period: 4.0e-3, delay: 4.0e-3}"

    def at_stiffness(stiffness: float) -> Completed:
        return advice(two_link(*sensed, f"plant.stiffness={stiffness}"))

    stable, bare = at_stiffness(2e5), at_stiffness(8e5)
    assert "stated stiffness" not in stable.notes[0]
    assert "those of 2e+05 N/m" in bare.notes[0]
    assert bare.scenario.law.gains == stable.scenario.law.gains


@pytest.mark.slow
def test_gains_without_a_margin_run():
    """16 times stiffer than what has a margin: it oscillates by 2.7 rad in a sample.

    Measured: 0.79 mm and 0.25 N. The dissipation of Drake's contact damps it.
    """
    sensed = "sensors.encoders={position_noise: 1.0e-5}", "sampling={period: 4.0e-3, delay: 4.0e-3}"
    plant = "plant=!CompliantContact {time_step: 4.0e-3, stiffness: 3.0e+6, friction: 0.3}"
    completed, loop = build_completed(
        load_scenario("two_link_wall", ["law={}", plant, *sensed, "duration=4"])
    )
    run = roll_scenario(completed.scenario, loop, start_scenario(completed.scenario, loop))
    assert run.failure is None
    record, late = run.record, run.record.time > 2.0
    errors = (record["controlled_output"] - record["desired_output"])[late]
    np.testing.assert_array_less(np.sqrt(np.mean(errors**2, axis=0)), [1.5e-3, 0.5])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["estimator={rate: -1}"], "rate"),
        (["estimator={rate: 5, parameters: [wal.friction]}"], "'wal.friction'"),
        (["estimator={rate: 5, parameters: [wall.friction]}"], "friction"),
        (["estimator={rate: 5}", "law.gains={all: [-9]}"], "measured force"),
        (["estimator={rate: 5}", "sampling=", "plant=!IdealConstraints {}"], "observe"),
    ],
)
def test_observer_that_does_not_fit_is_refused(settings, message):
    with pytest.raises(ScenarioError, match=message):
        build_scenario(two_link(*settings))


def test_levers_and_mobilities_are_those_of_multibody_plant():
    """Of the point and of the wall; the matrices of MultibodyPlant alone, to round-off."""
    found = two_link("sensors.encoders={resolution: 1.0e-4}")
    model = scenario_model(found)
    structure = scenario_structure(model)
    sensed = sensed_contact(found, model, structure, 1e5)
    known = numbers("two_link", *np.split(structure.states[0], 2))
    inverse, rows = np.linalg.inv(known.mass), (known.output_jacobian, known.constraint_jacobian)
    levers, mobilities = zip(
        *((np.linalg.norm(J), (J @ inverse @ J.T).item()) for J in rows), strict=True
    )
    assert (sensed.lever, sensed.contact_lever) == pytest.approx(levers)
    assert (sensed.free_mobility, sensed.mobility) == pytest.approx(mobilities)
    assert sensed.inertia == pytest.approx(np.linalg.norm(known.mass))
    assert sensed.noise.position == pytest.approx(1e-4 / 12.0**0.5)
    assert sensed.estimates
