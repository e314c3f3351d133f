"""The warning before a run that cannot keep up with the clock."""

import time

import numpy as np
import pytest
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import EventStatus, LeafSystem

from drake_dae.cli import main
from drake_dae.commands import simulate
from drake_dae.errors import SimulationError
from drake_dae.simulation.real_time import attainable_rate


class Slow(LeafSystem):
    """Takes 2 ms for each step of 1 ms."""

    def __init__(self, fails=False):
        super().__init__()
        self.fails = fails
        self.DeclareContinuousState(1)
        self.DeclarePeriodicPublishEvent(0.001, 0.0, self.wait)

    def DoCalcTimeDerivatives(self, context, derivatives):
        derivatives.SetFromVector([1.0])

    def wait(self, context):
        if self.fails:
            raise SimulationError("nothing goes on", context.get_time(), np.zeros(1))
        time.sleep(0.002)
        return EventStatus.Succeeded()


CONFIG = SimulatorConfig(max_step_size=0.01, target_realtime_rate=1.0, start_time=3.0)


def test_the_rate_is_that_of_the_system():
    slow = Slow()
    context = slow.CreateDefaultContext()
    rate = attainable_rate(slow, context, 10.0, CONFIG)
    assert 0.05 < rate <= 0.5  # A busy machine is slower still.
    assert context.get_time() == 0.0
    assert context.get_continuous_state_vector().CopyToVector() == [0.0]
    assert CONFIG.target_realtime_rate == 1.0


@pytest.mark.parametrize(("fails", "duration"), [(True, 10.0), (False, 0.02)])
def test_a_run_that_fails_or_is_too_short_has_none(fails, duration):
    slow = Slow(fails)
    assert attainable_rate(slow, slow.CreateDefaultContext(), duration, CONFIG) is None


@pytest.mark.slow
def test_it_is_reported_before_the_run(tmp_path, monkeypatch, capsys):
    wanted = ["--set", "integrator.target_realtime_rate=2", "--set", "duration=0.1"]
    writes = [w for key in ("plots", "animation") for w in ("--set", f"write.{key}=false")]
    arguments = ["simulate", "two_link_wall", "--out", str(tmp_path), *wanted, *writes]
    for rate, told in ((0.4, True), (3.0, False), (None, False)):
        monkeypatch.setattr(simulate, "attainable_rate", lambda *_, rate=rate: rate)
        assert main(arguments) == 0
        text = "runs at about 0.4 times real time here, not at 2: the view is slow motion"
        assert (text in capsys.readouterr().out) == told
