"""The controller of a loop as one step in C99, and a whole loop in C99 that runs over time."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from fractions import Fraction
from math import ceil, floor, gcd, lcm
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context, Diagram, OutputPort, PortDataType
from pydrake.systems.primitives import RandomSource

from drake_dae.arguments import checked
from drake_dae.blocks import machine
from drake_dae.blocks.block import Block, stacked
from drake_dae.blocks.compose import Composed, Leaves, compose, leaf_inputs, leaf_port
from drake_dae.blocks.stepping import FIXED, tableau_of
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.running.c_code import (
    MOST,
    BlockCode,
    Vectors,
    file_of,
    numbers,
    prefix_of,
    recorded_run,
    signals_of,
    write_replay,
    written,
)
from drake_dae.running.merged_run import upstream
from drake_dae.systems.plant import Plant, port_signals
from drake_dae.trace.compiled import generate, renamed, without_branches

CONTROL = "control"  # The name of a controller's output port and a plant's input port.
FINEST = 1000  # The largest ratio of the shortest sample period to the common period.
# The method and the longest step in s of a loop, in place of error control, which no export has.
SCHEME, LONGEST = "runge_kutta5", 1e-3
SAMPLING = "give the loop a sampling, in a scenario `sampling: {period: 0.001}`"

# A step of the program that plays a run, of a controller and of a loop.
CONTROLLER_STEP = """
static int step(int k, double *found) {{
  {prefix}_controller_inputs in;
  {prefix}_controller_outputs out;
  double given[2 + INPUTS];
  given[0] = given[1] = rows[k][0];
  memcpy(given + 2, rows[k] + 1, sizeof(double) * INPUTS);
  memcpy(&in, given, sizeof(given));
  {prefix}_controller_step(&own, &in, &out);
  memcpy(found, &out, sizeof(double) * OUTPUTS); /* They come first. */
  return out.status;
}}
"""
LOOP_STEP = """
static int step(int k, double *found) {{
  const int status = {prefix}_loop_advance(&own, rows[k][0]);
  memcpy(found, &own.outputs, sizeof(double) * OUTPUTS);
  return status;
}}
"""


@checked(ModelError)
def export_controller(
    loop: ClosedLoop | Diagram,
    context: Context,
    name: str,
    folder: str | Path,
    config: SimulatorConfig | None = None,
    duration: float = 2.0,
) -> list[Path]:
    """Writes the whole controller of a loop as one step function in C99.

    The controller consists of all blocks between measurements and control: law, references,
    observer, integrals, samplers, delays, limits, and user blocks between them. Sensors belong to
    the machine: their outputs are inputs of the controller. name_controller.h describes the
    reaction to inputs that are not finite, too old or too late. The program play_name_controller.c
    feeds a recorded run of Drake's Simulator, name_controller_run.csv, to the controller, compares
    its outputs, and measures the time of a step; `make` in the folder runs it.

    Args:
        loop: The closed loop, or any diagram with one `Plant`.
        context: Its context at the start; not changed.
        name: The name of the files, and, as a C identifier, the prefix of the functions.
        folder: The folder to write to; created if it does not exist. Files are overwritten.
        config: Drake's settings of the run; None for defaults.
        duration: The largest duration of the run, in s. The run has at most 2000 steps.

    Returns:
        The paths of the files.

    Raises:
        ModelError: The controller acts continuously, or has a block that cannot be exported.
        OSError: A file cannot be written.
    """
    diagram = loop if isinstance(loop, Diagram) else loop.diagram
    part = ControllerPart(diagram, context)
    ticks, start, code = part.ticks, context.get_time(), part.code
    count = max(1, min(MOST, floor(duration / ticks.period + 1e-9)))
    times = [ticks.time(ticks.at(start) + k) for k in range(count)]
    given = times, code, part.inputs, part.outputs, part.acts_at_once
    run = recorded_run(diagram, context, config or SimulatorConfig(), *given)
    words = part.words(name, start)
    files = {f"{file_of(name)}_controller.{end}": f"controller.{end}" for end in ("h", "c")}
    step = {"step": CONTROLLER_STEP.format(prefix=words["prefix"]), "calls": "1000000"}
    made = written(folder, files, words)
    return [*made, *write_replay(code, "controller", name, folder, run, step)]


class Ticks:
    """The fewest instants k period, k = 0, 1, ..., that all updates are at; times in s.

    `rates` are (period, offset) -> the number of ticks between updates, and the tick of the first.
    """

    def __init__(self, rates: list[tuple[float, float]], alone: float = 0.0) -> None:
        """Of updates with these periods and offsets; without any each period is `alone`."""
        self.period, self.rates = alone, dict[tuple[float, float], tuple[int, int]]()
        if not rates:
            return
        # Without the round-off of computed times.
        exact = {rate: [Fraction(t).limit_denominator(10**9) for t in rate] for rate in rates}
        times = [time for pair in exact.values() for time in pair]
        denominator = lcm(*(time.denominator for time in times))
        tick = Fraction(gcd(*(int(time * denominator) for time in times)), denominator)
        if tick * FINEST < min(period for period, _ in exact.values()):
            known = ", ".join(f"{float(time):g} s" for time in sorted({*times} - {0}))
            raise ModelError(
                f"periods and delays have no common tick above {float(tick):g} s: {known}. Choose "
                "multiples of one period"
            )
        self.period = float(tick)
        self.rates = {
            rate: (int(p / tick), int(first / tick)) for rate, (p, first) in exact.items()
        }

    def at(self, time: float) -> int:
        """The first tick at or after a time in s; times that differ by 1e-9 periods are equal."""
        return ceil(time / self.period - 1e-9)

    def time(self, tick: int) -> float:
        """The time of a tick in s, equal to Drake's to the last bit: offset + k period."""
        time = tick * self.period
        for (period, offset), (every, first) in self.rates.items():
            if tick >= first and (tick - first) % every == 0:
                time = offset + (tick - first) // every * period
        return time


class ControllerPart:
    """The controller of a diagram with one `Plant`, and the ports of its inputs and outputs there.

    It acts at once if the control has direct feedthrough from measurements.
    """

    def __init__(self, diagram: Diagram, context: Context) -> None:
        machine = list(_machine(diagram))
        plants = [system for system in machine if isinstance(system, Plant)]
        if len(plants) != 1:
            raise ModelError(
                f"an export cuts a diagram at its plant, and this one has {len(plants)}: a Plant, "
                "as RobotPlant, DaePlant or ContactPlant"
            )
        (plant,), leaves, measured = plants, Leaves.of(diagram), dict[str, OutputPort]()
        for system in machine:
            for port in map(system.get_output_port, range(system.num_output_ports())):
                own = port.get_name()
                measured[f"{system.get_name()}_{own}" if own in measured else own] = port
        place = leaf_inputs(plant, int(plant.GetInputPort(CONTROL).get_index()))[0]
        control = leaves.sources.get(place)
        if control is None:
            raise ModelError(f"nothing leads to the control of '{plant.get_name()}'")
        leading = upstream(leaves, [control], {leaf_port(port) for port in measured.values()})
        outputs = {CONTROL: control[0].get_output_port(control[1])}
        for port in map(diagram.get_output_port, range(diagram.num_output_ports())):
            is_vector = port.get_data_type() == PortDataType.kVectorValued and port.size()
            if is_vector and leaf_port(port)[0] in leading and leaf_port(port) != control:
                outputs.setdefault(port.get_name(), port)
        composed = compose(diagram, outputs, cuts=measured, context=context)
        block, self.acts_at_once = _checked(composed, measured)
        if self.acts_at_once and not plant.time_step:
            raise ModelError(
                f"the controller acts continuously, and as one step it needs samples: {SAMPLING}"
            )
        known: Vectors = {
            **port_signals(plant.structure),
            **plant.further_signals,
            "estimated_state": plant.dae.state_signals,
            "measured_force": plant.dae.constraint_input_signals,
        }
        inputs = {
            name: signals_of(known, name, symbol.numel()) for name, symbol in block.inputs.items()
        }
        inputs = {name: signals for name, signals in inputs.items() if name in measured}
        self.code = BlockCode(replace(composed, block=block), context, inputs, known)
        rates = [(rate.period, rate.offset) for rate in self.code.steps.rates]
        self.ticks = Ticks(rates, plant.time_step)
        self.inputs = {name: leaf_port(measured[name]) for name in inputs}
        self.outputs = {name: leaf_port(outputs[name]) for name in block.outputs}

    def words(self, name: str, start: float) -> dict[str, str]:
        """The texts for the templates."""
        code, ticks = self.code, self.ticks
        first = ticks.at(start)
        moments, updates = list[str](), list[str]()
        for is_unrestricted in (True, False):  # In Drake's order.
            calls = list[str]()
            for i, rate in enumerate(code.steps.rates):
                every, begins = ticks.rates[rate.period, rate.offset]
                due = f"if (tick >= {begins} && (tick - {begins}) % {every} == 0)"
                if rate.is_unrestricted is is_unrestricted:
                    count = f"(double)((tick - {begins}) / {every})"
                    moments.append(f"  {due} time = {rate.offset!r} + {count} * {rate.period!r};\n")
                    given = f"generated_update_{i}, c, time, before, held + {rate.places[0]}"
                    calls.append(f"  {due} {{\n    evaluate({given});\n  }}\n")
            updates += ["  memcpy(before, held, sizeof(before));\n", *calls] if calls else []
        shown = ["  evaluate(generated_row, c, time, held, row);\n"]
        steps = [*moments, *(shown + updates if self.acts_at_once else updates + shown)]
        begin = ""
        if "begin" in code.steps.functions:
            at = f"{ticks.time(first)!r}"
            begin = "  double held[HELD + 1];\n  memcpy(held, c->held, sizeof(held));\n"
            begin += f"  evaluate(generated_begin, c, {at}, held, c->held);\n"
        unused = "rate", "newton"  # There is no continuous state.
        functions = (
            renamed(function, f"generated_{key}")
            for key, function in code.steps.functions.items()
            if key not in unused
        )
        return code.words(name) | {
            "generated": without_branches(generate(*functions)),
            "period": repr(ticks.period),
            "start": repr(ticks.time(first)),
            "first": str(first),
            "num_controls": str(len(code.outputs[CONTROL])),
            "steps": "".join(steps),
            "begin": begin,
        }


def _machine(diagram: Diagram) -> Iterator[Any]:
    """The plants and the sensors in a diagram."""
    for system in diagram.GetSystems():
        if isinstance(system, Plant) or getattr(system, "measures", False):
            yield system
        elif isinstance(system, Diagram):
            yield from _machine(system)


def _checked(composed: Composed, measured: Mapping[str, OutputPort]) -> tuple[Block, bool]:
    """A controller's block without outputs that act at once, and whether its control does."""
    block = composed.block
    for system in composed.states:
        raise ModelError(
            f"'{system.get_name()}' has a continuous state, as integrals of a law without samples: "
            f"{SAMPLING}"
        )
    for name in composed.cuts.keys() - measured.keys():
        raise ModelError(
            f"the controller reads '{name}', which cannot be traced: put it behind a sensor, as "
            "random numbers, or leave it out"
        )
    if not composed.cuts:
        raise ModelError("the controller reads nothing that is measured, so that none is needed")
    given = stacked([block.inputs[name] for name in composed.cuts])
    acts_at_once = bool(ca.depends_on(block.outputs[CONTROL], given))
    outputs = {
        name: value
        for name, value in block.outputs.items()
        if name == CONTROL or not ca.depends_on(value, given)
    }
    held = [each for one in block.held.values() for each in (one.next, one.begin)]
    used = block.sources(*outputs.values(), *(each for each in held if each is not None))
    left_out = [name for name in composed.cuts if f"input {name}" not in used]
    inputs = {name: symbol for name, symbol in block.inputs.items() if name not in left_out}
    return replace(block, inputs=inputs, outputs=outputs), acts_at_once


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
    words = {"step": LOOP_STEP.format(prefix=prefix_of(name)), "calls": "20000"}
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
