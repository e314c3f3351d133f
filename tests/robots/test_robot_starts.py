"""Starts of robots in Python: without nominal positions, without outputs, in motion."""

import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from vendors import joint, link, robot

from drake_dae import CoincidentPoints, RobotModel, RobotPlant
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
