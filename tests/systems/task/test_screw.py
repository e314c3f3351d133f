"""A screw that is driven: against Drake's ScrewJoint, closed forms, and what is no tight screw."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ScrewJoint, SpatialInertia, UnitInertia
from pydrake.systems.analysis import SimulatorConfig
from runs import first_quick, some

from drake_dae import RobotPlant, load_scenario, simulate
from drake_dae.errors import ModelError, ScenarioError, SimulationError
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.rolled import roll_scenario
from drake_dae.scenario.start import start_scenario
from drake_dae.systems.task.phases import Screw

PITCH, MASS, INERTIA = 0.002, 4.5, 0.002

ROBOT = """
<robot name="driver">
  <link name="world"/>
  <link name="head"><inertial><mass value="4"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial></link>
  <link name="bit"><inertial><mass value="0.5"/>
    <inertia ixx="0.001" ixy="0" ixz="0" iyy="0.001" iyz="0" izz="0.002"/></inertial></link>
  <joint name="slide" type="prismatic"><parent link="world"/><child link="head"/>
    <axis xyz="0 0 1"/><limit lower="-0.2" upper="0.5" effort="200" velocity="1"/></joint>
  <joint name="spindle" type="continuous"><parent link="head"/><child link="bit"/>
    <axis xyz="0 0 1"/><limit effort="20" velocity="100"/></joint>
  <transmission><type>transmission_interface/SimpleTransmission</type>
    <joint name="slide"/><actuator name="slide"/></transmission>
  <transmission><type>transmission_interface/SimpleTransmission</type>
    <joint name="spindle"/><actuator name="spindle"/></transmission>
</robot>
"""

# The law takes the head for a plane at rest. The thread has friction in the plant alone.
TEXT = f"""
robot: {{file: driver.urdf}}
constraints:
- !ScrewHead
  name: screw
  frame: bit
  surface: !Plane {{point: [0, 0, 0], normal: [0, 0, 1]}}
  turned_by: spindle
  pitch: 0
outputs: [!JointPositions {{joints: [spindle]}}]
known_forces: [!JointFriction {{joints: [spindle], viscous: 0}}]
plant_parameters: {{screw.pitch: {PITCH}}}
gains: !Poles {{all: [-25]}}
sampling: {{period: 0.001}}
task:
  phases:
  - !Press {{force: 20, over: 0.1}}
  - !Screw {{turn: spindle, pitch: {PITCH}, turns: 2, speed: 12, acceleration: 50}}
duration: 2.5
integrator: {{integration_scheme: runge_kutta3, max_step_size: 0.001, use_error_control: false}}
"""


@pytest.fixture
def built(tmp_path):
    """The loop of the text with changes, and its context at the start."""

    def build(*changes):
        (tmp_path / "driver.urdf").write_text(ROBOT)
        (tmp_path / "screw.yaml").write_text(TEXT)
        scenario, loop = build_completed(load_scenario(tmp_path / "screw.yaml", changes))
        return scenario.scenario, loop, start_scenario(scenario.scenario, loop)

    return build


TIGHT = (
    "task.phases.1=!Screw {turn: spindle, pitch: 0.002, turns: 2, speed: 12, acceleration: 50, "
    "control: spindle, torque: 0.5}"
)


def test_a_screw_head_moves_as_drakes_screw_joint(built):
    """One body on a ScrewJoint, with the mass of both links; to round-off of a 2 x 2 solution."""
    _, loop, _ = built()
    screw = MultibodyPlant(0.0)
    unit = UnitInertia(0.01, 0.01, INERTIA / MASS)
    body = screw.AddRigidBody("screw", SpatialInertia(MASS, np.zeros(3), unit))
    frames = screw.world_frame(), body.body_frame()
    screw.AddJoint(ScrewJoint("thread", *frames, [0, 0, 1], -PITCH, 0.0))
    screw.Finalize()
    own = screw.CreateDefaultContext()
    plant = RobotPlant(loop.plant.robot("the screw"))
    context = plant.CreateDefaultContext()
    plant.set_parameter(context, "screw.pitch", PITCH)
    turn, rate, push, torque = 0.7, 3.0, -300.0, 0.4
    per_radian = PITCH / (2.0 * np.pi)
    plant.set_state(context, [-per_radian * turn, turn, -per_radian * rate, rate])
    plant.GetInputPort("control").FixValue(context, [push, torque])
    screw.SetPositionsAndVelocities(own, [turn, rate])
    applied = torque - per_radian * push
    screw.get_applied_generalized_force_input_port().FixValue(own, [applied])
    wanted = screw.EvalTimeDerivatives(own).CopyToVector()[1]
    found = plant.EvalTimeDerivatives(context).CopyToVector()
    assert_allclose(found[3], wanted, rtol=1e-9)
    assert_allclose(found[2], -per_radian * wanted, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("rolls", some(first_quick([True, False])))
def test_a_screw_advances_by_its_pitch_at_constant_force(built, rolls):
    """At constant speed the law that knows no thread has its force exactly, and turns ahead by
    e = pitch F / (2 pi I p^2): its torque on the joint is a disturbance. Samples of 1 ms leave 3 %.
    """
    scenario, loop, context = built()
    if rolls:
        found = roll_scenario(scenario, loop, context)
        record, changes = found.record, loop.changes(found.context)
    else:
        simulate(
            loop.diagram, context, 2.5, SimulatorConfig(max_step_size=1e-3, use_error_control=False)
        )
        record, changes = loop.record(context), loop.changes(context)
    assert [change.phase for change in changes] == ["Press", "Screw", "done"]
    assert changes[2].reason == "after 2 turns"
    assert_allclose(record["state"][-1, :2], [-2 * PITCH, 4 * np.pi], rtol=1e-3)
    row = np.searchsorted(record.time, 0.5 * (changes[1].time + changes[2].time))
    assert_allclose(record["constraint_force"][row, 0], 20.0, rtol=1e-3)
    ahead = record["tracking_error"][row, 0]
    assert_allclose(ahead, PITCH * 20.0 / (2 * np.pi * INERTIA * 25.0**2), rtol=0.03)


def test_a_cross_threaded_screw_does_not_advance(built):
    scenario, loop, context = built(
        "plant_parameters.screw.pitch=1e-5", "task.phases.1.if_late=hold"
    )
    found = roll_scenario(scenario, loop, context)
    last = loop.changes(found.context)[-1]
    assert (last.phase, last.failed) == ("held", True)
    # At the lag of 0.5 mm, a quarter of a turn.
    assert "after 0.25" in last.reason
    assert "would advance by 0.0005" in last.reason
    assert "cross-threaded, or the bit slips" in last.reason


@pytest.mark.slow
def test_a_tight_screw_ends_by_its_torque(built):
    """Thread friction of 0.05 N m s comes after 0.7 turns: d w = 0.6 N m at 12 rad/s."""
    config = SimulatorConfig(max_step_size=1e-3, use_error_control=False)
    _, loop, context = built(TIGHT)
    simulate(loop.diagram, context, 0.75, config)
    at_plant = loop.plant.GetMyMutableContextFromRoot(context)
    loop.plant.set_parameter(at_plant, "spindle.viscous", 0.05)
    simulate(loop.diagram, context, 0.3, config)
    last = loop.changes(context)[-1]
    assert (last.phase, last.reason, last.failed) == ("done", "after a torque of 0.5", False)
    assert -0.002 * 2 < last.distance < -0.002 * 0.7


@pytest.mark.slow
@pytest.mark.parametrize(
    ("viscous", "problem"), [(0.05, "the screw jams"), (0.0, "screw not tight")]
)
def test_a_torque_too_early_or_never_is_a_failure(built, viscous, problem):
    scenario, loop, context = built(
        TIGHT, f"plant_parameters={{screw.pitch: 0.002, spindle.viscous: {viscous}}}"
    )
    found = roll_scenario(scenario, loop, context)
    assert isinstance(found.failure, SimulationError)
    assert problem in str(found.failure)


def test_a_screw_says_what_it_needs(built):
    with pytest.raises(ModelError, match="turns must be finite and not 0"):
        Screw("spindle", 0.002, 0.0)
    with pytest.raises(ModelError, match="needs the name of its control"):
        Screw("spindle", 0.002, 2.0, torque=1.0)
    with pytest.raises(
        ScenarioError, match="task: phase 2 of the task, Screw: no control 'spindl'"
    ):
        built(TIGHT.replace("control: spindle", "control: spindl"))
