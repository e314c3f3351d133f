"""Running a diagram: settings, statistics, interruption, failure."""

import os
import signal
import threading

import numpy as np
import pytest
from arms import fixed_step
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput
from runs import scenario

from drake_dae import DaePlant, DaeSystem, build_scenario
from drake_dae.errors import ModelError, SimulationError
from drake_dae.running.interruption import ENDING_SIGNALS
from drake_dae.running.simulate import check_config, simulate


class Ramp(LeafSystem):
    """x' = 1, and what is to happen once x passes a mark."""

    def __init__(self, mark=np.inf, happening=None):
        super().__init__()
        self.mark, self.happening = mark, happening
        self.DeclareStateOutputPort("x", self.DeclareContinuousState(1))

    def DoCalcTimeDerivatives(self, context, derivatives):
        if context.get_continuous_state_vector()[0] > self.mark:
            self.happening()
        derivatives.get_mutable_vector().SetFromVector([1.0])


def ramp(mark=np.inf, happening=None):
    builder = DiagramBuilder()
    system = builder.AddSystem(Ramp(mark, happening))
    logger = LogVectorOutput(system.get_output_port(), builder)
    diagram = builder.Build()
    return diagram, diagram.CreateDefaultContext(), logger


STEPS = fixed_step(0.125, "runge_kutta3")


def test_statistics_and_end_state():
    diagram, context, logger = ramp()
    run = simulate(diagram, context, 2.0, STEPS)
    assert (run.simulated_time, run.steps, run.interrupted) == (2.0, 16, None)
    assert run.times_real_time == pytest.approx(2.0 / run.wall_time)
    assert context.get_time() == 2.0
    assert context.get_continuous_state_vector()[0] == pytest.approx(2.0, abs=1e-14)
    # The last one is logged again after the pending events, such as a projection.
    times = logger.FindLog(context).sample_times()
    np.testing.assert_array_equal(times, [*np.arange(17) / 8, 2.0])


def test_settings_reach_the_integrator():
    diagram, context, _ = ramp()
    config = SimulatorConfig(start_time=-3.0, accuracy=1e-5, max_step_size=0.5)
    run = simulate(diagram, context, 1.0, config)
    assert context.get_time() == -2.0
    assert run.simulated_time == 1.0
    assert context.get_accuracy() == 1e-5


@pytest.mark.parametrize("duration", [0.0, -1.0, np.nan, np.inf])
def test_duration_is_checked(duration):
    diagram, context, _ = ramp()
    with pytest.raises(ModelError, match="duration"):
        simulate(diagram, context, duration, STEPS)
    assert context.get_time() == 0.0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"integration_scheme": "rk45"}, "'rk45'"),
        ({"integration_scheme": "radau"}, "'radau'"),
        ({"integration_scheme": "cenic"}, "'cenic'"),
        ({"accuracy": 0.0}, r"accuracy.*0.0"),
        ({"max_step_size": 0.0}, r"max_step_size.*0.0"),
        ({"target_realtime_rate": -1.0}, "target_realtime_rate"),
        ({"integration_scheme": "explicit_euler"}, "use_error_control: explicit_euler"),
    ],
)
def test_settings_are_checked(settings, message):
    """Drake takes each of these, and then hangs, ends in the middle, or ignores it."""
    with pytest.raises(ModelError, match=message):
        check_config(SimulatorConfig(use_error_control=True, **settings))
    diagram, context, _ = ramp()
    with pytest.raises(ModelError, match=message):
        simulate(diagram, context, 1.0, SimulatorConfig(use_error_control=True, **settings))


@pytest.mark.slow
def test_a_second_run_of_a_context_is_a_record_of_its_own():
    """It begins at its start_time again, from the state that the first one ended in."""
    chosen = scenario("two_link_measured_force", "duration=0.2")
    loop, context = build_scenario(chosen)
    simulate(loop.diagram, context, 0.2, chosen.integrator)
    first = loop.record(context)
    simulate(loop.diagram, context, 0.1, chosen.integrator)
    second = loop.record(context)
    assert (second.time[0], second.time[-1]) == (0.0, pytest.approx(0.1))
    np.testing.assert_allclose(second["state"][0], first["state"][-1], atol=1e-9)
    # A run that goes on where the last one ended adds to it.
    chosen.integrator.start_time = context.get_time()
    simulate(loop.diagram, context, 0.1, chosen.integrator)
    both = loop.record(context)
    assert (both.time[0], both.time[-1]) == (0.0, pytest.approx(0.2))
    np.testing.assert_array_equal(both["state"][: len(second.time) - 1], second["state"][:-1])


# Interruption, by a real signal.


@pytest.mark.usefixtures("signals_of_a_shell")
@pytest.mark.parametrize("number", ENDING_SIGNALS)
def test_a_signal_ends_the_run_after_its_step(number):
    before = signal.getsignal(number)
    sent = []

    def press():
        if not sent:
            sent.append(True)
            os.kill(os.getpid(), number)

    diagram, context, logger = ramp(0.5, press)
    run = simulate(diagram, context, 2.0, STEPS)
    assert sent
    assert run.interrupted == number
    # The signal comes in the step from 0.5 to 0.625, at one of its stages.
    assert run.simulated_time == context.get_time() == 0.625
    assert run.steps == 5
    logged = logger.FindLog(context).data()[0]
    np.testing.assert_allclose(logged, [*np.arange(6) / 8, 0.625], atol=1e-14)
    assert signal.getsignal(number) is before


@pytest.mark.usefixtures("signals_of_a_shell")
@pytest.mark.parametrize("second", ENDING_SIGNALS)
def test_a_second_signal_is_an_exception_and_the_log_is_kept(second):
    before = signal.getsignal(signal.SIGINT)

    def press_twice():
        for number in (signal.SIGTERM, second):
            os.kill(os.getpid(), number)
            # Python runs the handler between two of its instructions.
            sum(range(1000))

    diagram, context, logger = ramp(0.5, press_twice)
    with pytest.raises(KeyboardInterrupt) as caught:
        simulate(diagram, context, 2.0, STEPS)
    assert caught.value.args == (second,)
    assert logger.FindLog(context).sample_times()[-1] == 0.5
    assert signal.getsignal(signal.SIGINT) is before


def test_runs_outside_of_the_main_thread():
    """Where Python allows no signal handler."""
    result = []
    thread = threading.Thread(target=lambda: result.append(simulate(*ramp()[:2], 1.0, STEPS)))
    thread.start()
    thread.join()
    assert result[0].simulated_time == 1.0


def test_a_state_that_escapes_in_finite_time_ends_the_run():
    """x' = x^2 from 1 is 1 / (1 - t), which Drake follows with ever smaller steps."""
    system = DaeSystem.from_functions(
        ["x"], f=lambda s: [s[0] ** 2], h=lambda s: [1], l=lambda s: [s[0]], nominal_state=[1.0]
    )
    builder = DiagramBuilder()
    plant = builder.AddSystem(DaePlant(system))
    control = builder.AddSystem(ConstantVectorSource([0.0]))
    builder.Connect(control.get_output_port(), plant.GetInputPort("control"))
    diagram = builder.Build()
    config = SimulatorConfig(integration_scheme="runge_kutta5", accuracy=1e-6)
    with pytest.raises(SimulationError) as caught:
        simulate(diagram, diagram.CreateDefaultContext(), 3.0, config, may_diverge=True)
    # Up to the accuracy.
    assert caught.value.time == pytest.approx(1.0, abs=1e-5)
    assert caught.value.state[0] > 1e6
