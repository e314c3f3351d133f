"""DaePlant and RobotPlant as Drake systems: ports, feedthrough, start, projection, failure."""

import numpy as np
import pytest
from arms import arm, consistent_states, error_controlled, fixed_step
from problems import bead, hanging_pendulum
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from drake_dae import DaePlant, DaeSystem, RobotPlant, find_structure
from drake_dae.errors import InconsistentStateError, ModelError, NonFiniteError, SingularityError


def two_link():
    return RobotPlant(arm("two_link").model, structure=arm("two_link").structure)


def driven(plant, control):
    builder = DiagramBuilder()
    builder.AddSystem(plant)
    source = builder.AddSystem(ConstantVectorSource(np.atleast_1d(control)))
    builder.Connect(source.get_output_port(), plant.GetInputPort("control"))
    simulator = Simulator(builder.Build())
    return simulator, plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())


def test_outputs_follow_state_control_and_parameters():
    """The declared prerequisites are complete: no cached value is stale."""
    plant = two_link()
    context = plant.CreateDefaultContext()
    plant.GetInputPort("control").FixValue(context, [0.0, 0.0])
    seen = [plant.GetOutputPort("constraint_force").Eval(context)[0]]
    plant.GetInputPort("control").FixValue(context, [5.0, 0.0])
    seen.append(plant.GetOutputPort("constraint_force").Eval(context)[0])
    plant.set_state(context, consistent_states("two_link", 1)[0])
    seen.append(plant.GetOutputPort("constraint_force").Eval(context)[0])
    plant.set_parameter(context, "link1.mass", 13.0)
    seen.append(plant.GetOutputPort("constraint_force").Eval(context)[0])
    assert len(set(seen)) == 4
    residual = plant.GetOutputPort("constraint_residual").Eval(context).copy()
    plant.set_parameter(context, "wall.position", [1.25, 0, 0])
    moved = plant.GetOutputPort("constraint_residual").Eval(context) - residual
    np.testing.assert_allclose(moved, [0.05, 0.0], atol=1e-15)
    np.testing.assert_array_equal(plant.get_parameter(context, "wall.position"), [1.25, 0, 0])
    with pytest.raises(ModelError, match=r"'wal'.*link1\.mass"):
        plant.set_parameter(context, "wal", 0.0)


def test_a_start_off_the_constraint_is_refused_with_its_residual():
    plant = two_link()
    simulator, context = driven(plant, [0.0, 0.0])
    plant.set_state(context, plant.state(context) + np.array([0.01, 0.0, 0.0, 0.0]))
    with pytest.raises(InconsistentStateError, match=r"wall\.distance = .* m"):
        simulator.Initialize()


def test_projection_is_due_at_the_start_of_the_next_step():
    """AdvancePendingEvents does it for the last state; without it the drift shows."""
    plant = two_link()
    simulator, context = driven(plant, [40.0, 20.0])
    ApplySimulatorConfig(fixed_step(0.05), simulator)
    simulator.AdvanceTo(0.3)
    port = plant.GetOutputPort("constraint_residual")
    before = np.max(np.abs(port.Eval(context)))
    simulator.AdvancePendingEvents()
    assert np.max(np.abs(port.Eval(context))) < 1e-13 < before


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_control_that_is_not_finite_raises_instead_of_looping(bad):
    simulator, _ = driven(two_link(), [0.0, bad])
    ApplySimulatorConfig(error_controlled(1e-6), simulator)
    reason = r"joint2_motor.*t = 0 s"
    with pytest.raises(NonFiniteError, match=reason) as info:
        simulator.AdvanceTo(1.0)
    assert info.value.time == 0.0
    assert info.value.state.shape == (4,)


def test_a_singular_constraint_matrix_raises_with_time_and_state():
    plant = DaePlant(bead())
    context = plant.CreateDefaultContext()
    plant.GetInputPort("control").FixValue(context, [0.0])
    plant.set_state(context, [0.0, 0.0])
    with pytest.raises((SingularityError, NonFiniteError), match=r"A\(x\)"):
        plant.EvalTimeDerivatives(context)


def test_parameters_that_make_no_sense_are_refused():
    plant = two_link()
    context = plant.CreateDefaultContext()
    for value, message in ((-5.0, "must be positive"), (np.nan, "finite"), ([1, 2], "1 entries")):
        with pytest.raises(ModelError, match=message):
            plant.set_parameter(context, "link2.mass", value)
    assert plant.get_parameter(context, "link2.mass") == 6.0


def test_the_structure_of_another_system_is_refused():
    """A robot's by the name of its class, also where the other has the same equations."""
    other = arm("seven_joint").structure
    reason = r"'seven_joint'.*'two_link'"
    with pytest.raises(ModelError, match=reason):
        RobotPlant(arm("two_link").model, structure=other)
    with pytest.raises(ModelError, match="structure"):
        DaePlant(hanging_pendulum(), structure=find_structure(hanging_pendulum()))


def pendulum(**fields):
    """A mass on a rod of length 1 in Cartesian coordinates, without control or outputs."""
    given = {
        "f": lambda x: [x[2], x[3], 0, -9.81],
        "g": lambda x: [[0], [0], [x[0]], [x[1]]],
        "k": lambda x: (x[0] ** 2 + x[1] ** 2 - 1) / 2,
        "nominal_state": [1.0, 0.0, 0.0, 0.0],
        "name": "pendulum",
    }
    return DaeSystem.from_functions(["x", "y", "vx", "vy"], **(given | fields))


def test_a_mechanism_that_nobody_steers_keeps_its_energy():
    """Over 10 s to 1e-10, its residual to round-off, and the multiplier is that of the pendulum.

    The energy is 9.81 J/kg at most; accuracy 1e-12 of a fifth-order method in 10 s leaves some
    1e-11 of it. v = g y - |velocity|^2 on the circle of radius 1.
    """
    plant = DaePlant(pendulum())
    simulator = Simulator(plant)
    ApplySimulatorConfig(error_controlled(1e-12), simulator)
    simulator.AdvanceTo(10.0)
    simulator.AdvancePendingEvents()
    context = simulator.get_context()
    _, y, vx, vy = plant.state(context)
    assert abs((vx**2 + vy**2) / 2 + 9.81 * y) < 1e-10
    assert np.max(np.abs(plant.GetOutputPort("constraint_residual").Eval(context))) < 1e-12
    force = plant.GetOutputPort("constraint_force").Eval(context)
    np.testing.assert_allclose(force, [9.81 * y - vx**2 - vy**2], rtol=1e-12)
    assert plant.GetOutputPort("controlled_output").Eval(context).size == 0
    converted = plant.ToAutoDiffXd()
    rate = converted.EvalTimeDerivatives(converted.CreateDefaultContext()).get_vector()
    assert rate.size() == 4


def test_outputs_that_no_law_could_steer_are_simulated():
    """B(x) is singular, or not square: z = (the constraint, the tension) with one control."""
    plant = DaePlant(
        pendulum(
            h=lambda x: [0, 0, -x[1], x[0]],
            l=lambda x: [x[0] ** 2 + x[1] ** 2, 0],
            m=lambda x: [[0], [1]],
        )
    )
    context = plant.CreateDefaultContext()
    plant.GetInputPort("control").FixValue(context, [2.0])
    plant.set_consistent_state(context, [0.6, 0.8, 0.4, -0.3])
    force = plant.GetOutputPort("constraint_force").Eval(context)
    np.testing.assert_allclose(
        plant.GetOutputPort("controlled_output").Eval(context), [1.0, force[0]], rtol=1e-14
    )
    control = plant.GetInputPort("control").get_index()
    assert plant.HasDirectFeedthrough(
        control, plant.GetOutputPort("controlled_output").get_index()
    ) == (plant.HasDirectFeedthrough(control, plant.GetOutputPort("constraint_force").get_index()))
