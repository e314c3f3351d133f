"""A loop whose plant is an arm behind LCM, over memq:// in one process, against simulated ones."""

import sys

import numpy as np
import pytest
from arms import arm, law
from drake import lcmt_iiwa_command, lcmt_iiwa_status
from lcm_driver import SimulatedDriver
from pydrake.lcm import DrakeLcm, Subscriber
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator, SimulatorConfig

from drake_dae import (
    DcMotors,
    LcmArm,
    LoopSettings,
    Plane,
    PointCoordinates,
    PointOnSurface,
    RobotModel,
    RobotPlant,
    Sampling,
    SinusoidReference,
    TrackingLaw,
    make_closed_loop,
    poles,
    rollout,
    shipped_model,
    simulate,
)
from drake_dae.dae.structure.structure import find_structure
from drake_dae.errors import ModelError
from drake_dae.systems.plants.hardware.lcm_arm import CRASHES

STEP = 0.001
REFERENCES = {
    "tool.z": SinusoidReference(0.3, 0.05, 1.5),
    "wall.force": SinusoidReference(20.0, 5.0, 2.0),
}
RUNNING, STOPPED, WAITING = 0.0, 2.0, 3.0

pytestmark = pytest.mark.skipif(
    sys.version_info >= CRASHES, reason="Drake's LCM blocks crash with this Python"
)


def weightless():
    """The two-link arm without gravity."""
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModels(str(shipped_model("two_link_arm.urdf")))
    plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
    plant.Finalize()
    wall = PointOnSurface("tool", Plane((1.2, 0, 0), (-1, 0, 0)), name="wall")
    outputs = [PointCoordinates("tool", "z")]
    model = RobotModel.from_multibody(plant, [wall], outputs, [1.2, -1.6])
    structure = find_structure(model.dae)
    return model, structure, TrackingLaw(model.dae, poles(-4.0), structure=structure)


class Bench:
    """A loop around an `LcmArm`, and its driver, in steps of a millisecond."""

    def __init__(self, kind: str, model, structure, own_law, **options) -> None:
        self.lcm = DrakeLcm("memq://")
        start = model.dae.nominal_state
        self.driver = SimulatedDriver(kind, model, structure, self.lcm, start)
        self.driver.simulator.get_mutable_integrator().set_target_accuracy(1e-10)
        self.arm = LcmArm(model, self.lcm, kind, structure=structure, **options)
        self.loop = make_closed_loop(self.arm, own_law, REFERENCES)
        self.simulator = Simulator(self.loop.diagram)
        self.own = self.arm.GetMyContextFromRoot(self.simulator.get_context())
        self.loop.set_state(self.simulator.get_mutable_context(), self.driver.state)
        self.tick = 0
        self.commands = Subscriber(self.lcm, "IIWA_COMMAND", lcmt_iiwa_command)

    def shown(self, name: str) -> np.ndarray:
        return np.array(self.arm.GetOutputPort(name).Eval(self.own))

    @property
    def torque(self) -> np.ndarray:
        return np.array(self.commands.message.joint_torque)

    def advance(self, steps: int, *, is_driven: bool = True) -> None:
        for _ in range(steps):
            if is_driven:
                self.driver.advance(self.tick * STEP)
            self.simulator.AdvanceTo(self.tick * STEP)
            self.tick += 1


def in_drake(model, structure, own_law, duration: float):
    """The record of the same loop around a simulated plant, from when the arm has its status on."""
    plant = RobotPlant(model, structure=structure)
    loop = make_closed_loop(plant, own_law, REFERENCES, LoopSettings(sampling=Sampling(STEP)))
    context = loop.diagram.CreateDefaultContext()
    own = plant.GetMyMutableContextFromRoot(context)
    plant.set_consistent_state(own, model.dae.nominal_state)
    config = SimulatorConfig(
        integration_scheme="runge_kutta5", accuracy=1e-10, max_step_size=STEP, start_time=STEP
    )
    simulate(loop.diagram, context, duration, config)
    return loop.record(context)


@pytest.mark.slow
def test_the_loop_is_that_of_a_simulated_plant():
    """In each sample status and command pass the bus without delay, after a first one without."""
    parts = weightless()
    bench = Bench("iiwa", *parts)
    record = in_drake(*parts, 0.3)
    bench.advance(1)
    assert bench.shown("driver_status")[0] == WAITING
    for k in range(1, 300):
        bench.advance(1)
        row = np.argmin(np.abs(record.time - k * STEP))
        assert abs(record.time[row] - k * STEP) < 1e-9
        # What the integrators may leave in each step.
        np.testing.assert_allclose(bench.driver.state, record["state"][row], atol=1e-8)
        np.testing.assert_allclose(bench.shown("state"), bench.driver.state, atol=1e-14)
    assert bench.shown("driver_status")[0] == RUNNING


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["iiwa", "panda"])
def test_an_arm_under_gravity_tracks_with_its_driver(kind):
    """The driver bears the weight where the arm is, and the law where it was in its sample."""
    found = arm("two_link")
    parts = found.model, found.structure, law("two_link")
    bench = Bench(kind, *parts)
    bench.advance(200)
    record = in_drake(*parts, 0.2)
    # The weight changes by some mN m in a millisecond.
    row = np.argmin(np.abs(record.time - 199 * STEP))
    np.testing.assert_allclose(bench.shown("state"), record["state"][row], atol=2e-5)
    # The force from the external torques, whose sign each driver has its own way, is that of the
    # wall.
    there = bench.driver.plant.GetOutputPort("constraint_force").Eval(bench.driver.own)
    np.testing.assert_allclose(bench.shown("constraint_force"), there, rtol=1e-6)
    assert there > 15.0
    assert np.abs(bench.shown("constraint_residual")).max() < 1e-8
    np.testing.assert_allclose(bench.shown("controlled_output")[1], there[0], rtol=1e-6)


def test_before_the_first_message_there_is_no_torque():
    bench = Bench("iiwa", *weightless())
    bench.advance(30, is_driven=False)
    bench.lcm.HandleSubscriptions(0)
    assert bench.shown("driver_status")[0] == WAITING
    np.testing.assert_array_equal(bench.torque, [0.0, 0.0])
    np.testing.assert_allclose(bench.shown("state"), bench.driver.state)
    bench.advance(5)
    assert bench.shown("driver_status")[0] == RUNNING


@pytest.mark.slow
def test_a_short_silence_is_held_and_a_long_one_is_a_stop():
    bench = Bench("iiwa", *weightless(), max_age=0.02, stop_time=0.05)
    bench.advance(50)
    bench.advance(15, is_driven=False)
    assert bench.shown("driver_status")[0] == RUNNING
    assert 0.012 < bench.shown("driver_status")[1] < 0.016
    bench.advance(20)
    assert bench.shown("driver_status")[0] == RUNNING
    assert bench.shown("driver_status")[1] < 0.002
    before = bench.torque
    bench.advance(23, is_driven=False)
    bench.lcm.HandleSubscriptions(0)
    assert bench.shown("driver_status")[0] == STOPPED
    begin = bench.torque
    # No jump: the law went on with the last state.
    np.testing.assert_allclose(begin, before, rtol=0.1, atol=0.5)
    bench.advance(25, is_driven=False)
    bench.lcm.HandleSubscriptions(0)
    np.testing.assert_allclose(bench.torque, 0.5 * begin, rtol=0.1)
    # For good, also when messages come again.
    bench.advance(40)
    bench.lcm.HandleSubscriptions(0)
    assert bench.shown("driver_status")[0] == STOPPED
    np.testing.assert_array_equal(bench.torque, [0.0, 0.0])


def test_a_message_that_is_no_number_counts_for_none():
    bench = Bench("iiwa", *weightless())
    bench.advance(20)
    state, force = bench.shown("state"), bench.shown("constraint_force")
    for k in range(30):
        broken = lcmt_iiwa_status()
        broken.utime, broken.num_joints = 10**6 + k, 2
        for name in broken.__slots__:
            if name.startswith("joint"):
                setattr(broken, name, [np.nan, 0.0])
        bench.lcm.Publish("IIWA_STATUS", broken.encode())
        bench.advance(1, is_driven=False)
        np.testing.assert_allclose(bench.shown("state"), state)
        np.testing.assert_allclose(bench.shown("constraint_force"), force)
    assert bench.shown("driver_status")[0] == STOPPED


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"driver": "ur5"}, "no driver 'ur5'"),
        ({"period": 0.0}, "period is a positive time in s, got 0"),
        ({"max_age": -1.0}, "max_age is a positive time in s, got -1"),
        ({"stop_time": np.inf}, "stop_time must be a finite number, got inf"),
    ],
)
def test_wrong_arguments_are_told(options, reason):
    found = arm("two_link")
    given = {"driver": "iiwa", **options}
    with pytest.raises(ModelError, match=reason):
        LcmArm(found.model, DrakeLcm("memq://"), structure=found.structure, **given)


def test_what_a_driver_cannot_command_is_refused():
    found = arm("two_link")
    motors = DcMotors(resistance=1.0, inductance=1e-3, torque_constant=1.0)
    model = RobotModel.from_multibody(
        found.plant,
        found.model.constraints,
        found.model.outputs,
        [1.2, -1.6],
        actuation=[motors],
    )
    with pytest.raises(ModelError, match="has stages of actuation, and a driver takes torques"):
        LcmArm(model, DrakeLcm("memq://"), "iiwa", structure=find_structure(model.dae))


def test_a_rollout_says_that_an_arm_is_not_traced():
    bench = Bench("iiwa", *weightless())
    with pytest.raises(ModelError, match="an arm behind LCM, cannot be traced"):
        rollout(bench.loop, np.zeros(4), None, [0.0, 1.0])
