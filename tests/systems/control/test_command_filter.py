"""References that are commanded, against the response of lags in closed form and their limits."""

from math import factorial

import casadi as ca
import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from scipy.integrate import solve_ivp

from drake_dae import CommandedReferences, CommandLimits, ExpressionReference, ReferenceGenerator
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError, ReferenceSignalError
from drake_dae.systems.control.command_filter import CommandFilter

SIGNALS = (Signal("tool.y", "m"), Signal("wall.force", "N"))
LIMITS = CommandLimits(rates={"m": 9.0, "N": 30.0}, speeds={"m": 0.4, "N": 200.0}, rate=5.0)


def moving():
    return ExpressionReference(
        lambda t: [0.3 + 0.1 * ca.sin(1.3 * t), 20.0 + 5.0 * ca.sin(2.0 * t)]
    )


def followed(made, commands, times, start=0.0):
    """The states of a filter, by an integrator of SciPy, for commands that jump at the start."""
    found = solve_ivp(
        lambda t, x: made.rate(x, commands)[0].copy(),
        (times[0], times[-1]),
        made.start(start),
        t_eval=times,
        rtol=1e-11,
        atol=1e-13,
    )
    return found.y.T


@pytest.mark.parametrize("depth", [0, 5])
def test_a_small_jump_is_followed_as_by_equal_lags(depth):
    made = CommandFilter(SIGNALS, (2, 0), LIMITS, has_speed=False, depth=depth)
    times, jump = np.linspace(0.0, 1.0, 30), np.array([0.02, 3.0])
    states = followed(made, jump, times)
    base = np.zeros(4)
    found = np.array(
        [made.stacked(t, x, jump, base)[0] for t, x in zip(times, states, strict=True)]
    )
    for column, rate, lags, size in ((0, 9.0, max(3, depth), 0.02), (3, 30.0, max(1, depth), 3.0)):
        terms = [(rate * times) ** k / factorial(k) for k in range(lags)]
        closed = size * (1.0 - np.exp(-rate * times) * np.sum(terms, axis=0))
        # The accuracy of the integrator.
        np.testing.assert_allclose(found[:, column], closed, atol=1e-9)


def test_each_row_is_the_derivative_of_the_one_before_it():
    made = CommandFilter(SIGNALS, (3, 1), LIMITS, has_speed=True)
    own = moving()
    base, commands = own.derivatives([3, 1]), np.array([0.4, 0.5, 60.0])
    step = 2e-4
    times = 0.3 + step * np.arange(2000)
    states = followed(made, commands, times, start=0.7)
    rows = np.array(
        [
            made.stacked(t, x, commands, base(x[0]))[0].copy()
            for t, x in zip(times, states, strict=True)
        ]
    )
    for column in (0, 1, 2, 4):
        slope = np.gradient(rows[:, column], step)[1:-1]
        size = np.abs(rows[:, column + 1]).max()
        # Central differences, whose error is step^2 times the third derivative; near the kink
        # where the first lag leaves its limit it is of the order of the step.
        np.testing.assert_allclose(slope, rows[1:-1, column + 1], atol=2e-3 * size)


def test_any_jump_stays_within_limits_and_does_not_overshoot():
    made = CommandFilter(SIGNALS[:1], (4,), LIMITS, has_speed=False)
    times = np.linspace(0.0, 12.0, 4000)
    states = followed(made, np.array([3.0]), times)
    rows = np.array(
        [
            made.stacked(t, x, [3.0], np.zeros(5))[0].copy()
            for t, x in zip(times, states, strict=True)
        ]
    )
    assert rows[:, 0].min() >= -1e-9
    assert rows[:, 0].max() <= 3.0 + 1e-9
    for k in range(1, 5):
        assert np.abs(rows[:, k]).max() <= (2.0 * 9.0) ** (k - 1) * 0.4 + 1e-9
    assert np.abs(rows[:, 1]).max() > 0.39  # It moves as fast as it may.


@pytest.mark.slow
def test_the_block_follows_its_filter_and_begins_with_the_references_as_they_are():
    own = moving()
    block = CommandedReferences([own], (2, 0), SIGNALS, LIMITS, start_time=0.5)
    assert [signal.name for signal in block.commands] == ["path.speed", "tool.y", "wall.force"]
    assert not block.follows_time
    context = block.CreateDefaultContext()
    context.SetTime(0.5)
    plain = own.derivatives([2, 0])
    np.testing.assert_array_equal(block.get_output_port().Eval(context), plain(0.5))
    simulator = Simulator(block, context)
    simulator.get_mutable_integrator().set_target_accuracy(1e-10)
    simulator.AdvanceTo(1.5)
    port = block.get_output_port()
    np.testing.assert_allclose(port.Eval(context), plain(1.5), atol=1e-12)
    # The path stands still; the law's derivatives do, too.
    context.get_mutable_numeric_parameter(0).SetFromVector([0.0, 0.0, 5.0])
    simulator.AdvanceTo(6.0)
    first = port.Eval(context).copy()
    simulator.AdvanceTo(7.0)
    np.testing.assert_allclose(port.Eval(context), first, atol=1e-6)
    np.testing.assert_allclose(first[1:3], 0.0, atol=1e-6)


@pytest.mark.parametrize(
    "wrong", [{"rate": 0.0}, {"speeds": {"m": -1.0}}, {"rates": {"N": np.nan}}]
)
def test_limits_that_make_no_sense_are_refused(wrong):
    with pytest.raises(ModelError, match="CommandLimits"):
        CommandLimits(**wrong)


def test_references_with_parameters_are_not_commanded():
    """Both would be numeric parameter 0 of the block."""
    given = ExpressionReference(lambda t, level: [level, 2.0 * level], {"level": 0.3})
    with pytest.raises(ReferenceSignalError, match=r"parameters cannot be commanded.*of level"):
        CommandedReferences([given], [2, 0], SIGNALS, LIMITS)


def test_what_follows_time_alone_has_no_parameters():
    """A plant may be fed by the latter; the former need not be logged."""
    given = ExpressionReference(lambda t, level: [level, 2.0 * level], {"level": 0.3})
    block = ReferenceGenerator([given], [2, 0])
    assert (block.follows_time, block.is_by_time) == (True, False)
    block = ReferenceGenerator([moving()], [2, 0])
    assert (block.follows_time, block.is_by_time) == (True, True)
    block = CommandedReferences([moving()], [2, 0], SIGNALS, LIMITS)
    assert (block.follows_time, block.is_by_time) == (False, False)
