"""Systems that depend on known signals w(t): a rod whose length changes."""

import casadi as ca
import numpy as np
import pytest
import scipy.integrate
from arms import error_controlled
from numpy.testing import assert_allclose
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import DiagramBuilder

import drake_dae as dd
from drake_dae.dae import find_constraint_structure
from drake_dae.diagrams import LoopSettings
from drake_dae.errors import ModelError

GRAVITY = 9.81


def rod(exogenous=("length",), **fields):
    """A mass on a rod of a length that is known; z = (its angle, the rod's multiplier)."""
    given = {
        "f": lambda x, p: [x[2], x[3], 0, -GRAVITY],
        "g": lambda x, p: [[0], [0], [x[0]], [x[1]]],
        "h": lambda x, p: [[0, 0], [0, 0], [1, 0], [0, 1]],
        "k": lambda x, p: (x[0] ** 2 + x[1] ** 2 - p.length**2) / 2,
        "l": lambda x, p: [ca.atan2(x[0], -x[1]), 0],
        "m": lambda x, p: [[0], [1]],
        "nominal_state": [0.1, -1.0, 0.0, 0.0],
        "name": "rod",
    }
    return dd.DaeSystem.from_functions(
        ["x", "y", "vx", "vy"], **(given | fields), parameters={"length": 1.0}, exogenous=exogenous
    )


LENGTH = dd.ExpressionReference(lambda t: 1 + 0.3 * ca.sin(3 * t))


def length(t):
    """w, w', w''."""
    return 1 + 0.3 * np.sin(3 * t), 0.9 * np.cos(3 * t), -2.7 * np.sin(3 * t)


def moving(plant, control):
    """A simulator of a plant whose rod moves, its context and the plant's."""
    builder = DiagramBuilder()
    builder.AddSystem(plant)
    generator = dd.ReferenceGenerator([LENGTH], plant.exogenous_layout.degrees)
    builder.AddSystem(generator)
    builder.Connect(generator.get_output_port(), plant.GetInputPort("exogenous"))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    ApplySimulatorConfig(error_controlled(1e-11), simulator)
    own = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    plant.GetInputPort("control").FixValue(own, control)
    return simulator, own


def test_the_multiplier_is_that_of_the_moving_constraint():
    """x . x' = w w' and its derivative, by hand; to round-off of numbers of size 10."""
    system = rod()
    structure = dd.find_structure(system)
    assert (structure.constraint_degrees, structure.output_degrees) == ((2,), (2, 0))
    values = system.parameter_values
    w, rate, acceleration = 1.3, -0.4, 0.7
    degrees = system.exogenous.degrees(structure.elimination.alpha)
    assert degrees == (2,)
    values[system.exogenous.places(degrees)] = w, rate, acceleration
    x = structure.manifold.project([0.5, -1.2, 0.3, 0.4], values)
    position, velocity = x[:2], x[2:]
    assert_allclose(position @ position, w**2, rtol=1e-14)
    assert_allclose(position @ velocity, w * rate, rtol=1e-14)
    plant = dd.DaePlant(system, structure=structure)
    context = plant.CreateDefaultContext()
    plant.GetInputPort("exogenous").FixValue(context, [w, rate, acceleration])
    plant.GetInputPort("control").FixValue(context, [2.0, -3.0])
    plant.set_state(context, x)
    wanted = w * acceleration + rate**2 - velocity @ velocity
    wanted -= position @ [2.0, -3.0 - GRAVITY]
    found = plant.GetOutputPort("constraint_force").Eval(context)
    assert_allclose(found, wanted / w**2, rtol=1e-13)
    assert_allclose(plant.GetOutputPort("constraint_residual").Eval(context), 0.0, atol=1e-15)


def test_a_motion_is_that_of_the_angle():
    """w a'' + 2 w' a' + g sin a = control along the circle, by DOP853; both at 1e-11 per step."""
    plant = dd.DaePlant(rod())
    simulator, own = moving(plant, [0.5, 0.2])
    start = plant.set_consistent_state(own, [0.4, -0.9, 0.0, 0.0])
    angle = np.arctan2(start[0], -start[1])
    w, rate, _ = length(0.0)
    along = np.array([np.cos(angle), np.sin(angle)])
    speed = along @ start[2:] / w
    assert_allclose(np.array([np.sin(angle), -np.cos(angle)]) @ start[2:], rate, rtol=1e-14)

    def swing(t, y):
        w, rate, _ = length(t)
        push = 0.5 * np.cos(y[0]) + 0.2 * np.sin(y[0])
        return y[1], (push - 2 * rate * y[1] - GRAVITY * np.sin(y[0])) / w

    solution = scipy.integrate.solve_ivp(
        swing, (0, 4), (angle, speed), method="DOP853", rtol=1e-12, atol=1e-13
    )
    simulator.AdvanceTo(4.0)
    simulator.AdvancePendingEvents()
    x = plant.state(own)
    assert_allclose(np.arctan2(x[0], -x[1]), solution.y[0, -1], atol=1e-9)
    assert np.max(np.abs(plant.GetOutputPort("constraint_residual").Eval(own))) < 1e-15


def test_the_law_keeps_its_prediction_while_the_constraint_moves():
    """Off (30) by the integrator's accuracy alone; a law that takes the rod for rigid is not."""
    system = rod()
    law = dd.TrackingLaw(system, dd.poles(-4.0))
    goal = dd.ExpressionReference(lambda t: [0.5 + 0.2 * ca.sin(t), 3 + ca.cos(2 * t)])
    loop = dd.make_closed_loop(dd.DaePlant(system), law, [goal], LoopSettings(exogenous=[LENGTH]))
    simulator = Simulator(loop.diagram)
    ApplySimulatorConfig(error_controlled(1e-10), simulator)
    context = simulator.get_mutable_context()
    loop.plant.set_consistent_state(
        loop.plant.GetMyMutableContextFromRoot(context), [0.2, -1, 0, 0]
    )
    simulator.AdvanceTo(3.0)
    record = loop.record(context)
    off = record["tracking_error"] - loop.predicted_error(record)
    assert np.abs(record["tracking_error"][0]).max() > 0.1
    assert np.max(np.abs(off)) < 1e-8
    assert_allclose(record["exogenous"][:, 0], length(record.time)[0], rtol=1e-15)


def test_without_a_wire_nothing_moves():
    """The same rates as where the length is an ordinary parameter, also after it was changed."""
    still, held = dd.DaePlant(rod()), dd.DaePlant(rod(exogenous=()))
    assert (still.num_input_ports(), held.num_input_ports()) == (2, 1)
    rates = []
    for plant in (still, held):
        context = plant.CreateDefaultContext()
        plant.set_parameter(context, "length", 1.2)
        plant.set_consistent_state(context, [0.4, -0.9, 0.2, 0.1])
        plant.GetInputPort("control").FixValue(context, [0.5, 0.2])
        rates.append(plant.EvalTimeDerivatives(context).CopyToVector())
    assert_allclose(*rates, rtol=1e-14)


def test_the_linear_model_knows_what_moves():
    """x' and its slopes on N* beside those of the plant; central differences are good to 1e-8."""
    system = rod(l=None, m=None)  # A law is not needed.
    structure = find_constraint_structure(system)
    values = system.parameter_values
    values[system.exogenous.places([2])] = 1.3, -0.4, 0.7
    x, u = structure.manifold.project([0.5, -1.2, 0.3, 0.4], values), np.array([2.0, -3.0])
    found = dd.linearize(system, x, u, structure=structure, parameters=values)
    plant = dd.DaePlant(system, structure=structure)
    context = plant.CreateDefaultContext()
    plant.GetInputPort("exogenous").FixValue(context, [1.3, -0.4, 0.7])
    plant.GetInputPort("control").FixValue(context, u)

    def rate(state):
        plant.set_state(context, structure.manifold.project(state, values))
        return plant.EvalTimeDerivatives(context).CopyToVector()

    assert_allclose(found.rate, rate(x), rtol=1e-12)
    steps = 1e-5 * found.basis.T
    slopes = np.array([(rate(x + d) - rate(x - d)) / 2e-5 for d in steps]).T
    assert_allclose(found.minimal.A, slopes[found.coordinates], atol=1e-7)
    assert (found.minimal.C.shape, found.minimal.D.shape) == ((0, 2), (0, 2))


def test_chains_that_need_too_many_derivatives_are_refused():
    x, w = ca.SX.sym("x", 12), dd.Parameter("w", 0.0, exogenous=True)
    system = dd.DaeSystem(
        state=x,
        f=ca.vertcat(x[1:], 0),
        g=ca.vertcat(ca.SX(11, 1), 1),
        h=ca.SX(12, 0),
        k=x[0] - w.symbol,
        l=ca.SX(0, 1),
        m=ca.SX(0, 1),
        parameters=[w],
    )
    with pytest.raises(ModelError, match=r"10.*'w'"):
        find_constraint_structure(system)
