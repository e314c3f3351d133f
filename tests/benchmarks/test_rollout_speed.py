"""Rollouts against `simulate` without machine code, in one run, by what they take of one core.

Both leave rows of the same number. The `simulate` of version 0.1 takes 1.3 times as long.
"""

import time
import warnings
from functools import partial

import numpy as np
import pytest
from runs import scenario
from scipy.integrate import DOP853

from drake_dae import build_scenario, rollout, simulate, start_values
from drake_dae.errors import MachineCodeError
from drake_dae.trace.compiler import find_compiler

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


@pytest.mark.parametrize("robot", ["two_link_wall", "seven_joint_wall"])
@pytest.mark.parametrize("case", CASES)
def test_rollout(robot, case, report):
    chosen = scenario(robot, "duration=10", "compiled=false", *CASES[case])
    loop, context = build_scenario(chosen)
    start, parameters = start_values(loop, context)

    def drake():
        own = loop.diagram.CreateDefaultContext()
        own.SetTimeStateAndParametersFrom(context)
        simulate(loop.diagram, own, chosen.duration, chosen.integrator)
        times.append(loop.record(own).time)

    def run(compiled):
        arguments = (loop, start, parameters, moments)
        (done,) = rollout(*arguments, config=chosen.integrator, compiled=compiled)
        assert done.failure is None

    times: list[np.ndarray] = []
    drake()
    moments = np.linspace(0.0, 10.0, 10001) if case == "1 ms steps" else times[-1]

    choices = {"interpreted": False, "machine code": True}
    try:
        find_compiler()
    except MachineCodeError:
        choices.pop("machine code")
    calls = {"simulate": drake, **{name: partial(run, each) for name, each in choices.items()}}
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(4):  # In turn: how fast a core is changes. What is made once comes first.
            for name, call in calls.items():
                seconds[name].append(least(call, 1))
    middle = {name: np.median(values[1:]) for name, values in seconds.items()}
    found = {"simulate [ms]": f"{1e3 * middle['simulate']:.0f}"}
    for label in choices:
        ratio, wanted = middle["simulate"] / middle[label], 7 if label == "interpreted" else 100
        found[label] = f"{1e3 * middle[label]:.1f} ms, x {ratio:.0f} (>{wanted} of 0.1)"
    report(f"{robot}: rollout, {case}", found)


def test_many_runs(report):
    """Random starts of the 2-link wall, 10 s each, on all cores; by the wall clock."""
    try:
        find_compiler()
    except MachineCodeError as error:
        pytest.skip(str(error))
    chosen = scenario("two_link_wall", "integrator.accuracy=1e-6")
    loop, context = build_scenario(chosen)
    start, parameters = start_values(loop, context)
    manifold, random = loop.plant.structure.manifold, np.random.default_rng(0)
    starts = [manifold.settle(start + 0.05 * random.normal(size=4)) for _ in range(1000)]
    moments = np.linspace(0.0, 10.0, 101)
    rollout(loop, start, parameters, moments, config=chosen.integrator, compiled=True)
    began = time.perf_counter()
    runs = rollout(loop, starts, parameters, moments, config=chosen.integrator, compiled=True)
    took = time.perf_counter() - began
    assert len(runs) == 1000
    figures = {"runs": "1000", "wall [s]": f"{took:.2f} (<6)", "times real": f"{1e4 / took:.0f}"}
    report("two_link_wall: many rollouts", figures)


def test_own_stepper(report):
    """SciPy's DOP853 on law and plant as machine code, with a projection after each step."""
    try:
        find_compiler()
    except MachineCodeError as error:
        pytest.skip(str(error))
    chosen = scenario("seven_joint_wall", "integrator.accuracy=1e-8", "compiled=true")
    loop, context = build_scenario(chosen)
    start, parameters = start_values(loop, context)
    settings = {"config": chosen.integrator, "compiled": True}
    (done,) = rollout(loop, start, parameters, [0.0, 10.0], **settings)
    own = least(lambda: rollout(loop, start, parameters, [0.0, 10.0], **settings), 10)
    plant, law = loop.plant, loop.controller.law.function
    values, numbers = plant.dae.parameter_values, loop.controller.law.all_parameters()

    def rate(time, state):
        control = law.evaluate(state, loop.reference.reference(time), numbers)[0]
        return plant.dynamics.evaluate(state, control, values)[0].copy()

    def scipy():
        solver = DOP853(rate, 0.0, start, 10.0, max_step=10.0 / done.steps)
        for _ in range(done.steps):
            solver.step()
            solver.y = plant.structure.manifold.project(solver.y, values)
            solver.f = rate(solver.t, solver.y)

    taken = least(scipy, 10)
    ratio = f"{1e3 * own:.1f} ms, x {taken / own:.1f} (>3)"
    report("seven_joint_wall: own stepper", {"SciPy [ms]": f"{1e3 * taken:.1f}", "own": ratio})
