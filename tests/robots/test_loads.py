"""Known forces on frames, against MultibodyPlant."""

import casadi as ca
import numpy as np
import pytest
from arms import arm, parse
from numpy.testing import assert_allclose
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce

from drake_dae import RobotModel, RobotPlant, load_scenario
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


def test_frames_that_are_not_there_are_named():
    with pytest.raises(ModelError, match="'tol'"):
        pushed(frame="tol")
    settings = ["robot.known_forces=[{frame: tol}]"]
    with pytest.raises(ScenarioError, match=r"robot.known_forces.0: .*'tol'"):
        build_scenario(load_scenario(find_scenario("two_link_wall"), settings))
