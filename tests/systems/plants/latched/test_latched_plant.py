"""Latches of Drake's discrete plant: momentum, forces, refusals."""

from copy import copy

import numpy as np
import pytest
from latches import latched_crane
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator

import drake_dae as dd
from drake_dae.errors import ModelError, SimulationError

HAND, LOAD = 2.0, 1.5

_AXES = {"x": "1 0 0", "z": "0 0 1", "y": "0 1 0"}


def _chain(name, mass):
    """A body that moves along x, z and y; only its own mass moves along y."""
    text, parent = "", "world"
    for axis, vector in _AXES.items():
        child = name if axis == "y" else f"{name}_{axis}"
        own = mass if axis == "y" else 0.1
        text += f"""<link name="{child}"><inertial><mass value="{own}"/>
        <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
        <joint name="{name}_{axis}_joint" type="prismatic"><parent link="{parent}"/>
        <child link="{child}"/><axis xyz="{vector}"/>
        <limit effort="1000" lower="-9" upper="9" velocity="99"/></joint>"""
        parent = child
    return text


_MOTORS = "".join(
    f"""<transmission name="{axis}_drive"><type>transmission_interface/SimpleTransmission</type>
    <joint name="hand_{axis}_joint"/><actuator name="{axis}_motor"/></transmission>"""
    for axis in _AXES
)
LINKS = _chain("hand", HAND) + _chain("load", LOAD)
URDF = f'<robot name="hoist"><link name="world"/>{LINKS}{_MOTORS}</robot>'


def add_robot(plant, scene_graph=None):
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, 0.0])
    Parser(plant).AddModelsFromString(URDF, "urdf")


@pytest.fixture(scope="module")
def model():
    plant = MultibodyPlant(0.0)
    add_robot(plant)
    plant.Finalize()
    grip = dd.CoincidentPoints("hand", (0, 0, 0), "load", (0, 0, 0), name="grip")
    outputs = [dd.JointPositions([f"load_{axis}_joint" for axis in _AXES])]
    return dd.RobotModel.from_multibody(plant, [grip], outputs, forces=[])


def latched(model, **settings):
    structure = dd.find_structure(model.dae)
    return dd.LatchedPlant(model, add_robot, ["grip"], structure=structure, **settings)


def started(plant, control, latch, along, rate=0.0):
    """A simulator of the plant, the hand at 0 with a rate along y, the load at rest."""
    context = plant.CreateDefaultContext()
    names = [signal.name for signal in plant.dae.state_signals]
    state = np.zeros(len(names))
    q = next(i for i, name in enumerate(names) if name == "hand_y_joint")
    state[q] = -along
    state[len(names) // 2 + q] = rate
    plant.set_state(context, state)
    plant.GetInputPort("control").FixValue(context, control)
    plant.GetInputPort("latch").FixValue(context, [latch])
    return Simulator(plant, context)


def rates(plant, context):
    names = [signal.name for signal in plant.dae.state_signals]
    half = len(names) // 2
    return [plant.state(context)[half + names.index(f"{b}_y_joint")] for b in ("hand", "load")]


def test_closing_conserves_momentum(model):
    """Along y the hand of 2 kg at 1 m/s couples to 1.5 kg at rest, to the solver's tolerance."""
    plant = latched(model)
    simulator = started(plant, np.zeros(3), 1.0, 0.0, 1.0)
    simulator.AdvanceTo(0.1)
    context = simulator.get_context()
    np.testing.assert_allclose(rates(plant, context), HAND / (HAND + LOAD), rtol=1e-4)
    hand, load = rates(plant, context)
    assert HAND * hand + LOAD * load == pytest.approx(HAND, rel=1e-9)
    assert plant.GetOutputPort("mode").Eval(context) == [1.0]


def test_the_force_is_that_which_moves_the_load(model):
    """7 N on 3.5 kg are 2 m/s^2, and 3 N on the load, after the stiff latch has settled."""
    plant = latched(model)
    pull = np.array([0.0, 0.0, 7.0])[[["x", "z", "y"].index(axis) for axis in _AXES]]
    simulator = started(plant, pull, 1.0, 0.0)
    simulator.AdvanceTo(0.2)
    context = simulator.get_context()
    force = plant.GetOutputPort("constraint_force").Eval(context)
    np.testing.assert_allclose(force, [0.0, 3.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(rates(plant, context), 0.4, rtol=1e-6)
    residual = plant.GetOutputPort("constraint_residual").Eval(context)
    assert 0.0 < np.max(np.abs(residual)) < 1e-5  # m; Drake's latch gives way a little.


def test_a_mass_of_the_model_is_that_of_drakes_plant(model):
    """A load of 3 kg in place of 1.5: 10 N on 5 kg in all are 2 m/s^2, and 6 N on the load."""
    heavy = copy(model)
    heavy.dae = model.dae.with_values({"load.mass": 3.0})
    plant = latched(heavy)
    pull = np.array([0.0, 0.0, 10.0])[[["x", "z", "y"].index(axis) for axis in _AXES]]
    simulator = started(plant, pull, 1.0, 0.0)
    simulator.AdvanceTo(0.2)
    context = simulator.get_context()
    force = plant.GetOutputPort("constraint_force").Eval(context)
    np.testing.assert_allclose(force, [0.0, 6.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(rates(plant, context), 0.4, rtol=1e-6)


def test_an_open_latch_exerts_no_force(model):
    plant = latched(model)
    simulator = started(plant, np.zeros(3), 0.0, 0.0, 1.0)
    simulator.AdvanceTo(0.1)
    context = simulator.get_context()
    np.testing.assert_allclose(rates(plant, context), [1.0, 0.0], atol=1e-12)
    np.testing.assert_array_equal(plant.GetOutputPort("constraint_force").Eval(context), 0.0)


def test_a_latch_that_is_too_far_does_not_close(model):
    simulator = started(latched(model), np.zeros(3), 1.0, 0.01)
    with pytest.raises(SimulationError, match=r"latch 'grip' .* is 0\.01 m or rad off its place"):
        simulator.AdvanceTo(0.01)


def test_what_drake_does_not_have_is_refused(model):
    other = [dd.CoincidentPoints("hand", (0, 0, 0), "load", (0, 0, 0), axes="xy", name="grip")]
    plant = MultibodyPlant(0.0)
    add_robot(plant)
    plant.Finalize()
    outputs = [dd.JointPositions([f"load_{axis}_joint" for axis in _AXES])]
    planar = dd.RobotModel.from_multibody(plant, other, outputs, forces=[])
    structure = dd.find_structure(model.dae)
    with pytest.raises(ModelError, match="'grip': Drake has no constraint for a CoincidentPoints"):
        dd.LatchedPlant(planar, add_robot, ["grip"], structure=structure)
    with pytest.raises(ModelError, match="each constraint is a latch; these are grip"):
        dd.LatchedPlant(model, add_robot, [], structure=structure)


def test_a_latch_may_be_fixed_to_the_world():
    """Drake 1.51 ends the process at a constraint with the world itself. The weight is 2 kg g."""
    plant = latched_crane()
    context = plant.CreateDefaultContext()
    plant.set_state(context, np.zeros(6))
    plant.GetInputPort("control").FixValue(context, np.zeros(0))
    plant.GetInputPort("latch").FixValue(context, [1.0])
    simulator = Simulator(plant, context)
    simulator.AdvanceTo(0.1)
    force = plant.GetOutputPort("constraint_force").Eval(simulator.get_context())
    np.testing.assert_allclose(force, [0.0, 0.0, 2.0 * 9.81], atol=1e-6)
