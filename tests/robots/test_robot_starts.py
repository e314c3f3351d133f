"""Starts of robots in Python: without nominal positions, without outputs, in motion."""

import numpy as np
import pytest
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RpyFloatingJoint, SpatialInertia
from vendors import joint, link, robot

from drake_dae import (
    CoincidentPoints,
    PrismaticLoopJoint,
    RevoluteLoopJoint,
    RobotModel,
    RobotPlant,
    WeldedFrames,
)
from drake_dae.errors import InconsistentStateError, ModelError


def four_bar(folder, far=0.3):
    """A crank of 0.1 m, a coupler and a rocker of 0.4 m; the coupler ends at the rocker."""
    names = ["base", "crank", "coupler", "rocker"]
    text = robot(
        "four_bar",
        *(link(name, 1.0) for name in names),
        joint("a", "base", "crank", "0 1 0", (0.0, 0.0, 0.0)),
        joint("b", "crank", "coupler", "0 1 0", (0.0, 0.0, 0.1)),
        joint("c", "base", "rocker", "0 1 0", (far, 0.0, 0.0)),
    )
    (folder / "bar.urdf").write_text(text)
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModels(str(folder / "bar.urdf"))
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
    for name in "abc":
        plant.AddJointActuator(name, plant.GetJointByName(name))
    plant.Finalize()
    ends = CoincidentPoints(
        "coupler", (0.0, 0.0, 0.4), "rocker", (0.0, 0.0, 0.4), axes="xz", name="pin"
    )
    return plant, ends


def test_a_robot_with_drives_is_simulated_without_outputs_and_nominal_positions(tmp_path):
    plant, pin = four_bar(tmp_path)
    model = RobotModel.from_multibody(plant, [pin])
    assert model.dae.num_outputs == 0
    mechanism = RobotPlant(model)
    context = mechanism.CreateDefaultContext()
    state = mechanism.set_consistent_state(context, {"a": 0.3, "a_w": 5.24})
    assert (state[0], state[3]) == pytest.approx((0.3, 5.24), abs=1e-15)
    assert np.abs(mechanism.GetOutputPort("constraint_residual").Eval(context)).max() < 1e-10
    with pytest.raises(InconsistentStateError, match="a, b, c"):
        mechanism.set_consistent_state(context, dict.fromkeys("abc", 0.0))


def test_constraints_that_nothing_meets_name_the_argument(tmp_path):
    plant, pin = four_bar(tmp_path, far=3.0)
    with pytest.raises(ModelError, match="nominal_positions"):
        RobotModel.from_multibody(plant, [pin])


@pytest.mark.parametrize("off", [0.0, 1e-9])
@pytest.mark.parametrize("cls", [WeldedFrames, RevoluteLoopJoint, PrismaticLoopJoint])
def test_frames_that_are_half_a_turn_off_are_turned_to_each_other(cls: type, off: float):
    """The rotations of these constraints have poles there, which no step shows."""
    plant = MultibodyPlant(0.0)
    for name in "ab":
        body = plant.AddRigidBody(name, SpatialInertia.SolidBoxWithMass(1.0, 0.1, 0.2, 0.3))
        plant.AddJoint(RpyFloatingJoint(name, plant.world_frame(), body.body_frame()))
    plant.Finalize()
    mechanism = RobotPlant(RobotModel.from_multibody(plant, [cls("a", "b")], [], forces=[]))
    random, context = np.random.default_rng(0), plant.CreateDefaultContext()
    frames = [plant.GetFrameByName(name) for name in "ab"]
    for _ in range(15):
        across = np.append(random.normal(size=2), 0.0)
        turned = RigidTransform(
            AngleAxis(np.pi - off, across / np.linalg.norm(across)), np.zeros(3)
        )
        start = RigidTransform(RollPitchYaw(*random.uniform(-0.8, 0.8, 3)), random.normal(size=3))
        poses = [
            (RollPitchYaw(X.rotation()).vector(), X.translation()) for X in (start, start @ turned)
        ]
        guess = np.concatenate([part for pose in poses for part in pose])
        state = mechanism.set_consistent_state(
            mechanism.CreateDefaultContext(), [*guess, *[0.0] * 12]
        )
        plant.SetPositions(context, state[:12])
        a, b = (frame.CalcPoseInWorld(context).rotation().matrix() for frame in frames)
        free = 2 if cls is RevoluteLoopJoint else slice(None)
        np.testing.assert_allclose(a[:, free], b[:, free], atol=1e-12)
