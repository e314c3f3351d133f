"""The predicted spread by noise, beside Lyapunov's equation and the spread of many runs."""

import numpy as np
import pytest
from pydrake.common import RandomDistribution
from pydrake.symbolic import Variable, if_then_else
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import (
    ConstantVectorSource,
    Gain,
    Integrator,
    LinearSystem,
    RandomSource,
    SymbolicVectorSystem,
    ZeroOrderHold,
)
from scipy.linalg import solve_discrete_lyapunov

from drake_dae import load_scenario, noise_spread, rollout, start_values
from drake_dae.errors import ModelError
from drake_dae.running.rollout.spread.noise import spread_with_rounding
from drake_dae.running.rollout.spread.rounding import Rounding
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.shipped import find_scenario
from drake_dae.scenario.start import start_scenario

PERIOD = 0.01


def filtered(hold, distribution=RandomDistribution.kGaussian):
    """Noise, held for a time, through z+ = A z + B n, y = C z + D n: a diagram and its matrices."""
    A = np.array([[0.9, 0.2], [-0.1, 0.8]])
    B, C, D = np.array([[0.5], [1.0]]), np.array([[1.0, -0.5]]), np.array([[0.3]])
    builder = DiagramBuilder()
    noise = builder.AddSystem(RandomSource(distribution, 1, PERIOD))
    held = builder.AddSystem(ZeroOrderHold(hold, 1))
    system = builder.AddSystem(LinearSystem(A, B, C, D, PERIOD))
    builder.Connect(noise.get_output_port(), held.get_input_port())
    builder.Connect(noise.get_output_port(), system.get_input_port())
    builder.ExportOutput(held.get_output_port(), "held")
    builder.ExportOutput(system.get_output_port(), "y")
    return builder.Build(), (A, B, C, D)


def test_a_linear_filter_has_the_spread_of_lyapunovs_equation():
    """Drake draws a number before the filter reads it: y_k = C A z + (C B + D) n, z of before."""
    diagram, (A, B, C, D) = filtered(PERIOD)
    start, parameters = start_values(diagram, diagram.CreateDefaultContext())
    found = noise_spread(diagram, start, parameters, [3 * PERIOD, 10.0])
    direct, change = C @ B + D, C @ (A - np.eye(2))
    # Two numbers came before the third, and then more than count.
    spreads = (B @ B.T + A @ B @ B.T @ A.T, solve_discrete_lyapunov(A, B @ B.T))
    for row, spread in enumerate(spreads):
        wanted = np.sqrt(C @ A @ spread @ A.T @ C.T + direct**2)
        assert found.deviations["y"][row, 0] == pytest.approx(wanted[0, 0], rel=1e-8)
        moved = change @ A @ spread @ A.T @ change.T
        wanted = np.sqrt(moved + (change @ B - D) ** 2 + direct**2)
        assert found.changes["y"][row, 0] == pytest.approx(wanted[0, 0], rel=1e-8)
    np.testing.assert_allclose(found.times, [3 * PERIOD, 10.0])


def test_samples_of_several_rates_repeat_after_the_longest():
    """What is held for half a period is the last number: its deviation is that of the noise."""
    diagram, _ = filtered(PERIOD / 2.0)
    start, parameters = start_values(diagram, diagram.CreateDefaultContext())
    found = noise_spread(diagram, start, parameters, [1.0])
    assert found.deviations["held"][0, 0] == pytest.approx(1.0, rel=1e-8)
    assert found.rms("held").shape == (1,)
    with pytest.raises(ModelError, match="no signal 'hold'; did you mean 'held'"):
        found.rms("hold")


def test_slopes_that_change_are_computed_as_often_as_needed():
    """Noise times t^2 through z+ = 0.99 z: beside the sum over all samples, by one time alone.

    With the slopes at the end for all samples it would be 70 per cent too much.
    """
    builder = DiagramBuilder()
    source = builder.AddSystem(RandomSource(RandomDistribution.kGaussian, 1, PERIOD))
    time, z, noise = Variable("t"), Variable("z"), Variable("n")
    memory = builder.AddSystem(
        SymbolicVectorSystem(
            time=time,
            state=[z],
            input=[noise],
            dynamics=[0.99 * z + time**2 * noise],
            output=[z],
            time_period=PERIOD,
        )
    )
    builder.Connect(source.get_output_port(), memory.get_input_port())
    builder.ExportOutput(memory.get_output_port(), "z")
    diagram = builder.Build()
    start, parameters = start_values(diagram, diagram.CreateDefaultContext())
    found = noise_spread(diagram, start, parameters, [1.0])
    k = np.arange(100)
    wanted = np.linalg.norm(0.99 ** (99 - k) * (PERIOD * k) ** 2)
    assert found.rms("z")[0] == pytest.approx(wanted, rel=0.1)


def test_slopes_of_one_moment_that_grow_beyond_numbers_hold_for_this_moment():
    """z+ = 5 z + n at first, and z / 2 + n from the third sample on: 25^400 is no number."""
    builder = DiagramBuilder()
    source = builder.AddSystem(RandomSource(RandomDistribution.kGaussian, 1, PERIOD))
    time, z, noise = Variable("t"), Variable("z"), Variable("n")
    memory = builder.AddSystem(
        SymbolicVectorSystem(
            time=time,
            state=[z],
            input=[noise],
            dynamics=[if_then_else(time < 2.5 * PERIOD, 5.0, 0.5) * z + noise],
            output=[z],
            time_period=PERIOD,
        )
    )
    builder.Connect(source.get_output_port(), memory.get_input_port())
    builder.ExportOutput(memory.get_output_port(), "z")
    diagram = builder.Build()
    start, parameters = start_values(diagram, diagram.CreateDefaultContext())
    found = noise_spread(diagram, start, parameters, [400 * PERIOD])
    assert found.rms("z")[0] == pytest.approx((4.0 / 3.0) ** 0.5, rel=1e-6)


def test_other_random_numbers_have_their_own_deviation():
    """Numbers between 0 and 1 have the variance 1 / 12, and those of e^-n the variance 1."""
    gaussian, uniform, exponential = (
        noise_spread(diagram, *start_values(diagram, diagram.CreateDefaultContext()), [1.0])
        for kind in ("kGaussian", "kUniform", "kExponential")
        for diagram in [filtered(PERIOD, getattr(RandomDistribution, kind))[0]]
    )
    assert uniform.rms("y") == pytest.approx(gaussian.rms("y") / 12.0**0.5, rel=1e-8)
    assert exponential.rms("y") == pytest.approx(gaussian.rms("y"), rel=1e-8)


def test_what_has_no_spread_is_refused_in_a_sentence():
    diagram, _ = filtered(PERIOD * 1.0101)
    start, parameters = start_values(diagram, diagram.CreateDefaultContext())
    with pytest.raises(ModelError, match="samples that repeat with the longest"):
        noise_spread(diagram, start, parameters, [5.0])
    loop = build_completed(load_scenario(find_scenario("wall_bounce")))[1]
    with pytest.raises(ModelError, match="changes at times that a run locates"):
        noise_spread(loop, *start_values(loop, loop.diagram.CreateDefaultContext()), [1.0])
    late = ["sampling={period: 0.001, delay: 0.001, jitter: 0.0002}"]
    loop = build_completed(load_scenario(find_scenario("two_link_wall"), late))[1]
    with pytest.raises(ModelError, match="late or are lost at random"):
        noise_spread(loop, *start_values(loop, loop.diagram.CreateDefaultContext()), [1.0])


@pytest.mark.slow
@pytest.mark.thorough
def test_a_robot_in_contact_has_the_spread_of_its_runs():
    """Beside 24 runs of 2 s.

    The slowest part of the errors has a time constant of 0.1 s, so that these are some 200
    independent values of each, whose deviation is known to 5 per cent: 20 per cent is four times as
    much.
    """
    settings = [
        "plant=!CompliantContact {time_step: 0.001, stiffness: 1.0e5, friction: 0.3}",
        "sampling={period: 0.001, delay: 0.001}",
        "gains=",
        "encoders={position_noise: 5.0e-5, velocity_noise: 0.01}",
        "force_feedback=!MeasuredForce {sample_period: 0.001, noise_deviation: 0.3}",
    ]
    completed, loop = build_completed(load_scenario(find_scenario("wall_point_contact"), settings))
    scenario = completed.scenario
    start, parameters = start_values(loop, start_scenario(scenario, loop))
    config = scenario.integrator
    found = noise_spread(loop, start, parameters, [1.0, 1.5, 2.0], config=config)
    times = np.arange(0.0, 2.0005, 0.001)
    runs = rollout(loop, start, parameters, times, config=config, seeds=list(range(24)))
    late = [run.record["controlled_output"][1000:] for run in runs]
    measured = np.sqrt(np.mean(np.var(late, axis=0, ddof=1), axis=0))
    np.testing.assert_allclose(found.rms("controlled_output"), measured, rtol=0.2)
    steps = [np.diff(run.record["control"][1000:], axis=0) for run in runs]
    rough = np.sqrt(np.mean(np.sum(np.var(steps, axis=0, ddof=1), axis=1)))
    assert found.roughness("control") == pytest.approx(rough, rel=0.05)


def rounded(speed, step):
    """A position that moves at a speed, and a filter of what its encoder adds; see `filtered`."""
    _, matrices = filtered(PERIOD)
    builder = DiagramBuilder()
    source = builder.AddSystem(RandomSource(RandomDistribution.kGaussian, 1, PERIOD))
    source.set_name("encoder")
    gain = builder.AddSystem(Gain(step / 12.0**0.5, 1))
    system = builder.AddSystem(LinearSystem(*matrices, PERIOD))
    motion = builder.AddSystem(ConstantVectorSource([speed]))
    position = builder.AddSystem(Integrator(1))
    for before, after in ((source, gain), (gain, system), (motion, position)):
        builder.Connect(before.get_output_port(), after.get_input_port())
    builder.ExportOutput(position.get_output_port(), "position")
    builder.ExportOutput(system.get_output_port(), "y")
    return builder.Build(), matrices


def spread_of_rounding(turn, step, count):
    """The spread after some samples, in each of which the position moves by some of the steps."""
    diagram, matrices = rounded(turn * step / PERIOD, step)
    start, parameters = start_values(diagram, diagram.CreateDefaultContext())
    rounding = Rounding("encoder", "position", np.array([step]), np.zeros(1))
    times = [PERIOD * count]
    return spread_with_rounding(diagram, start, parameters, times, None, rounding), matrices


def test_rounding_at_rest_is_a_constant_error():
    """Uniform over a step: the filter's sum times h / sqrt(12).

    The prediction has 64 evenly spread zeros, whose deviation is that of all to 1e-4; 1 per cent is
    what the filter has not forgotten of its start.
    """
    found, (A, B, C, D) = spread_of_rounding(0.0, 1e-3, 150)
    wanted = 1e-3 / 12.0**0.5 * (C @ np.linalg.solve(np.eye(2) - A, B) + D)[0, 0]
    assert found.rms("y") == pytest.approx(abs(wanted), rel=0.01)
    assert found.roughness("y") < 0.01 * abs(wanted)


def test_rounding_in_the_first_period_and_twice_in_a_period():
    """A rest in the first period: (C B + D) h / sqrt(12), as a number of Drake's filter comes."""
    step = 1e-3
    diagram, (_, B, C, D) = rounded(0.0, step)
    start, parameters = start_values(diagram, diagram.CreateDefaultContext())
    rounding = Rounding("encoder", "position", np.array([step]), np.zeros(1))
    times = [PERIOD, 1.2 * PERIOD, 3.0 * PERIOD]
    found = spread_with_rounding(diagram, start, parameters, times, None, rounding)
    wanted = abs(C @ B + D)[0, 0] * step / 12.0**0.5
    np.testing.assert_allclose(found.deviations["y"][:2, 0], wanted, rtol=0.01)
    assert np.isfinite(found.changes["y"]).all()


@pytest.mark.parametrize("turn", [0.003, 0.04, 0.37, 2.9])
def test_rounding_in_motion_has_the_spread_of_the_filtered_errors(turn):
    """Beside the same filter of the true errors, over 2,000 zeros of the encoder.

    The prediction has 64 zeros, and its squares are means over 75 samples: 2 per cent.
    """
    step, count = 1e-3, 150
    found, (A, B, C, D) = spread_of_rounding(turn, step, count)
    phases = np.arange(2000) / 2000.0
    z, shown = np.zeros((2, phases.size)), []
    for k in range(count + 1):
        place = turn * k + phases
        error = step * (np.round(place) - place)
        z = A @ z + B * error
        shown.append((C @ z + D * error)[0])
    assert found.deviations["y"][0, 0] == pytest.approx(np.std(shown[-2]), rel=0.02)
    assert found.changes["y"][0, 0] == pytest.approx(np.std(shown[-1] - shown[-2]), rel=0.02)


def test_a_loop_that_holds_a_joint_oscillates_about_a_step_of_its_encoder():
    """Beside the same loop with true rounding, by 2,000 zeros of the encoder.

    A double integrator with an integral of its rounded position moves on until the encoder changes.
    The prediction has 64 zeros, from which a deviation is known to 9 per cent at one time, and this
    is a mean over 500; white noise of the same deviation is less than half of it.
    """
    step, T, count = 1e-3, PERIOD, 1000
    A = np.array([[1.0, T, 0.0], [-30.0 * T, 1.0 - 10.0 * T, -40.0 * T], [T, 0.0, 1.0]])
    B = np.array([[0.0], [-30.0 * T], [T]])
    builder = DiagramBuilder()
    source = builder.AddSystem(RandomSource(RandomDistribution.kGaussian, 1, T))
    source.set_name("encoder")
    gain = builder.AddSystem(Gain(step / 12.0**0.5, 1))
    system = builder.AddSystem(LinearSystem(A, B, np.eye(1, 3), np.zeros((1, 1)), T))
    builder.Connect(source.get_output_port(), gain.get_input_port())
    builder.Connect(gain.get_output_port(), system.get_input_port())
    builder.ExportOutput(system.get_output_port(), "position")
    diagram = builder.Build()
    start, parameters = start_values(diagram, diagram.CreateDefaultContext())
    rounding = Rounding("encoder", "position", np.array([step]), np.zeros(1))
    times = [T * count]
    found = spread_with_rounding(diagram, start, parameters, times, None, rounding)
    zeros = (np.arange(2000) + 0.5) / 2000.0
    z, squares = np.zeros((3, zeros.size)), []
    for _ in range(count):
        place = z[0] / step + zeros
        z = A @ z + B * (step * (np.round(place) - place))
        squares.append(np.mean(np.square(z[0])))
    measured = np.sqrt(np.mean(squares[count // 2 :]))
    assert found.rms("position")[0] == pytest.approx(measured, rel=0.05)
    white = noise_spread(diagram, start, parameters, times).rms("position")[0]
    assert white < 0.5 * measured


def test_an_encoder_without_steps_adds_its_noise():
    """A step of 0 beside the noise of the filter's source itself, within the 3 per cent of 64 runs.

    At one time 64 values would know it to 9 per cent, these are means over 400.
    """
    step, noise = 1e-3, 1e-3 / 12.0**0.5
    diagram, _ = rounded(0.0, step)
    start, parameters = start_values(diagram, diagram.CreateDefaultContext())
    rounding = Rounding("encoder", "position", np.zeros(1), np.array([noise]))
    times = [PERIOD * 800]
    found = spread_with_rounding(diagram, start, parameters, times, None, rounding)
    wanted = noise_spread(diagram, start, parameters, times)
    assert found.rms("y") == pytest.approx(wanted.rms("y"), rel=0.03)
    assert found.roughness("y") == pytest.approx(wanted.roughness("y"), rel=0.03)
    np.testing.assert_allclose(rounding.deviations, [noise])
