"""Known forces on frames, against MultibodyPlant."""

import casadi as ca
import numpy as np
import pytest
from arms import arm, error_controlled, parse
from numpy.testing import assert_allclose
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator

from drake_dae import (
    ExpressionReference,
    FlexibleJoints,
    RobotModel,
    RobotPlant,
    SinusoidReference,
    TrackingLaw,
    load_scenario,
    make_closed_loop,
    poles,
)
from drake_dae.diagrams import LoopSettings
from drake_dae.errors import ModelError, ScenarioError
from drake_dae.robots import KnownForce, KnownWrench
from drake_dae.scenario.build import build_scenario
from drake_dae.scenario.shipped import find_scenario


def pushed(exogenous=(), frame="tool", actuation=()):
    """The two-link arm on its wall with a known force on its tool."""
    known = arm("two_link").model
    load = KnownForce(frame, (0.05, 0.0, 0.1), name="push")
    return RobotModel.from_multibody(
        parse("two_link_arm"),
        known.constraints,
        known.outputs,
        [1.2, -1.6],
        actuation=actuation,
        exogenous=exogenous,
        known_forces=[load],
    )


def test_a_force_acts_as_drake_applies_it():
    """v' of a free arm with the same force as an ExternallyAppliedSpatialForce: round-off."""
    known = arm("two_link").model
    model = RobotModel.from_multibody(
        parse("two_link_arm"),
        [],
        known.outputs[:0],
        [1.2, -1.6],
        known_forces=pushed().known_forces,
    )
    plant, drake = RobotPlant(model), parse("two_link_arm")
    force, state = np.array([3.0, -2.0, 7.0]), np.array([0.3, -1.1, 0.4, 0.7])
    context = plant.CreateDefaultContext()
    plant.set_parameter(context, "push.force", force)
    plant.set_state(context, state)
    plant.GetInputPort("control").FixValue(context, [1.0, -2.0])

    own = drake.CreateDefaultContext()
    drake.SetPositionsAndVelocities(own, state)
    drake.get_actuation_input_port().FixValue(own, [1.0, -2.0])
    frame = drake.GetFrameByName("tool")
    applied = ExternallyAppliedSpatialForce()
    applied.body_index = frame.body().index()
    applied.p_BoBq_B = frame.GetFixedPoseInBodyFrame() @ np.array([0.05, 0.0, 0.1])
    applied.F_Bq_W = SpatialForce(np.zeros(3), force)
    drake.get_applied_spatial_force_input_port().FixValue(own, [applied])
    assert_allclose(
        plant.EvalTimeDerivatives(context).CopyToVector(),
        drake.EvalTimeDerivatives(own).CopyToVector(),
        rtol=1e-11,
    )


def test_a_wrench_acts_as_a_force_at_another_point_of_the_link():
    """v' of the arm on its wall: round-off."""
    known, levers = arm("two_link").model, (np.zeros(3), np.array([0.05, 0.0, 0.1]))
    force, state = np.array([3.0, -2.0, 7.0]), known.configuration([0.3], [1.2, -1.6])
    found = []
    for lever, kind in zip(levers, (KnownWrench, KnownForce), strict=True):
        load = kind("tool", lever, name="push")
        model = RobotModel.from_multibody(
            parse("two_link_arm"),
            known.constraints,
            known.outputs,
            [1.2, -1.6],
            known_forces=[load],
        )
        plant = RobotPlant(model)
        context = plant.CreateDefaultContext()
        plant.set_parameter(context, "push.force", force)
        if kind is KnownWrench:
            rotation = model.links.rotation("tool")
            turned = ca.Function("R", [model.links.q], [rotation])(state).full()
            plant.set_parameter(context, "push.moment", np.cross(turned @ levers[1], force))
        plant.set_state(context, [*state, 0.0, 0.0])
        plant.GetInputPort("control").FixValue(context, [1.0, -2.0])
        rate = plant.EvalTimeDerivatives(context).CopyToVector()
        found.append(np.append(rate, plant.GetOutputPort("constraint_force").Eval(context)))
    assert_allclose(found[0], found[1], rtol=1e-11, atol=1e-12)
    assert np.abs(found[0]).max() > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("actuation", [(), (FlexibleJoints(5000.0, inertia=0.5),)])
def test_a_law_that_knows_a_force_compensates_it(actuation):
    """Errors off (30) by the accuracy of 1e-10; a law that does not know it is 1 cm off."""
    push = ExpressionReference(lambda t: [20 * t**5 / (1 + t**5), 0, 10 * t**5 / (1 + t**5)])
    model = pushed(["push.force"], actuation=actuation)
    law = TrackingLaw(model.dae, poles(-6.0))
    goals = [SinusoidReference(0.3, 0.2, 1.5), SinusoidReference(20.0, 5.0, 2.0)]
    plant = RobotPlant(model, structure=law.structure)
    loop = make_closed_loop(plant, law, goals, LoopSettings(exogenous=[push]))
    simulator = Simulator(loop.diagram)
    config = error_controlled(1e-10)
    config.integration_scheme = "runge_kutta5"
    ApplySimulatorConfig(config, simulator)
    context = simulator.get_mutable_context()
    own = plant.GetMyMutableContextFromRoot(context)
    q = model.configuration([0.35], [1.2, -1.6])
    plant.set_consistent_state(own, model.rest_state(q, [20.0]))
    simulator.AdvanceTo(2.0)
    record = loop.record(context)
    off = np.abs(record["tracking_error"] - loop.predicted_error(record)).max(axis=0)
    assert off[0] < 1e-7
    assert off[1] < 1e-4  # Of forces of some 20 N, which springs of 5000 N m/rad amplify.
    assert np.abs(record["exogenous"][-1]).max() > 15.0


def test_frames_that_are_not_there_are_named():
    with pytest.raises(ModelError, match="'tol'"):
        pushed(frame="tol")
    settings = ["robot.known_forces=[{frame: tol}]"]
    with pytest.raises(ScenarioError, match=r"robot.known_forces.0: .*'tol'"):
        build_scenario(load_scenario(find_scenario("two_link_wall"), settings))


def test_a_scenario_has_loads():
    settings = [
        "robot.known_forces=[{frame: tool, name: push}]",
        "plant.parameters={push.force: [0.0, 0.0, -5.0]}",
    ]
    loop, context = build_scenario(load_scenario(find_scenario("two_link_wall"), settings))
    own = loop.plant.GetMyContextFromRoot(context)
    assert_allclose(loop.plant.get_parameter(own, "push.force"), [0.0, 0.0, -5.0])
