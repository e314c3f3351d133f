"""Friction of a point on a surface, against closed forms and MultibodyPlant alone."""

from dataclasses import replace

import numpy as np
import pytest
from arms import consistent_states, error_controlled, numbers, parse, touching
from numpy.testing import assert_allclose
from pydrake.multibody.tree import JacobianWrtVariable
from runs import some

from drake_dae import (
    Plane,
    PointOnSurface,
    RobotModel,
    RobotPlant,
    build_scenario,
    load_scenario,
    simulate,
)
from drake_dae.errors import ModelError
from drake_dae.scenario.shipped import find_scenario


def frictional(friction=0.3, stiction_tolerance=0.05, viscous=None, actuation=(), name="two_link"):
    """An arm of `arms` whose wall has friction."""
    model = touching(name, actuation)
    (smooth,) = model.constraints
    contact = PointOnSurface(
        "tool",
        smooth.surface,
        name="wall",
        friction=friction,
        stiction_tolerance=stiction_tolerance,
        viscous_friction=viscous,
    )
    nominal = model.dae.nominal_state[: model.links.q.numel()]
    return RobotModel(model.links, [contact], model.outputs, nominal, name, actuation)


@pytest.mark.parametrize("name", ["two_link", pytest.param("seven_joint", marks=pytest.mark.slow)])
def test_the_motion_is_that_of_multibody_plant_with_the_force_of_friction_on_the_tool(name):
    """M v' + H = J_n^T lambda - J_t^T (mu lambda s + d v_t) + u with J_n v' + J_n' v = 0.

    All numbers are MultibodyPlant's, the unknowns (v', lambda) are solved for at once by NumPy.
    Numbers are of order 100: 1e-9 is round-off with room.
    """
    mu, speed, d = 0.4, 0.05, 7.0
    model = frictional(mu, speed, d, name=name)
    plant, count = RobotPlant(model), model.links.v.numel()
    context, random = plant.CreateDefaultContext(), np.random.default_rng(1)
    for state in consistent_states(name, 5):
        control = random.uniform(-30.0, 30.0, count)
        plant.GetInputPort("control").FixValue(context, control)
        plant.set_state(context, state)
        q, v = np.split(state, 2)
        n = numbers(name, q, v)
        across = n.output_jacobian[: 1 if name == "two_link" else 2]  # Of z; of y and z.
        sliding = across @ v
        s = sliding / np.sqrt(sliding @ sliding + speed**2)
        G = n.constraint_jacobian[0] - mu * across.T @ s
        left = np.block([[n.mass, -G[:, None]], [n.constraint_jacobian, np.zeros((1, 1))]])
        load = control - n.bias - d * across.T @ sliding
        expected = np.linalg.solve(left, [*load, *-n.constraint_acceleration])
        rate = plant.EvalTimeDerivatives(context).CopyToVector()
        force = plant.GetOutputPort("constraint_force").Eval(context)
        assert_allclose(rate[count:], expected[:-1], rtol=1e-9, atol=1e-9)
        assert_allclose(force, expected[-1:], rtol=1e-9, atol=1e-9)

        wrench = plant.GetOutputPort("constraint_wrenches").Eval(context)
        pull = -(mu * force * s + d * sliding)
        wanted = [-force[0], *([0.0] if name == "two_link" else []), *pull]
        assert_allclose(wrench[3:6], wanted, rtol=1e-9, atol=1e-9)
        assert_allclose(wrench[9:], -wrench[3:6], rtol=1e-12)


def test_no_friction_leaves_no_trace_in_the_equations():
    """Without it, not an operation more; with a coefficient of 0, the same motion."""
    smooth, zero = touching("two_link"), frictional(0.0)
    assert [p.name for p in smooth.constraints[0].parameters] == ["wall.position"]
    assert not smooth.dae.contacts
    assert not smooth.dae.frictional_contacts
    values = []
    for model in (smooth, zero):
        plant = RobotPlant(model)
        context = plant.CreateDefaultContext()
        plant.GetInputPort("control").FixValue(context, [3.0, -4.0])
        plant.set_consistent_state(context, [1.2, -1.6, 0.3, 0.4])
        rate = plant.EvalTimeDerivatives(context).CopyToVector()
        values.append([*rate, *plant.GetOutputPort("constraint_force").Eval(context)])
    assert_allclose(values[1], values[0], rtol=1e-12)


def test_numbers_of_friction_that_make_no_sense_are_refused():
    wall = Plane((1.2, 0, 0), (-1, 0, 0))
    with pytest.raises(ModelError, match=r"'surface\.friction'"):
        PointOnSurface("tool", wall, friction=-0.1)
    with pytest.raises(ModelError, match=r"'surface\.viscous_friction'"):
        PointOnSurface("tool", wall, viscous_friction=-0.1)
    with pytest.raises(ModelError, match=r"'surface\.stiction_tolerance'"):
        PointOnSurface("tool", wall, friction=0.3, stiction_tolerance=0.0)
    plant = RobotPlant(frictional())
    context = plant.CreateDefaultContext()
    with pytest.raises(ModelError, match=r"wall\.friction"):
        plant.set_parameter(context, "wall.friction", -0.3)


def scenario_run(name, accuracy, *settings, duration=2.0):
    """The closed loop of a shipped scenario with changes, and its record."""
    scenario = load_scenario(find_scenario(name), settings)
    loop, context = build_scenario(replace(scenario, duration=duration))
    simulate(loop.diagram, context, duration, error_controlled(accuracy))
    return loop, loop.record(context)


@pytest.mark.parametrize("friction", some([0.3, 0.8]))
@pytest.mark.parametrize(
    ("name", "tolerance"),
    [
        # With rigid joints the law is inverse dynamics, and any speed is borne.
        ("two_link_wall", 1e-3),
        pytest.param("seven_joint_wall", 1e-3, marks=pytest.mark.slow),
        # Springs amplify what error control lets pass: by their stiffness into the force.
        pytest.param("two_link_flexible", 0.01, marks=pytest.mark.slow),
        pytest.param("two_link_motors", 0.01, marks=pytest.mark.slow),
        pytest.param("two_link_hydraulics", 0.03, marks=pytest.mark.slow),
    ],
)
def test_a_law_that_knows_the_friction_meets_the_prediction(name, tolerance, friction):
    """Errors are those of (30), (31), reversals included, at accuracy 1e-9.

    Found are 6e-11 m and 1e-13 N with rigid joints; behind springs 3e-8 m and 4e-6 N.
    """
    loop, record = scenario_run(
        name,
        1e-9,
        f"constraints.0.friction={friction}",
        f"constraints.0.stiction_tolerance={tolerance}",
        duration=4.0,
    )
    off = np.abs(record["tracking_error"] - loop.predicted_error(record)).max(axis=0)
    sliding = record["reference"][:, 1]
    assert sliding.min() < -0.05 < 0.05 < sliding.max()
    rigid = name.endswith("wall")
    assert np.all(off[:-1] < (1e-9 if rigid else 1e-7))
    assert off[-1] < (1e-10 if rigid else 2e-5)


@pytest.mark.parametrize("friction", [0.3, 0.8])
def test_a_law_that_does_not_know_the_friction_is_off_as_derived(friction):
    """lambda A = J M^-1 J^T r_2, so e_2 = r_2 (A_0 / A - 1), with A by MultibodyPlant.

    And e_1'' + 8 e_1' + 16 e_1 = P M^-1 (J^T e_2 - mu lambda s J_t^T). Round-off of 25 N.
    """
    loop, record = scenario_run(
        "two_link_wall",
        1e-6,
        "constraints.0.friction=0.0",
        "constraints.0.stiction_tolerance=0.01",
        f"plant.parameters={{wall.friction: [{friction}]}}",
        "law.gains={all: [-4.0]}",
    )
    force, desired = record["constraint_force"][:, 0], record["desired_output"][:, 1]
    plant = loop.plant
    context = plant.CreateDefaultContext()
    plant.set_parameter(context, "wall.friction", friction)
    for i in range(0, len(record.time), 10):
        state = record["state"][i]
        q, v = np.split(state, 2)
        n = numbers("two_link", q, v)
        J, J_t = n.constraint_jacobian[0], n.output_jacobian[0]
        s = J_t @ v / np.hypot(J_t @ v, 0.01)
        slip_row = friction * s * J_t
        A_0, A = J @ np.linalg.solve(n.mass, J), J @ np.linalg.solve(n.mass, J - slip_row)
        assert force[i] == pytest.approx(desired[i] * A_0 / A, rel=1e-10)

        error = J_t @ v - record["reference"][i, 1]
        push = J * (force[i] - desired[i]) - slip_row * force[i]
        wanted = J_t @ np.linalg.solve(n.mass, push)
        wanted -= 8.0 * error + 16.0 * record["tracking_error"][i, 0]
        plant.set_state(context, state)
        plant.GetInputPort("control").FixValue(context, record["control"][i])
        rate = plant.EvalTimeDerivatives(context).CopyToVector()
        # z'' = J_t v' + J_t' v; the last by the unforced motion of the point.
        bias = n_bias(q, v)
        found = J_t @ rate[2:] + bias - record["reference"][i, 2]
        assert found == pytest.approx(wanted, abs=1e-9)
    assert np.abs(force - desired).max() > 0.5


def n_bias(q, v):
    """J_t' v of the tool along z, by MultibodyPlant."""
    plant = parse("two_link_arm")
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    plant.SetVelocities(context, v)
    tool, world = plant.GetFrameByName("tool"), plant.world_frame()
    return plant.CalcBiasTranslationalAcceleration(
        context, JacobianWrtVariable.kV, tool, np.zeros(3), world, world
    )[2, 0]
