"""Any Drake diagram as a page: what is shown, changed and pushed."""

from functools import cache

import casadi as ca
import numpy as np
import pytest
from browser import in_page, needs_chromium
from by_inputs import set_inputs
from pydrake.examples import PendulumPlant
from pydrake.geometry import SceneGraph
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import Adder, ConstantVectorSource, Gain

import drake_dae as dd
from drake_dae import shipped_model, write_page
from drake_dae.errors import ModelError
from drake_dae.robots import KnownWrench
from drake_dae.running.bench.description import bench_of, shown_function

FIXED = SimulatorConfig(
    integration_scheme="runge_kutta5", max_step_size=1e-3, use_error_control=False
)


@cache
def pendulum():
    """Drake's pendulum under a constant torque; no robot of ours, no geometry, no names."""
    builder = DiagramBuilder()
    plant, torque = (
        builder.AddSystem(PendulumPlant()),
        builder.AddSystem(ConstantVectorSource([0.5])),
    )
    builder.Connect(torque.get_output_port(), plant.get_input_port())
    builder.ExportOutput(plant.get_state_output_port(), "state")
    return builder.Build()


def drakes_arm():
    """A MultibodyPlant of Drake's, whose torque is a free input."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.0)
    Parser(plant).AddModels(str(shipped_model("two_link_arm.urdf")))
    plant.Finalize()
    builder.ExportInput(plant.get_actuation_input_port(), "torque")
    builder.ExportOutput(plant.get_state_output_port(), "state")
    return builder.Build()


def wired_by_hand(with_geometry=True):
    """A robot under its law with a gain between, wired by hand, and its context on the wall."""
    drawn, scene_graph = MultibodyPlant(0.0), SceneGraph()
    drawn.RegisterAsSourceForSceneGraph(scene_graph)
    Parser(drawn, scene_graph).AddModels(str(shipped_model("two_link_arm.urdf")))
    drawn.Finalize()
    wall = dd.PointOnSurface("tool", dd.Plane((1.2, 0, 0), (-1, 0, 0)), name="wall", friction=0.0)
    model = dd.RobotModel.from_multibody(
        drawn,
        [wall],
        outputs=[dd.PointCoordinates("tool", "z")],
        nominal_positions=[1.2, -1.6],
        known_forces=[KnownWrench("link2", name="push.two_link_arm::link2")],
    )
    law = dd.TrackingLaw(model.dae, dd.poles(-4.0))
    references = [dd.SinusoidReference(0.3, 0.3, 1.5), dd.SinusoidReference(20.0, 5.0, 2.0)]
    builder = DiagramBuilder()
    robot = builder.AddSystem(dd.RobotPlant(model, structure=law.structure))
    controller = builder.AddSystem(dd.TrackingController(law))
    wanted = builder.AddSystem(dd.ReferenceGenerator(references, law.degrees))
    gain, total = builder.AddSystem(Gain(0.97, 2)), builder.AddSystem(Adder(2, 2))
    builder.Connect(robot.GetOutputPort("state"), controller.GetInputPort("estimated_state"))
    builder.Connect(wanted.GetOutputPort("reference"), controller.GetInputPort("reference"))
    builder.Connect(controller.GetOutputPort("control"), gain.get_input_port())
    builder.Connect(gain.get_output_port(), total.get_input_port(0))
    builder.ExportInput(total.get_input_port(1), "disturbance")
    builder.Connect(total.get_output_port(), robot.GetInputPort("control"))
    builder.ExportOutput(robot.GetOutputPort("controlled_output"), "outputs")
    builder.ExportOutput(total.get_output_port(), "torques")
    if with_geometry:
        builder.AddSystem(scene_graph)
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    start = [*model.configuration([0.35], guess=[1.2, -1.6]), 0.0, 0.0]
    robot.set_consistent_state(robot.GetMyMutableContextFromRoot(context), start)
    return diagram, context, robot


def test_a_diagram_without_a_robot_has_sliders_of_its_numbers():
    data = bench_of(pendulum(), pendulum().CreateDefaultContext(), "pendulum").data
    sliders = {each["label"]: each for each in data["controls"]}
    torque = sliders["ConstantVectorSource.parameter[0]"]
    gravity = sliders["PendulumPlant.parameter[3]"]
    assert (torque["low"], torque["value"], torque["high"]) == (-2.0, 0.5, 2.0)
    assert (gravity["low"], gravity["value"], gravity["high"]) == (0.0, 9.81, 30.0)
    assert (data["bodies"], data["constraints"], data["pushes"]) == ([], [], {})


def scene_of(bench):
    """The column of the scene at the start."""
    values = {
        name: port.Eval(port.get_system().GetMyContextFromRoot(bench.context))
        for name, port in bench.ports.items()
    }
    columns = {name: ca.SX.sym(name, value.size) for name, value in values.items()}
    inputs = bench.controls.inputs.values(bench.context)
    symbols = ca.SX.sym("inputs", inputs.size)
    value = shown_function(bench, columns, symbols)
    return ca.Function("scene", [*columns.values(), symbols], [value])(
        *values.values(), inputs
    ).full()[:, 0]


@pytest.mark.slow
def test_a_robot_in_a_diagram_has_its_links_contact_and_sliders():
    diagram, context, robot = wired_by_hand()
    bench = bench_of(diagram, context, "arm")
    data, column = bench.data, scene_of(bench)
    labels = [each["label"] for each in data["controls"]]
    assert labels[:2] == ["disturbance[0]", "disturbance[1]"]
    assert {"wall.friction", "link1.mass", "link2.mass", "pole of all errors"} <= set(labels)
    (mass,) = (each for each in data["controls"] if each["label"] == "link2.mass")
    assert bench.controls.inputs.names[mass["known"][0]] == "tracking_controller.link2.mass"
    assert [each["name"] for each in data["constraints"]] == ["wall"]
    assert [each["name"] for each in data["outputs"]] == [
        "tool.z", "wall.force", "torques[0]", "torques[1]"
    ]  # fmt: skip
    own = robot.GetMyContextFromRoot(bench.context)
    drawn = robot.model.links.plant
    at = drawn.CreateDefaultContext()
    drawn.SetPositions(at, robot.state(own)[:2])
    pose = drawn.EvalBodyPoseInWorld(at, drawn.GetBodyByName("link2"))
    wanted = np.append(pose.rotation().matrix().flatten("F"), pose.translation())
    np.testing.assert_allclose(column[12:24], wanted, atol=1e-12)
    force = float(robot.GetOutputPort("constraint_force").Eval(own)[0])
    np.testing.assert_allclose(column[27:30], [-force, 0.0, 0.0], atol=1e-9)
    assert data["notes"] == []
    without = bench_of(*wired_by_hand(with_geometry=False)[:2], "arm").data
    assert without["bodies"] == []
    assert "builder.AddSystem(scene_graph)" in without["notes"][0]


def test_what_a_bench_cannot_show_is_refused(tmp_path):
    builder = DiagramBuilder()
    builder.AddSystem(ConstantVectorSource([1.0]))
    with pytest.raises(ModelError, match="ExportOutput"):
        write_page(builder.Build(), None, tmp_path / "no.html")
    with pytest.raises(ModelError, match="MultibodyPlant"):
        write_page(drakes_arm(), None, tmp_path / "no.html")
    assert not (tmp_path / "no.html").exists()


@pytest.mark.slow
@needs_chromium
def test_the_page_of_a_diagram_computes_what_the_simulator_does(tmp_path):
    pytest.importorskip("ziglang")
    diagram, context, _ = wired_by_hand()
    (file,) = write_page(diagram, context, tmp_path / "arm.html", FIXED, "by hand")
    body = """
      await run(0.25);
      slide("disturbance[0]", 0.8);
      slide("link2.mass", 9);
      await run(0.25);
      return { z: now().z, r: now().r, scene: now().scene, title: document.title,
        options: document.getElementById("bench-error").length };
    """
    found = in_page(file.read_text(), body, file)
    simulator = Simulator(diagram, context)
    ApplySimulatorConfig(FIXED, simulator)
    set_inputs(diagram, context, {"disturbance[0]": 0.0})
    simulator.AdvanceTo(0.25)
    set_inputs(diagram, context, {"disturbance[0]": 0.8, "robot.link2.mass": 9.0})
    simulator.AdvanceTo(0.5)
    wanted = np.concatenate(
        [diagram.GetOutputPort(name).Eval(context) for name in ("outputs", "torques")]
    )
    # The same method and steps, in the order of another compiler.
    np.testing.assert_allclose(found["z"], wanted, atol=1e-9)
    assert found["r"] == [None] * 4
    assert found["title"] == "by hand"
    assert found["options"] == 4
