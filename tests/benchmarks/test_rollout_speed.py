"""Rollouts against `simulate`, interpreted as it was before machine code, in one run.

Both leave records of the same size, and take one core.
"""

import time
import warnings

import numpy as np
import pytest
from runs import scenario

from drake_dae import build_scenario, rollout, simulate, start_values
from drake_dae.errors import MachineCodeError
from drake_dae.trace.compiled import find_compiler

FIXED = [
    "integrator.integration_scheme=runge_kutta3",
    "integrator.use_error_control=false",
    "integrator.max_step_size=1e-3",
]
CASES = {"1 ms steps": FIXED, "accuracy 1e-8": ["integrator.accuracy=1e-8"]}


def least(function, repeat):
    """The least time of some calls on one core, in s."""
    best = np.inf
    for _ in range(repeat):
        began = time.process_time()
        function()
        best = min(best, time.process_time() - began)
    return best


@pytest.mark.parametrize("name", ["two_link_wall", "seven_joint_wall"])
@pytest.mark.parametrize("case", CASES)
def test_rollout(name, case, report):
    chosen = scenario(name, "duration=10", "compiled=false", *CASES[case])
    loop, context = build_scenario(chosen)
    start, parameters = start_values(loop, context)

    def drake():
        own = loop.diagram.CreateDefaultContext()
        own.SetTimeStateAndParametersFrom(context)
        simulate(loop.diagram, own, chosen.duration, chosen.integrator)
        times.append(loop.record(own).time)

    times: list[np.ndarray] = []
    simulated = least(drake, 3)
    moments = np.linspace(0.0, 10.0, 10001) if case == "1 ms steps" else times[-1]
    found = {"simulate [ms]": f"{1e3 * simulated:.0f}"}

    def run(compiled):
        arguments = (loop, start, parameters, moments)
        (done,) = rollout(*arguments, config=chosen.integrator, compiled=compiled)
        assert done.failure is None

    choices = {"interpreted": False, "machine code": True}
    try:
        find_compiler()
    except MachineCodeError:
        choices.pop("machine code")
    for label, compiled in choices.items():
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            run(compiled)
        taken = least(lambda choice=compiled: run(choice), 5)
        found[label] = (
            f"{1e3 * taken:.1f} ms, x {simulated / taken:.0f} (>{100 if compiled else 7})"
        )
    report(f"{name}: rollout, {case}", found)
