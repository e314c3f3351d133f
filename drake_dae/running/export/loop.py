"""A whole loop over time in C99: its block, around which stands the stepper of rollouts."""

from pathlib import Path

import numpy as np
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context, Diagram
from pydrake.systems.primitives import RandomSource

from drake_dae.arguments import checked
from drake_dae.blocks import machine
from drake_dae.blocks.compose import Composed, compose, leaf_port
from drake_dae.blocks.stepping import FIXED, tableau_of
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.running.export.c_code import (
    MOST,
    BlockCode,
    Vectors,
    file_of,
    numbers,
    prefix_of,
    recorded_run,
    write_replay,
    written,
)

# The method and its longest step in s in place of error control, which no export has.
SCHEME, LONGEST = "runge_kutta5", 1e-3
# A step of the program that plays a run.
STEP = """
static int step(int k, double *found) {{
  const int status = {prefix}_loop_advance(&own, rows[k][0]);
  memcpy(found, &own.outputs, sizeof(double) * OUTPUTS);
  return status;
}}
"""


@checked(ModelError)
def export_loop(
    loop: ClosedLoop | Diagram,
    context: Context,
    name: str,
    folder: str | Path,
    config: SimulatorConfig | None = None,
    duration: float = 1.0,
) -> list[Path]:
    """Writes a whole loop, or any diagram that can be compiled, as C99 that runs over time.

    Plant, sensors and controller are integrated by the stepper of rollouts, in the fixed steps of
    the config; with error control, or for None, they are at most 1 ms by `runge_kutta5`.
    name_loop.h describes the functions. Outputs are the signals of a record; of a diagram, its
    vector output ports. The program play_name_loop.c compares with a recorded run of Drake's
    Simulator from the context on, of at most 2000 steps, name_loop_run.csv; `make` in the folder
    runs it.

    Raises:
        ModelError: It has Drake's own contact, noise, or a block that cannot be traced; or the
            fixed steps are of an implicit method.
    """
    diagram = loop if isinstance(loop, Diagram) else loop.diagram
    known: Vectors = {} if isinstance(loop, Diagram) else loop.signals
    ports = {name: diagram.GetOutputPort(name) for name in known} or None
    composed = compose(diagram, ports, context=context, shares=False)
    check_traced(composed, "the loop")
    code, start = BlockCode(composed, context, {}, known), context.get_time()
    scheme, step = fixed_steps(config)
    same = SimulatorConfig(integration_scheme=scheme, max_step_size=step, use_error_control=False)
    times = [start + k * step for k in range(max(1, min(MOST, round(duration / step))))]
    outputs = {n: leaf_port(diagram.GetOutputPort(n)) for n in code.outputs}
    run = recorded_run(diagram, context, same, times, code, {}, outputs)
    files = write_loop(code, start, name, folder, config)
    words = {"step": STEP.format(prefix=prefix_of(name)), "calls": "20000"}
    return [*files, *write_replay(code, "loop", name, folder, run, words)]


def check_traced(composed: Composed, what: str) -> None:
    """Refuses a part of a diagram that depends on Drake's own contact, or on noise."""
    for name, (system, _) in composed.cuts.items():
        if isinstance(system, RandomSource):
            raise ModelError(
                f"{what} draws random numbers ('{system.get_name()}'), which no export does: leave "
                "the noise out, in a scenario noise_deviation"
            )
        raise ModelError(
            f"{what} depends on '{name}', which cannot be traced, such as a MultibodyPlant with "
            "Drake's own contact: a CompliantPlant takes its place"
        )


def write_loop(
    code: BlockCode, time: float, name: str, folder: str | Path, config: SimulatorConfig | None
) -> list[Path]:
    """Writes a loop from its start time in s on as name_loop.h and name_loop.c."""
    scheme, longest = fixed_steps(config)
    steps, tableau, file = code.steps, tableau_of(scheme), file_of(name)
    begin = ""
    if "begin" in steps.functions:
        begin = """  memcpy(held, l->held, sizeof(held));
  dae_begin(0, &l->time, l->state, held, l->parameters, l->held);
"""
    start = steps.block.default("state")
    words = code.words(name) | {
        "stepper": machine.source(steps, []),
        "begin": begin,
        "scheme": scheme,
        "longest": repr(longest),
        "start": repr(time),
        "num_states": str(start.size),
        "state": numbers(start),
        "stages": str(tableau.b.size),
        "method_a": numbers(tableau.a.ravel()),
        "method_b": numbers(tableau.b),
        "method_c": numbers(tableau.c),
        "periods": numbers(np.array([rate.period for rate in steps.rates])),
        "offsets": numbers(np.array([rate.offset for rate in steps.rates])),
    }
    return written(folder, {f"{file}_loop.{end}": f"loop.{end}" for end in ("h", "c")}, words)


def fixed_steps(config: SimulatorConfig | None) -> tuple[str, float]:
    """The method of fixed steps and the longest step in s."""
    if config is None or config.use_error_control:
        return SCHEME, LONGEST if config is None else min(LONGEST, config.max_step_size)
    if config.integration_scheme not in FIXED:
        raise ModelError(
            f"integration_scheme: an export takes no fixed steps of {config.integration_scheme}; "
            f"choose {', '.join(FIXED)}, or use_error_control"
        )
    return config.integration_scheme, config.max_step_size
