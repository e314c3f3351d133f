"""Force feedback and wrong models in the closed-loop diagram and in scenario files."""

import numpy as np
import pytest
from arms import arm, touching
from runs import scenario

import drake_dae as dd
from drake_dae.diagrams import LoopSettings
from drake_dae.errors import ScenarioError, WiringError

REFERENCES = [dd.ConstantReference(0.3), dd.ConstantReference(20.0)]
MOTORS = dd.DcMotors(torque_constant=0.5, inductance=1e-2, resistance=1.0, gear_ratio=100.0)


def rigid(sensor=None, gain=1.0):
    found = arm("two_link")
    law = dd.TrackingLaw(
        found.model.dae,
        dd.poles(-8.0),
        structure=found.structure,
        measured_force=True,
        force_gain=gain,
    )
    plant = dd.RobotPlant(found.model, structure=found.structure)
    return dd.make_closed_loop(plant, law, REFERENCES, LoopSettings(sensor=sensor))


def test_a_direct_connection_that_loops_is_refused_with_the_remedy():
    with pytest.raises(WiringError, match="ForceSensor"):
        rigid()


def test_a_sampled_loop_that_diverges_is_refused():
    with pytest.raises(WiringError, match=r"1.5"):
        rigid(dd.ForceSensor(1, sample_period=0.01), gain=1.5)
    # With a lag of five samples it is stable up to (1 + a) / (1 - a), a = exp(-1/5): 10.033.
    rigid(dd.ForceSensor(1, time_constant=0.05, sample_period=0.01), gain=10.02)
    with pytest.raises(WiringError, match="force_gain"):
        rigid(dd.ForceSensor(1, time_constant=0.05, sample_period=0.01), gain=10.04)


def test_a_sensor_of_a_wrong_size_is_refused_with_both_sizes():
    with pytest.raises(WiringError, match=r"two_link.*size 1.*force_sensor.*size 2"):
        rigid(dd.ForceSensor(2, time_constant=0.01))


def test_behind_motors_the_force_may_be_connected_directly():
    model = touching("two_link", [MOTORS])
    law = dd.TrackingLaw(model.dae, dd.poles(-8.0), measured_force=True)
    loop = dd.make_closed_loop(dd.RobotPlant(model, structure=law.structure), law, REFERENCES)
    assert loop.sensor is None
    assert not loop.diagram.HasAnyDirectFeedthrough()


@pytest.mark.parametrize(
    ("setting", "start"),
    [
        # The wall stands 2 cm farther than the law believes, or the springs are half as stiff.
        ("plant.parameters={wall.position: [1.22, 0, 0]}", [1.22, 0.32]),
        ("plant.parameters={flexible_joints.stiffness: [4e3, 4e3]}", [1.2, 0.32]),
    ],
)
def test_a_wrong_plant_starts_consistent_at_its_own_parameters(setting, start):
    """The tip is on the plant's wall at the wanted height, at rest, with the wanted force."""
    loop, context = dd.build_scenario(scenario("two_link_flexible", setting))
    own = loop.plant.GetMyContextFromRoot(context)
    state = loop.plant.state(own)
    q = state[:2]
    tip = [np.cos(q[0]) + np.cos(q.sum()), np.sin(q[0]) + np.sin(q.sum())]
    np.testing.assert_allclose(tip, start, atol=1e-9)
    assert loop.plant.GetOutputPort("constraint_force").Eval(own)[0] == pytest.approx(
        15.0, abs=1e-6
    )
    assert np.max(np.abs(loop.plant.GetOutputPort("constraint_residual").Eval(own))) < 1e-12


def test_a_gain_without_effect_is_refused():
    with pytest.raises(ScenarioError, match=r"sensors\.force or law\.gains: "):
        dd.build_scenario(
            scenario("two_link_flexible", "sensors.force.time_constant=0.01", "law.force_gain=2")
        )
