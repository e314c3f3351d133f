"""Rollouts against `simulate`, interpreted as it was before machine code, in one run.

Both leave records of the same size, and take one core.
"""

import time
import warnings

import numpy as np
import pytest
from runs import scenario
from scipy.integrate import DOP853

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
