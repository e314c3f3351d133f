"""References that are commanded, against the response of lags in closed form and their limits."""

from math import factorial

import casadi as ca
import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from drake_dae import ConstantReference, ExpressionReference
from drake_dae.dae import Signal
from drake_dae.systems import CommandedReferences
from drake_dae.systems.references import RATE, RATES, SPEEDS

SIGNALS = (Signal("tool.y", "m"), Signal("wall.force", "N"))


def moving():
    return ExpressionReference(
        lambda t: [0.3 + 0.1 * ca.sin(1.3 * t), 20.0 + 5.0 * ca.sin(2.0 * t)]
    )


def followed(block, commands, times):
    """Rows of R for commands that jump at the start."""
    simulator = Simulator(block)
    integrator = simulator.get_mutable_integrator()
    integrator.set_target_accuracy(1e-11)
    integrator.set_maximum_step_size(0.02)
    context = simulator.get_mutable_context()
    context.get_mutable_numeric_parameter(0).SetFromVector(commands)
    rows = []
    for time in times:
        simulator.AdvanceTo(time)
        rows.append(block.get_output_port().Eval(context).copy())
    return np.array(rows)


@pytest.mark.parametrize("depth", [0, 5])
def test_a_small_jump_is_followed_as_by_equal_lags(depth):
    zero = [ConstantReference(0.0), ConstantReference(0.0)]
    block = CommandedReferences(zero, (2, 0), SIGNALS, depth=depth)
    times = np.linspace(0.0, 1.0, 30)
    found = followed(block, [0.02, 3.0], times)
    lags = ((0, RATE, max(3, depth), 0.02), (3, RATES["N"], max(1, depth), 3.0))
    for column, rate, count, size in lags:
        terms = [(rate * times) ** k / factorial(k) for k in range(count)]
        closed = size * (1.0 - np.exp(-rate * times) * np.sum(terms, axis=0))
        # The accuracy of the integrator.
        np.testing.assert_allclose(found[:, column], closed, atol=1e-8)


@pytest.mark.slow
def test_each_row_is_the_derivative_of_the_one_before_it():
    block = CommandedReferences([moving()], (3, 1), SIGNALS)
    step = 5e-4
    rows = followed(block, [0.5, 60.0], step * np.arange(1600))
    for column in (0, 1, 2, 4):
        slope = np.gradient(rows[:, column], step)[1:-1]
        size = np.abs(rows[:, column + 1]).max()
        # Central differences, whose error is step^2 times the third derivative; near the kink
        # where the first lag leaves its limit it is of the order of the step.
        np.testing.assert_allclose(slope, rows[1:-1, column + 1], atol=5e-3 * size)


def test_any_jump_stays_within_limits_and_does_not_overshoot():
    block = CommandedReferences([ConstantReference(0.0)], (4,), SIGNALS[:1])
    rows = followed(block, [3.0], np.linspace(0.0, 12.0, 1200))
    assert rows[:, 0].min() >= -1e-9
    assert rows[:, 0].max() <= 3.0 + 1e-9
    for k in range(1, 5):
        assert np.abs(rows[:, k]).max() <= (2.0 * RATE) ** (k - 1) * SPEEDS["m"] + 1e-9
    assert np.abs(rows[:, 1]).max() > 0.39  # It moves as fast as it may.


def test_without_commands_it_is_the_references():
    own = moving()
    block = CommandedReferences([own], (2, 0), SIGNALS)
    assert block.commands == SIGNALS
    times = [0.0, 0.5, 1.5]
    found = followed(block, [0.0, 0.0], times)
    np.testing.assert_allclose(found, [own.derivatives([2, 0])(t) for t in times], atol=1e-12)
