"""Friction of a point on a surface, against closed forms and MultibodyPlant alone."""

import numpy as np
import pytest
from arms import consistent_states, numbers, touching
from numpy.testing import assert_allclose

from drake_dae import Plane, PointOnSurface, RobotModel, RobotPlant
from drake_dae.errors import ModelError


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
