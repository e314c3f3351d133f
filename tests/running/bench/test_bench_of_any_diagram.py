"""Any Drake diagram as a bench: what is shown, changed, pushed, replayed and exported."""

import json
import re
from functools import cache

import numpy as np
import pytest
from browser import in_page, needs_chromium
from pydrake.examples import PendulumPlant
from pydrake.geometry import SceneGraph
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import Adder, ConstantVectorSource, Gain
from scipy.integrate import solve_ivp

import drake_dae as dd
from drake_dae import Commands, replay, shipped_model, write_page
from drake_dae.errors import ModelError
from drake_dae.running.bench.description import bench_of
from drake_dae.running.bench.live import Server
from drake_dae.running.bench.run import HandRun, Sampler

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


@cache
def drakes_arm():
    """A MultibodyPlant of Drake's, whose SceneGraph poses it, and whose torque is a free input."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.0)
    Parser(plant).AddModels(str(shipped_model("two_link_arm.urdf")))
    plant.Finalize()
    builder.ExportInput(plant.get_actuation_input_port(), "torque")
    builder.ExportOutput(plant.get_state_output_port(), "state")
    return builder.Build(), plant


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
        known_forces=[dd.KnownWrench("link2", name="push.two_link_arm::link2")],
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


def test_a_slider_of_a_diagram_without_a_robot_changes_its_equation():
    with Server(pendulum()) as server:
        data = json.loads(re.search(r"const data = (.*);\n", server.page)[1])
        sliders = {each["label"]: each for each in data["controls"]}
        torque = sliders["ConstantVectorSource.parameter[0]"]
        gravity = sliders["PendulumPlant.parameter[3]"]
        assert (torque["low"], torque["value"], torque["high"]) == (-2.0, 0.5, 2.0)
        assert (gravity["low"], gravity["value"], gravity["high"]) == (0.0, 9.81, 30.0)
        assert (data["bodies"], data["constraints"], data["pushes"]) == ([], [], {})
        before = server.answer("advance", {"ticks": 30, "set": []})["samples"][-1]["z"]
        change = [[torque["inputs"][0], -1.0], [gravity["inputs"][0], 3.0]]
        after = server.answer("advance", {"ticks": 60, "set": change})["samples"][-1]
        record = server.run.record()
    assert after["r"] == [None, None]
    assert record.time.size == 91
    np.testing.assert_array_equal(record["state"][-1], after["z"])

    def motion(u, g):  # m l^2 q'' = u - d q' - m g l sin q, with m 1, l 0.5, d 0.1
        return lambda t, x: [x[1], (u - 0.1 * x[1] - 0.5 * g * np.sin(x[0])) / 0.25]

    first = solve_ivp(motion(0.5, 9.81), (0.0, 0.25), [0.0, 0.0], rtol=1e-10, atol=1e-12).y[:, -1]
    second = solve_ivp(motion(-1.0, 3.0), (0.0, 0.5), first, rtol=1e-10, atol=1e-12).y[:, -1]
    # The Simulator has its default accuracy of 1e-3 a step.
    np.testing.assert_allclose(before, first, atol=2e-3)
    np.testing.assert_allclose(after["z"], second, atol=5e-3)


def test_links_of_drakes_own_plant_are_drawn_where_they_are_and_pushed():
    diagram, plant = drakes_arm()
    context = diagram.CreateDefaultContext()
    plant.SetPositions(plant.GetMyMutableContextFromRoot(context), [0.4, -0.9])
    bench = bench_of(diagram, context, "arm")
    assert [each["name"] for each in bench.data["bodies"]] == [
        "two_link_arm::base",
        "two_link_arm::link1",
        "two_link_arm::link2",
    ]
    scene = Sampler(bench)(bench.context)["scene"]
    own = plant.GetMyContextFromRoot(context)
    pose = plant.EvalBodyPoseInWorld(own, plant.GetBodyByName("link2"))
    wanted = np.append(pose.rotation().matrix().flatten("F"), pose.translation())
    np.testing.assert_allclose(scene[24:36], wanted, atol=1e-12)
    # A push is J^T F beside the bias of gravity, at rest.
    run, force = HandRun(diagram, context, FIXED, tick=1e-4), np.array([30.0, 0.0, -20.0])
    place = bench.data["pushes"]["two_link_arm::link2"]["input"]
    names = [f"plant.push.two_link_arm::link2.force[{k}]" for k in range(3)]
    assert run.inputs.names[place : place + 3] == names
    run.set({place + k: x for k, x in enumerate(force)})
    np.testing.assert_array_equal(run.inputs.values(run.context)[place : place + 3], force)
    run.advance()
    world, frame = plant.world_frame(), plant.GetBodyByName("link2").body_frame()
    J = plant.CalcJacobianTranslationalVelocity(
        own, JacobianWrtVariable.kV, frame, np.zeros(3), world, world
    )
    torque = J.T @ force + plant.CalcGravityGeneralizedForces(own)
    rate = np.linalg.solve(plant.CalcMassMatrix(own), torque)
    # Over 0.1 ms the rate changes by less than a thousandth.
    v = plant.GetVelocities(plant.GetMyContextFromRoot(run.context))
    np.testing.assert_allclose(v / 1e-4, rate, rtol=2e-3)


@pytest.mark.slow
def test_a_robot_in_a_diagram_has_its_links_contact_and_sliders():
    diagram, context, robot = wired_by_hand()
    bench = bench_of(diagram, context, "arm")
    data, column = bench.data, Sampler(bench)(bench.context)["scene"]
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


def test_commands_of_a_diagram_are_replayed_exactly():
    diagram, context, _ = wired_by_hand()
    commands = Commands([(3, "disturbance[1]", 4.0), (5, "robot.link2.mass", 8.0)], end=12)
    one, other = (replay(diagram, context, commands, FIXED) for _ in range(2))
    np.testing.assert_array_equal(one["outputs"], other["outputs"])
    plain = replay(diagram, context, Commands([], end=12), FIXED)
    np.testing.assert_array_equal(one["outputs"][:4], plain["outputs"][:4])
    assert abs(one["torques"][-1] - plain["torques"][-1]).max() > 1.0
    assert [s.name for s in one.signals["outputs"].signals] == ["tool.z", "wall.force"]


def test_what_a_bench_cannot_show_is_refused(tmp_path):
    builder = DiagramBuilder()
    builder.AddSystem(ConstantVectorSource([1.0]))
    with pytest.raises(ModelError, match=r"no output port with a vector.*ExportOutput"):
        Server(builder.Build())
    with pytest.raises(ModelError, match=r"Drake's own MultibodyPlant.*cannot be traced"):
        write_page(drakes_arm()[0], None, tmp_path / "no.html")
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
    commands = [(30, "disturbance[0]", 0.8), (30, "robot.link2.mass", 9.0)]
    record = replay(diagram, context, Commands(commands, end=60), FIXED)
    wanted = np.concatenate([record["outputs"][-1], record["torques"][-1]])
    # The same method and steps, in the order of another compiler.
    np.testing.assert_allclose(found["z"], wanted, atol=1e-9)
    assert found["r"] == [None] * 4
    assert found["title"] == "by hand"
    assert found["options"] == 4
