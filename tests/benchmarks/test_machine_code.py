"""Machine code against the interpreter, in one run and alternating; reported and never judged.

The law alone; the derivative of the whole closed loop in Drake, and a step of runge_kutta3 at 1 ms,
beside those of a plant and a controller in Python that do nothing but copy; and how long the
compiler takes for everything. Without a compiler nothing is reported.
"""

import time
import timeit
import warnings

import numpy as np
import pytest
from runs import scenario
from test_speed import empty_loop, stepping

from drake_dae import build_scenario, export_code, simulate
from drake_dae.errors import MachineCodeError
from drake_dae.trace.compiler import find_compiler
from drake_dae.trace.functions import TracedFunction

SCENARIOS = ["two_link_wall", "seven_joint_wall", "seven_joint_flexible_motors", "two_arms"]


def least(functions: list[TracedFunction], repeat: int = 30, number: int = 300) -> list[float]:
    """Least times of a call in us, each in turn."""
    best = [np.inf] * len(functions)
    arrays = [np.zeros(size) for size in functions[0].sizes]
    for _ in range(repeat):
        for index, function in enumerate(functions):
            seconds = timeit.timeit(lambda f=function: f.evaluate(*arrays), number=number)
            best[index] = min(best[index], 1e6 * seconds / number)
    return best


def derivatives(pairs: list[tuple], repeat: int = 100, number: int = 60) -> np.ndarray:
    """Least times of a derivative at a new state in us, each in turn; other work may go on."""

    def parts(diagram, context):
        state = context.get_continuous_state_vector().CopyToVector()
        rate = diagram.AllocateTimeDerivatives()

        def touch():
            context.SetTime(0.5)
            context.SetContinuousState(state)

        return lambda: (touch(), diagram.CalcTimeDerivatives(context, rate)), touch

    timed = [parts(*pair) for pair in pairs]
    best = np.full((len(timed), 2), np.inf)
    for _ in range(repeat):
        rounds = [[timeit.timeit(f, number=number) for f in both] for both in timed]
        best = np.minimum(best, 1e6 * np.array(rounds) / number)
    return best[:, 0] - best[:, 1]


@pytest.mark.parametrize("name", SCENARIOS)
def test_machine_code(name, report):
    try:
        find_compiler()
    except MachineCodeError as error:
        pytest.skip(str(error))
    settings = ["duration=2", "integrator.accuracy=1e-6"]
    chosen = [scenario(name, *settings, f"compiled={choice}") for choice in ("true", "false")]
    built = [build_scenario(one) for one in chosen]
    seconds = []
    for one, (loop, context) in zip(chosen, built, strict=True):
        own = loop.diagram.CreateDefaultContext()
        own.SetTimeStateAndParametersFrom(context)
        began = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            simulate(loop.diagram, own, 0.01, one.integrator)  # Everything that runs is compiled.
        seconds.append(time.perf_counter() - began)
    laws = least([loop.controller.law.function for loop, _ in built])
    assert built[0][0].controller.law.function.is_machine_code
    law = built[0][0].controller.law
    sizes = law.system.num_states, len(law.reference_signals), law.system.num_controls
    pairs = [(loop.diagram, context) for loop, context in built] + [empty_loop(*sizes)]
    code, interpreted, empty = derivatives(pairs)
    steppers = [stepping(*pair) for pair in pairs]
    steps = np.min([[step() for step in steppers] for _ in range(30)], axis=0)
    runs = [
        simulate(loop.diagram, context, one.duration, one.integrator).wall_time
        for one, (loop, context) in zip(chosen, built, strict=True)
    ]
    report(
        f"{name}: machine code, interpreted",
        {
            "law [us]": f"{laws[0]:.1f}, {laws[1]:.1f}",
            "law": f"x {laws[1] / laws[0]:.1f}",
            "derivative [us]": f"{code:.1f}, {interpreted:.1f}",
            "of empty blocks": f"x {code / empty:.2f} (<1.5), x {interpreted / empty:.2f} (<3)",
            "1 ms step [us]": f"{steps[0]:.0f}, {steps[1]:.0f}",
            "that of empty blocks": f"x {steps[0] / steps[2]:.1f}, x {steps[1] / steps[2]:.1f}",
            "run": f"x {runs[1] / runs[0]:.1f}",
            "compiled [s]": f"{seconds[0] - seconds[1]:.1f}",
        },
    )


def test_export(report, tmp_path):
    """How long it takes to write C99, and how large it is."""
    loop, context = build_scenario(scenario("seven_joint_wall"))
    began = time.perf_counter()
    files = export_code(loop, context, "seven_joint_wall", tmp_path)
    took = time.perf_counter() - began
    size = next(path.stat().st_size for path in files if path.name == "seven_joint_wall.c")
    report(
        "seven_joint_wall: export", {"written [s]": f"{took:.2f}", "C [kB]": f"{size / 1e3:.0f}"}
    )
