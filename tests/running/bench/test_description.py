"""What a bench draws, changes and predicts, against MultibodyPlant, laws and their matrices."""

import casadi as ca
import numpy as np
import pytest
from arms import arm
from runs import scenario

from drake_dae import ConstantReference, RobotPlant, TrackingLaw, make_closed_loop, poles
from drake_dae.diagrams import LoopSettings
from drake_dae.errors import ModelError
from drake_dae.robots import ConstraintWrenches
from drake_dae.running.bench.controls import controls_of, prediction
from drake_dae.running.bench.description import as_script, bench_of, shown_function
from drake_dae.running.bench.inputs import Inputs
from drake_dae.scenario.commanded import build_commanded


@pytest.fixture(scope="module")
def moving():
    built = build_commanded(scenario("seven_joint_moving_plate"))
    return built, bench_of(built.loop, built.context, "plate")


def shown(bench, state, force, exogenous):
    """The column of a scene, for outputs of the loop."""
    inputs = bench.controls.inputs.values(bench.context)
    loop = bench.loop
    sizes = {
        "state": len(state),
        "constraint_force": len(force),
        "exogenous": len(exogenous),
        "known_exogenous": loop.exogenous.get_output_port().size(),
        "reference": loop.generator.get_output_port().size(),
    }
    columns = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
    given = ca.SX.sym("inputs", inputs.size)
    value = shown_function(bench, columns, given)
    function = ca.Function("shown", [*columns.values(), given], [value])
    rest = [np.zeros(sizes[name]) for name in ("known_exogenous", "reference")]
    return function(state, force, exogenous, *rest, inputs).full()[:, 0]


@pytest.mark.slow
def test_bodies_forces_and_surfaces_are_where_drake_has_them(moving):
    built, bench = moving
    plant, scene = built.loop.plant, bench.scene
    drake, dae = plant.model.links.plant, plant.dae
    rng = np.random.default_rng(1)
    state, force = rng.uniform(-1.0, 1.0, dae.num_states), np.array([12.0])
    exogenous = rng.uniform(-0.5, 0.5, built.loop.plant_exogenous.get_output_port().size())
    column = shown(bench, state, force, exogenous)
    context = drake.CreateDefaultContext()
    drake.SetPositionsAndVelocities(context, state)
    assert len(scene.links) == 8
    for k, (name, path) in enumerate(scene.links):
        body = drake.GetBodyByName(name.split("::")[-1])
        pose = drake.EvalBodyPoseInWorld(context, body)
        wanted = np.append(pose.rotation().matrix().flatten("F"), pose.translation())
        np.testing.assert_allclose(column[12 * k : 12 * k + 12], wanted, atol=1e-12)
        assert path[:2] == ("drake", "visualizer")
    values = dae.parameter_values
    values[plant.exogenous_places] = exogenous
    wrench = ConstraintWrenches(plant.model)(state, force, values)
    rest = column[12 * len(scene.links) :]
    np.testing.assert_allclose(rest[:3], wrench.points[0], atol=1e-12)
    np.testing.assert_allclose(rest[3:6], wrench.forces[0], atol=1e-11)
    own = np.concatenate(
        [values[dae.parameter_slice(p.name)] for p in scene.robots[0].surfaces[0].parameters]
    )
    stands = scene.robots[0].surfaces[0].placement(own)
    wanted = np.append(stands.rotation().matrix().flatten("F"), stands.translation())
    np.testing.assert_allclose(rest[9:21], wanted, atol=1e-12)
    assert len(rest) == 21 + bench.data["prediction"]["size"]


@pytest.mark.parametrize("integral", [(), ("tool.z",)])
def test_errors_are_predicted_by_the_matrix_of_the_law(integral):
    found = arm("two_link")
    law = TrackingLaw(found.model.dae, poles(-3.0), structure=found.structure, integral=integral)
    plant = RobotPlant(found.model, structure=found.structure)
    references = {"tool.z": ConstantReference(0.4), "wall.force": 15.0}
    loop = make_closed_loop(plant, law, references)
    inputs, context = Inputs.of(loop), loop.diagram.CreateDefaultContext()
    told, values = prediction(loop, inputs), inputs.values(context)
    E = np.eye(told["size"], k=1)
    E[told["ends"]] = 0.0
    for row, column, number in told["gains"]:
        E[row, column] = -values[number]
        assert "K of tool.z" in inputs.names[number]
    np.testing.assert_allclose(E, law.gains.error_matrix, atol=1e-14)
    assert told["shown"] == [(0, 0, bool(integral))]
    # The slider of the pole gives the gains of any other pole.
    (pole,) = [each for each in controls_of(loop, context, 1.0).sliders if each.kind == "pole"]
    assert pole.value == pytest.approx(-3.0)
    for p in (1.0, 7.5):
        given = np.array(pole.factors) * p ** np.array(pole.powers)
        own = law.all_parameters(None, poles(-p))[-given.size :]
        np.testing.assert_allclose(given, own, rtol=1e-12)


def test_a_mass_is_an_input_of_the_plant_and_known_to_the_law():
    built = build_commanded(scenario("two_link_wall"))
    inputs, context = Inputs.of(built.loop), built.context.Clone()
    places = [
        inputs.names.index(f"{block}.link2.mass")
        for block in ("two_link_arm", "tracking_controller")
    ]
    before = inputs.values(context)
    built.loop.plant.set_parameter(
        built.loop.plant.GetMyMutableContextFromRoot(context), "link2.mass", 8.5
    )
    changed = np.flatnonzero(inputs.values(context) != before)
    assert changed.tolist() == places[:1]
    masses = [each for each in controls_of(built.loop, context, 1.0).sliders if each.unit == "kg"]
    assert [(each.inputs, each.known) for each in masses if each.label == "link2.mass"] == [
        ((places[0],), (places[1],))
    ]


def test_no_text_ends_a_script():
    assert "</script" not in as_script({"title": "</script>\u2028"})
    with pytest.raises(ModelError, match="finite"):
        as_script([np.nan])


def test_a_loop_without_commands_has_the_sliders_of_its_parameters():
    found = arm("two_link")
    law = TrackingLaw(found.model.dae, poles(-3.0), structure=found.structure)
    plant = RobotPlant(found.model, structure=found.structure)
    loop = make_closed_loop(plant, law, {"tool.z": 0.4, "wall.force": 15.0}, LoopSettings())
    kinds = [
        each.kind for each in controls_of(loop, loop.diagram.CreateDefaultContext(), 1.0).sliders
    ]
    assert set(kinds) == {"plant", "pole"}


@pytest.mark.slow
def test_a_payload_that_only_the_plant_has_is_not_pushed():
    payload = "plant.payloads=[{frame: tool, mass: 0.5}]"
    built = build_commanded(scenario("two_link_wall", "plant=!CompliantContact {}", payload))
    pushes = bench_of(built.loop, built.context, "arm", ()).data["pushes"]
    assert any("link2" in name for name in pushes)
    assert not any("payload" in name for name in pushes)
