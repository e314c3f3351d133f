"""What a page draws, changes and predicts, against MultibodyPlant, laws and their matrices."""

import numpy as np
import pytest
from arms import arm
from combinations import combined, one_in
from runs import scenario

import drake_dae as dd
from drake_dae.errors import ModelError, ScenarioError, WiringError
from drake_dae.pictures.page import Bench, as_script
from drake_dae.robots import ConstraintWrenches
from drake_dae.scenario import build_commanded
from drake_dae.scenario.build import for_rollout


def row_of(bench):
    """Name of an output -> its values at the start."""
    code, context = bench.code, bench.context
    start = code.steps.block.default("state")
    row = code.steps.row(context.get_time(), start, code.held, code.values).full()[:, 0]
    ends = np.cumsum([len(signals) for signals in code.outputs.values()])
    return dict(zip(code.outputs, np.split(row, ends), strict=False))


@pytest.mark.slow
def test_bodies_forces_and_surfaces_are_where_drake_has_them():
    built = build_commanded(scenario("seven_joint_moving_plate"))
    bench = Bench(built.loop, built.context)
    plant, context = built.loop.plant, built.context
    column, robot = row_of(bench)["scene"], bench.robot
    drake, own = plant.model.links.plant, plant.GetMyContextFromRoot(context)
    state = plant.state(own)
    at = drake.CreateDefaultContext()
    drake.SetPositionsAndVelocities(at, state)
    assert len(robot.bodies) == 8
    for k, (name, path, _) in enumerate(robot.bodies):
        pose = drake.EvalBodyPoseInWorld(at, drake.GetBodyByName(name.split("::")[-1]))
        wanted = np.append(pose.rotation().matrix().flatten("F"), pose.translation())
        np.testing.assert_allclose(column[12 * k : 12 * k + 12], wanted, atol=1e-12)
        assert path[:2] == ("drake", "visualizer")
    values, force = plant.current_parameters(own), plant.GetOutputPort("constraint_force").Eval(own)
    wrench = ConstraintWrenches(plant.model)(state, force, values)
    rest = column[12 * len(robot.bodies) :]
    np.testing.assert_allclose(rest[:3], wrench.points[0], atol=1e-12)
    np.testing.assert_allclose(rest[3:6], wrench.forces[0], atol=1e-10)
    names = [p.name for p in robot.surfaces[0].parameters]
    placed = np.concatenate([values[plant.dae.parameter_slice(name)] for name in names])
    stands = robot.surfaces[0].placement(placed)
    wanted = np.append(stands.rotation().matrix().flatten("F"), stands.translation())
    np.testing.assert_allclose(rest[9:21], wanted, atol=1e-12)
    assert len(rest) == 21 + 3 * len(robot.targets)


@pytest.mark.parametrize("integral", [(), ("tool.z",)])
def test_errors_are_predicted_by_the_matrix_of_the_law(integral):
    found = arm("two_link")
    law = dd.TrackingLaw(
        found.model.dae, dd.poles(-3.0), structure=found.structure, integral=integral
    )
    plant = dd.RobotPlant(found.model, structure=found.structure)
    references = {"tool.z": dd.ConstantReference(0.4), "wall.force": 15.0}
    bench = Bench(dd.make_closed_loop(plant, law, references), None)
    told, numbers = bench.predicted, bench.numbers
    E = np.eye(told["size"], k=1)
    E[told["ends"]] = 0.0
    for row, column, place in told["gains"]:
        E[row, column] = -numbers.values[place]
        assert "K of tool.z" in numbers.signals[place].name
    np.testing.assert_allclose(E, law.gains.error_matrix, atol=1e-14)
    assert told["shown"] == [(0, 0, bool(integral))]
    # Without commands there are sliders of parameters; that of the pole gives any other gains.
    assert {each.kind for each in bench.controls} == {"plant", "pole"}
    (pole,) = [each for each in bench.controls if each.kind == "pole"]
    assert pole.value == pytest.approx(-3.0)
    for p in (1.0, 7.5):
        given = np.array(pole.factors) * p ** np.array(pole.powers)
        own = law.all_parameters(None, dd.poles(-p))[-given.size :]
        np.testing.assert_allclose(given, own, rtol=1e-12)


def test_a_mass_is_a_parameter_of_the_plant_and_known_to_the_law():
    built = build_commanded(scenario("two_link_wall"))
    bench = Bench(built.loop, built.context)
    names = [signal.name for signal in bench.numbers.signals]
    places = [names.index(f"{b}.link2.mass") for b in ("two_link_arm", "tracking_controller")]
    (mass,) = [each for each in bench.controls if each.label == "link2.mass"]
    assert (mass.inputs, mass.known, mass.unit) == ((places[0],), (places[1],), "kg")
    # The force that holds the wall depends on the mass of the plant, and not alone on the law's.
    before = row_of(bench)["controlled_output"]
    bench.code.values[places[0]] += 1.0
    assert abs(row_of(bench)["controlled_output"] - before).max() > 1e-3


def test_no_text_ends_a_script():
    assert "</script" not in as_script({"title": "</script>\u2028"})
    with pytest.raises(ModelError, match="finite"):
        as_script([np.nan])


@pytest.mark.slow
def test_a_payload_that_only_the_plant_has_is_not_pushed():
    payload = "plant.payloads=[{frame: tool, mass: 0.5}]"
    built = build_commanded(scenario("two_link_wall", "plant=!CompliantContact {}", payload))
    pushes = Bench(built.loop, built.context).data()["pushes"]
    assert any("link2" in name for name in pushes)
    assert not any("payload" in name for name in pushes)


@pytest.mark.slow
@pytest.mark.parametrize("names", one_in(129), ids=", ".join)
def test_a_page_shows_each_combination_or_says_why_not(names, tmp_path):
    path = combined(names, tmp_path)
    try:
        dd.build_scenario(dd.load_scenario(path))
    except (ScenarioError, WiringError):
        return  # No scenario at all.
    chosen = dd.load_scenario(path)
    if for_rollout(chosen)[0].plant.carries:
        with pytest.raises(ScenarioError, match="CompliantContact"):
            build_commanded(chosen)
        return
    built = build_commanded(chosen)
    assert any("MultibodyPlant" in text for text in built.left_out) == chosen.plant.carries
    if names[2] in ("noise", "force"):
        with pytest.raises(ModelError, match="noise"):
            Bench(built.loop, built.context)
        return
    data = Bench(built.loop, built.context).data()
    assert [len(data[key]) for key in ("bodies", "constraints", "controls")] > [0, 0, 0]
