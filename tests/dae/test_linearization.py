"""Linear models against each other by their transfer functions, and against closed forms."""

import casadi as ca
import numpy as np
import pytest
from arms import arm, law
from numpy.testing import assert_allclose
from problems import PROBLEMS, hanging_pendulum
from pydrake.systems.framework import InputPortSelection, OutputPortSelection
from pydrake.systems.primitives import Linearize
from scipy.signal import cont2discrete

import drake_dae as dd
from drake_dae.dae import DaeSystem, TrackingLaw, find_structure, linearize, poles

Array = np.ndarray

FREQUENCIES = (0.3j, 2.0j, 17.0j, 1.0 + 0.5j)


def at_rest() -> list[tuple[str, DaeSystem, Array, Array]]:
    """Systems with a state and a control for which x' = 0, by hand."""
    found = []
    pendulum = hanging_pendulum(1.0)
    found.append(("pendulum", pendulum, np.array([0.0, -1.0, 0.0, 0.0]), np.zeros(1)))
    linear = PROBLEMS["linear"]().system
    found.append(("linear", linear, np.zeros(linear.num_states), np.zeros(2)))
    robot = arm("two_link")
    x = robot.structure.states[0].copy()
    x[robot.model.dae.num_states // 2 :] = 0.0
    x = robot.structure.manifold.project(x)
    still = np.zeros(robot.structure.layout.reference_size)
    tracking = law("two_link")
    chain = tracking.error_coordinates(x, still)
    still[tracking.layout.lowest[tracking.layout.dynamic]] = chain[tracking.layout.heads]
    still[tracking.layout.lowest[tracking.layout.direct]] = 7.0
    found.append(("two links", robot.model.dae, x, tracking.control(x, still)))
    return found


@pytest.mark.parametrize(("system", "x", "u"), [case[1:] for case in at_rest()])
def test_both_forms_have_the_same_transfer_functions(system, x, u):
    found = linearize(system, x, u)
    np.testing.assert_allclose(found.rate, 0.0, atol=1e-10)
    n, m = system.num_states, system.num_constraints
    assert found.descriptor.A.shape == (n + m, n + m)
    assert found.minimal.A.shape[0] == n - sum(find_structure(system).constraint_degrees)
    for s in FREQUENCIES:
        expected = found.descriptor.response(s)
        # Both are solved to round-off; the pencil of index 3 has a condition of up to 1e6.
        np.testing.assert_allclose(
            found.minimal.response(s), expected, rtol=1e-8, atol=1e-9 * np.abs(expected).max()
        )
    names = [signal.name for signal in found.minimal.state_signals]
    assert names == [system.state_signals[i].name for i in found.coordinates]


@pytest.mark.parametrize("period", [0.05, 0.4])
def test_drake_s_tools_give_the_poles_of_a_loop(period):
    """x'' = u and z = x, u = -w^2 x - 2 w x': continuous, and sampled, late by one period."""
    w, x, none = 4.0, ca.SX.sym("x", 2), ca.SX(0, 1)
    system = DaeSystem(x, ca.vertcat(x[1], 0), ca.SX(2, 0), ca.SX([0, 1]), none, x[0], ca.SX(1, 0))
    tracking = TrackingLaw(system, poles(-w))
    loop = dd.make_closed_loop(dd.DaePlant(system), tracking, [dd.ConstantReference(0.0)])
    whole = dd.TracedSystem(
        dd.compile_diagram(loop.diagram, context=loop.diagram.CreateDefaultContext())
    )
    none_at_all = InputPortSelection.kNoInput, OutputPortSelection.kNoOutput
    continuous = Linearize(whole, whole.CreateDefaultContext(), *none_at_all)
    # A double pole moves by the root of round-off.
    assert_allclose(np.poly(continuous.A()), np.poly([-w, -w]), atol=1e-12)

    controller = dd.TrackingController(tracking)
    context = controller.CreateDefaultContext()
    controller.GetInputPort("estimated_state").FixValue(context, np.zeros(2))
    controller.GetInputPort("reference").FixValue(context, np.zeros(3))
    state = controller.GetInputPort("estimated_state").get_index()
    gain = Linearize(
        controller, context, state, controller.GetOutputPort("control").get_index()
    ).D()
    found = linearize(system, np.zeros(2))
    gain = gain @ found.basis
    model = found.minimal
    A, B, *_ = cont2discrete((model.A, model.B, model.C, model.D), period)
    late = np.block([[A, B], [gain, np.zeros((1, 1))]])
    # By hand: x_(k+1) = x_k + T x'_k + T^2 / 2 u_(k-1).
    T = period
    expected = [[1.0, T, T * T / 2], [0.0, 1.0, T], [-w * w, -2.0 * w, 0.0]]
    assert_allclose(np.poly(late), np.poly(expected), rtol=1e-12)
