"""The rules of `Plant`, on every member: those of the package and one of `members`."""

import os
from functools import cache
from pathlib import Path

import members
import numpy as np
import pytest
from arms import arm, fixed_step
from members import SpringyPlant
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

import drake_dae as dd
from drake_dae.diagrams.closed_loop import log_steps
from drake_dae.diagrams.record import Record
from drake_dae.errors import ModelError, ScenarioError
from drake_dae.scenario.robot_file.reading import read_robot
from drake_dae.scenario.shipped import find_scenario
from drake_dae.studies.study import Outcome
from drake_dae.systems import PointMaterial
from drake_dae.systems.plant import Plant


def contact():
    found = arm("two_link")
    robot = dd.load_scenario(find_scenario("two_link_wall")).robot
    return dd.ContactPlant(
        found.model,
        lambda plant, scene_graph: read_robot(robot, plant, scene_graph),
        dd.ContactMaterial(),
        structure=found.structure,
    )


MEMBERS = {
    "dae": lambda: dd.DaePlant(arm("two_link").model.dae, structure=arm("two_link").structure),
    "robot": lambda: dd.RobotPlant(arm("two_link").model, structure=arm("two_link").structure),
    "contact": contact,
    "compliant": lambda: dd.CompliantPlant(
        arm("two_link").model, PointMaterial(), structure=arm("two_link").structure
    ),
    "compliant, continuous": lambda: dd.CompliantPlant(
        arm("two_link").model, PointMaterial(0.0), structure=arm("two_link").structure
    ),
    "springy": lambda: SpringyPlant(arm("two_link").model, arm("two_link").structure),
}


def test_no_member_is_left_out():
    def below(cls):
        own = cls.__subclasses__()
        return {*own}.union(*map(below, own))

    made = {type(make()) for make in MEMBERS.values()}
    package = {cls for cls in below(Plant) if cls.__module__.startswith("drake_dae")}
    assert len(package) == 4
    assert package <= made


@pytest.fixture(params=MEMBERS)
def plant(request):
    return MEMBERS[request.param]()


def signals_of(plant):
    """Name of an output port -> its signals."""
    return {
        "state": plant.dae.state_signals,
        "constraint_force": plant.dae.force_signals,
        "constraint_residual": plant.structure.manifold.residual_signals,
        "controlled_output": plant.dae.output_signals,
        **plant.further_signals,
    }


def run_of(plant, duration=0.02):
    """The plant, its diagram, its context and what was logged, with a control that stands still."""
    builder = DiagramBuilder()
    builder.AddSystem(plant)
    source = builder.AddSystem(ConstantVectorSource([20.0, 10.0]))
    builder.Connect(source.get_output_port(), plant.GetInputPort("control"))
    ports = signals_of(plant)
    log = log_steps(builder, list(map(plant.GetOutputPort, ports)), plant)
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    own = plant.GetMyMutableContextFromRoot(context)
    plant.set_consistent_state(own, plant.dae.nominal_state)
    dd.simulate(diagram, context, duration, fixed_step())
    return own, Record.from_log(log, ports, context)


def test_rule_1_ports(plant):
    assert plant.GetInputPort("control").size() == plant.dae.num_controls
    for name, signals in signals_of(plant).items():
        assert plant.GetOutputPort(name).size() == len(signals), name


def test_rule_2_system_and_robot(plant):
    assert plant.structure.system is plant.dae
    if plant.model is None:
        with pytest.raises(ModelError, match="RobotPlant"):
            plant.robot("an animation")
        return
    assert plant.robot("an animation") is plant.model
    assert plant.model.dae.state_signals == plant.dae.state_signals
    links = plant.model.links
    assert plant.GetOutputPort("link_state").size() == links.q.numel() + links.v.numel()


def test_rule_3_state_and_steps(plant):
    """A plant logs a sample at each step of 1 ms, its own or the integrator's, and at the end."""
    own, record = run_of(plant)
    assert plant.time_step >= 0.0
    assert record.time.size == 21
    np.testing.assert_array_equal(plant.GetOutputPort("state").Eval(own), plant.state(own))


def test_rule_5_exogenous_signals(plant):
    assert not plant.exogenous_layout.degrees  # Of this robot nothing moves.
    assert list(plant.exogenous_places) == []
    assert not plant.HasInputPort("exogenous")


def test_rule_6_parameters(plant):
    context = plant.CreateDefaultContext()
    before = plant.parameters(context)
    np.testing.assert_array_equal(before, plant.dae.parameter_values)
    np.testing.assert_array_equal(plant.current_parameters(context), before)
    with pytest.raises(ModelError, match="nothing"):
        plant.set_parameter(context, "nothing", 1.0)
    place = plant.dae.parameter_slice("link2.mass")
    if isinstance(plant, dd.ContactPlant | SpringyPlant):  # A test knows its members.
        with pytest.raises(ModelError, match=type(plant).__name__):
            plant.set_parameter(context, "link2.mass", 6.0)
        np.testing.assert_array_equal(plant.parameters(context), before)
    else:
        plant.set_parameter(context, "link2.mass", 6.0)
        assert plant.parameters(context)[place] == 6.0


def test_rule_7_starts(plant):
    context, nominal = plant.CreateDefaultContext(), plant.dae.nominal_state
    plant.set_state(context, nominal)
    np.testing.assert_array_equal(plant.state(context), nominal)
    found = plant.set_consistent_state(context, nominal)
    np.testing.assert_array_equal(plant.state(context), found)
    assert plant.structure.manifold.is_consistent(found)
    with pytest.raises(ModelError, match=r"\(\d+,\)"):
        plant.set_state(context, nominal[:-1])


def test_rules_3_and_8_projection_and_contact(plant):
    """Fixed steps of 1 ms leave N* by less than 1e-9, and by no more than round-off with it."""
    _, record = run_of(plant)
    if plant.is_ideal:
        assert np.max(np.abs(record["constraint_residual"])) < 1e-9
    else:  # A contact that gives way is pressed in.
        assert np.max(np.abs(record["constraint_residual"])) > 1e-6


@cache
def arm_law():
    return dd.TrackingLaw(
        arm("two_link").model.dae, dd.poles(-4.0), structure=arm("two_link").structure
    )


@pytest.fixture(scope="module")
def meshcat():
    return dd.start_meshcat()


@pytest.mark.slow
def test_every_member_goes_through_a_loop(plant, meshcat):
    """Wiring, a run, its record, live view and picture; the ideal ones follow theory.

    From N* on, with steps of 1 ms, RK5 leaves less than 1e-8 of errors of 5 cm.
    """
    references = [dd.ConstantReference(0.3), dd.ConstantReference(20.0)]
    loop = dd.make_closed_loop(plant, arm_law(), references, meshcat=meshcat)
    context = loop.diagram.CreateDefaultContext()
    q = arm("two_link").model.configuration([0.35], [1.2, -1.6])
    own = plant.GetMyMutableContextFromRoot(context)
    plant.set_consistent_state(own, [*q, 0.0, 0.0])
    dd.simulate(loop.diagram, context, 0.1, fixed_step())
    record = loop.record(context)
    assert {"state", "constraint_force", "reference", "control", "tracking_error"} <= {
        *record.signals
    }
    if plant.is_ideal:
        np.testing.assert_allclose(
            record["tracking_error"], loop.predicted_error(record), atol=1e-8
        )
    is_drawn = loop.diagram.HasSubsystemNamed("constraint_force_visualizer")
    assert is_drawn is (plant.model is not None)
    if plant.model is not None:
        assert "<html" in dd.make_animation(loop, record, context)


def test_a_plant_from_outside_springs_back_as_its_equation_says():
    """k = k_0 (1 + a t) exp(-a t) from k' = 0; RK5 with 1 ms leaves 1e-9 of it."""
    plant = MEMBERS["springy"]()
    loop = dd.make_closed_loop(
        plant, arm_law(), [dd.ConstantReference(0.3), dd.ConstantReference(20.0)]
    )
    context = loop.diagram.CreateDefaultContext()
    own = plant.GetMyMutableContextFromRoot(context)
    state = plant.set_consistent_state(own, plant.dae.nominal_state)
    plant.set_state(own, state + np.array([1e-3, 0.0, 0.0, 0.0]))
    dd.simulate(loop.diagram, context, 0.2, fixed_step())
    record = loop.record(context)
    k, at = record["constraint_residual"][:, 0], 40.0 * record.time
    np.testing.assert_allclose(k, k[0] * (1.0 + at) * np.exp(-at), atol=1e-6 * abs(k[0]))


def test_rule_8_friction(plant):
    context = plant.CreateDefaultContext()
    names = [] if plant.model is None else [one.name for one in plant.model.constraints]
    found = plant.friction(context)
    assert set(found) <= set(names)
    assert all(value >= 0.0 for value in found.values())


@pytest.mark.slow
def test_a_plant_from_outside_is_run_by_a_scenario_and_by_a_sweep(tmp_path, monkeypatch):
    """Named in the file alone. Its errors are those of the package's plant, to the accuracy."""
    places = [str(Path(members.__file__).parent), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, places)))  # Of other processes.
    settings = ["duration=0.1", "integrator.accuracy=1e-8"]
    path = find_scenario("two_link_wall")
    changes = [{"start.errors": {"tool.z": 0.05}}, {"start.errors": {"tool.z": 0.02}}]
    found = []
    for kind in ("!OwnPlant {maker: 'members:SpringyPlant'}", "!IdealConstraints {}"):
        scenario = dd.load_scenario(path, [*settings, f"plant={kind}"])
        study = dd.sweep(scenario, changes, tmp_path / f"{len(found)}.db", workers=1)
        assert {run.outcome for run in study.results} == {Outcome.FINISHED}, study.results
        found.append([run.figures["largest error of tool.z [m]"] for run in study.results])
    np.testing.assert_allclose(found[0], found[1], rtol=1e-5)


@pytest.mark.parametrize(
    ("maker", "told"),
    [
        ("members", "plant.maker: "),
        ("no_such_module:Plant", r"plant\.maker: .*'no_such_module:Plant'"),
        ("members:NoSuchPlant", r"plant\.maker: .*'NoSuchPlant'"),
    ],
)
def test_a_plant_that_cannot_be_loaded_is_refused_with_its_key(maker, told):
    with pytest.raises(ScenarioError, match=told):
        dd.build_scenario(
            dd.load_scenario(
                find_scenario("two_link_wall"), [f"plant=!OwnPlant {{maker: '{maker}'}}"]
            )
        )
