"""Stages of actuation in steps as Drake's, against closed forms and the ideal plant."""

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from arms import error_controlled
from numpy.testing import assert_allclose
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import PrismaticJoint, SpatialInertia, UnitInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput
from runs import some

import drake_dae as dd
from drake_dae.errors import ModelError
from drake_dae.systems import PointMaterial

MASS, ROTOR, STIFFNESS = 2.0, 0.5, 4000.0
RATE = np.sqrt(STIFFNESS * (1.0 / MASS + 1.0 / ROTOR))  # 100 rad/s.


def add_slider(plant: MultibodyPlant) -> None:
    """A body of 2 kg that slides along y on one of 1 kg that slides along x, toward a wall."""
    frame = plant.world_frame()
    for name, axis, mass in (("x", [1, 0, 0], 1.0), ("y", [0, 1, 0], MASS)):
        inertia = SpatialInertia(mass, np.zeros(3), UnitInertia.SolidSphere(0.1))
        body = plant.AddRigidBody(name, inertia)
        joint = plant.AddJoint(PrismaticJoint(name, frame, body.body_frame(), axis))
        motor = plant.AddJointActuator(f"{name}_motor", joint)
        motor.set_default_gear_ratio(1.0)
        motor.set_default_rotor_inertia(ROTOR)
        frame = body.body_frame()


@cache
def slider(*stages) -> tuple[dd.RobotModel, object]:
    plant = MultibodyPlant(0.0)
    add_slider(plant)
    plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
    plant.Finalize()
    wall = dd.PointOnSurface("y", dd.Plane((0.0, 0, 0), (-1, 0, 0)), name="wall")
    model = dd.RobotModel.from_multibody(
        plant, [wall], [dd.PointCoordinates("y", "y")], name="slider", actuation=stages
    )
    return model, dd.find_structure(model.dae)


def contact_plant(step: float, *stages, **parameters) -> dd.CompliantPlant:
    model, structure = slider(*stages)
    material = PointMaterial(time_step=step, friction=0.0)
    return dd.CompliantPlant(model, material, structure=structure, parameters=parameters)


def run(plant: dd.CompliantPlant, start, control, duration: float):
    """x at the steps under a constant control, from a state that touches without a force."""
    builder = DiagramBuilder()
    builder.AddSystem(plant)
    log = LogVectorOutput(plant.GetOutputPort("state"), builder, plant.time_step)
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    own = plant.GetMyMutableContextFromRoot(context)
    plant.GetInputPort("control").FixValue(own, control)
    assert_allclose(plant.set_consistent_state(own, start), start, atol=1e-12)
    assert_allclose(plant.state(own), start, atol=1e-12)
    # What happens at the last instant, too.
    Simulator(diagram, context).AdvanceTo(duration + plant.time_step / 2.0)
    return log.FindLog(context).data().T


SPRINGS = dd.FlexibleJoints(STIFFNESS)


@pytest.mark.slow
@pytest.mark.parametrize("share", some([0.1, 1.0, 1.95]))
def test_spring_without_damping_swings_as_symplectic_euler_does(share):
    """d_n = d_0 cos((2 n + 1) a) / cos a with sin a = w h / 2, by its recursion in n.

    The rotors, which Drake's plant declares, turn with the springs alone: they are in w once.
    2,000 steps add up round-off, near w h = 2 of swings that are 5 times d_0.
    """
    step, start = share / RATE, np.zeros(8)
    start[1], start[5] = -0.01, 0.04  # The centre of mass at rest: 2 q + 0.5 theta = 0.
    states = run(contact_plant(step, SPRINGS), start, np.zeros(2), 2000 * step)
    a = np.arcsin(share / 2.0)
    wanted = 0.05 * np.cos((2.0 * np.arange(len(states)) + 1.0) * a) / np.cos(a)
    assert_allclose(states[:, 5] - states[:, 1], wanted, atol=1e-9)
    assert_allclose(MASS * states[:, 1] + ROTOR * states[:, 5], 0.0, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize(
    "stages",
    some(
        [
            pytest.param((SPRINGS,), id="springs"),
            pytest.param((dd.FlexibleJoints(STIFFNESS, damping=4.0),), id="damped springs"),
            pytest.param((dd.DcMotors(2.0, 0.01, 3.0),), id="motors"),
            pytest.param((dd.ElectrohydraulicServos(2e3, 0.02),), id="valves"),
            pytest.param((SPRINGS, dd.DcMotors(0.5, 0.01, 5.0)), id="springs and motors"),
        ],
        of=3,
        first=1,
    ),
)
def test_stages_tend_to_those_of_the_ideal_plant(stages):
    """First order in h: half the step leaves half of the difference, over the first 0.1 s.

    Along a wall without friction nothing is stiff, so that both have the same motion. What is of
    second order, as the velocities of springs here, leaves 5 per cent in the ratios.
    """
    model, structure = slider(*stages)
    start, control = np.zeros(model.dae.num_states), np.array([0.0, 5.0])
    ideal = dd.RobotPlant(model, structure=structure)
    context = ideal.CreateDefaultContext()
    ideal.set_state(context, start)
    ideal.GetInputPort("control").FixValue(context, control)
    exact = []
    for _ in range(10):
        dd.simulate(ideal, context, 0.01, error_controlled(1e-9))
        exact.append(context.get_continuous_state_vector().CopyToVector())
    sizes = []
    for count in (50, 100, 200):
        found = run(contact_plant(0.01 / count, *stages), start, control, 0.1)[count::count]
        sizes.append(np.sqrt(np.mean((found - exact) ** 2)))
    assert_allclose([coarse / fine for coarse, fine in pairwise(sizes)], 2.0, rtol=0.07)
    assert sizes[-1] < 0.02 * np.abs(exact).max()


def test_ports_show_the_stages():
    plant = contact_plant(1e-3, SPRINGS)
    context = plant.CreateDefaultContext()
    start = np.zeros(8)
    start[1], start[4:] = -0.01, [0.1, 0.04, 0.5, 0.6]
    plant.set_consistent_state(context, start)
    state = plant.state(context)
    for name, wanted in (
        ("state", state),
        ("link_state", state[:4]),
        ("motor_state", state[4:]),
        ("joint_torque", STIFFNESS * (state[4:6] - state[:2])),
    ):
        assert_allclose(plant.GetOutputPort(name).Eval(context), wanted, atol=1e-12)


def test_step_that_is_too_long_is_refused_with_one_that_would_do():
    """w h = 2 is 20 ms for 100 rad/s. Of a motor that turns nothing heavy it is R h / L = 2."""
    with pytest.raises(ModelError, match=r"0\.025.*100.*0\.02"):
        contact_plant(0.025, SPRINGS)
    with pytest.raises(ModelError, match=r"0\.01.*300.*0\.0066"):
        contact_plant(0.01, dd.DcMotors(1e-4, 0.01, 3.0))  # R / L, which takes h <= 2 L / R.


def test_what_nothing_damps_is_refused():
    """Valves without leakage are springs whose force is new with the velocity before."""
    with pytest.raises(ModelError, match="1e-05"):
        contact_plant(1e-3, dd.ElectrohydraulicServos(2e6, 0.0))
