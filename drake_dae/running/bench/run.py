"""Runs of Drake's Simulator that a person changes, and their repetition from the commands."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import Context, Diagram

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, brief, unknown_name
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import (
    DrakeDaeError,
    InconsistentStateError,
    ModelError,
    describe_os_error,
)
from drake_dae.files import read_text
from drake_dae.running.bench.any_diagram import parts_of_diagram, vector_outputs
from drake_dae.running.bench.description import TICK, Bench, shown_function
from drake_dae.running.bench.inputs import Inputs, with_input_values
from drake_dae.simulation.records.record import Record, Recorded
from drake_dae.simulation.simulate import check_config
from drake_dae.systems.blocks.failures import cannot_go_on
from drake_dae.trace.functions import TracedFunction

MOST_BYTES = 100_000_000
"""The largest size of a file of commands."""


@checked(ModelError)
@dataclass(frozen=True, eq=False)
class Commands:
    """The changes in a run, and their times.

    Attributes:
        commands: (k, name, value): from k ticks after the start, the input with this name has this
            value.
        end: The number of ticks of the run.
        tick: The length of a tick, in s.

    Raises:
        ModelError: The commands are not in chronological order, or a number is not valid.
    """

    commands: Sequence[tuple[int, str, float]]
    end: int
    tick: float = TICK

    def __post_init__(self) -> None:
        last = 0
        for command in self.commands:
            try:
                (k, name, value) = command
                is_valid = last <= k <= self.end and str(name) == name and np.isfinite(value)
            except (TypeError, ValueError):
                is_valid = False
            if not is_valid:
                raise ModelError(
                    f"commands: each is (tick, name, value) with a tick from {last} to {self.end} "
                    f"and a finite value, got {brief(repr(command))}"
                )
            last = k
        if not (np.isfinite(self.tick) and self.tick > 0.0):
            raise ModelError(f"commands: the tick is a positive time in s, got {self.tick}")

    def save(self, path: str | Path) -> None:
        """Writes the commands as JSON."""
        Path(path).write_text(json.dumps(asdict(self), indent=1) + "\n", encoding="utf-8")

    @classmethod
    def load(cls, path: str | Path) -> "Commands":
        """Returns the commands in a file that a live bench or a page saved.

        Raises:
            ModelError: The file cannot be read, or does not contain commands.
        """
        try:
            data = json.loads(read_text(path, MOST_BYTES))
            commands = [(int(k), str(name), float(value)) for k, name, value in data["commands"]]
            return cls(commands, int(data["end"]), float(data["tick"]))
        except OSError as error:
            raise ModelError(f"commands: {describe_os_error(error)}") from error
        except (ValueError, TypeError, KeyError, UnicodeDecodeError) as error:
            raise ModelError(f"'{path}' has no commands of a bench: {error!r}") from None


class HandRun:
    """A run of Drake's Simulator, tick by tick, with changes between ticks.

    Args:
        loop: The loop, or any diagram.
        context: The initial context of its diagram, which is not changed.
        config: Drake's settings of the integrator.
        tick: The length of a tick, in s.
    """

    def __init__(
        self,
        loop: ClosedLoop | Diagram,
        context: Context,
        config: SimulatorConfig | None = None,
        tick: float = TICK,
    ) -> None:
        self.loop, self.inputs, self.tick = loop, Inputs.of(loop, context), tick
        diagram = loop if isinstance(loop, Diagram) else loop.diagram
        self._start = context.get_time()
        config = config or SimulatorConfig()
        is_diagram = isinstance(loop, Diagram)
        initial = with_input_values(diagram, context) if is_diagram else context.Clone()
        check_config(config)
        initial.SetAccuracy(config.accuracy)  # For witness functions, as in `simulate`.
        self._simulator = Simulator(diagram, initial)
        ApplySimulatorConfig(config, self._simulator)
        self._simulator.set_target_realtime_rate(0.0)
        self._simulator.Initialize()
        self.count = 0
        self._failure: DrakeDaeError | None = None
        self._log: list[tuple[int, str, float]] = []
        self._rows = list[tuple[float, dict[str, FloatArray]]]()
        self._record_row()

    @property
    def context(self) -> Context:
        """The present context of the diagram."""
        return self._simulator.get_context()

    def set(self, changes: Mapping[int, float]) -> None:
        """Changes inputs from now on: index in `Inputs` -> value.

        Raises:
            ModelError: There is no such input, or a value is not finite.
        """
        names = self.inputs.names
        for index, value in changes.items():
            if not 0 <= index < len(names) or not np.isfinite(value):
                raise ModelError(f"no input number {index} takes {value}; there are {len(names)}")
        self.inputs.set(self._simulator.get_mutable_context(), changes)
        self._log += [(self.count, names[index], value) for index, value in changes.items()]

    def advance(self) -> None:
        """Runs one tick.

        Raises:
            DrakeDaeError: The loop cannot continue; the message contains time and reason. Each
                further call raises the same error.
        """
        if self._failure is not None:
            raise self._failure
        try:
            self._simulator.AdvanceTo(self._start + (self.count + 1) * self.tick)
        except (InconsistentStateError, RuntimeError) as error:  # As `simulate` reports it.
            context = self._simulator.get_context()
            state = context.get_continuous_state_vector().CopyToVector()
            self._failure = cannot_go_on(context.get_time(), state, str(error))
            raise self._failure from error
        except DrakeDaeError as error:
            self._failure = error
            raise
        self.count += 1
        self._record_row()

    @property
    def commands(self) -> Commands:
        """The changes from the start until now."""
        return Commands(tuple(self._log), self.count, self.tick)

    def record(self) -> Record:
        """Returns the record from the start until now.

        For a loop, these are its logs; for a diagram, its output ports at each tick.
        """
        if not isinstance(self.loop, Diagram):
            return self.loop.record(self.context)
        parts, recorded = parts_of_diagram(self.loop, self.context), dict[str, Recorded]()
        signals = iter(parts.signals)
        for name in parts.outputs:
            values = np.array([row[name] for _, row in self._rows])
            recorded[name] = Recorded(values, tuple(islice(signals, values.shape[1])))
        return Record(np.array([time for time, _ in self._rows]), recorded)

    def _record_row(self) -> None:
        """Records the outputs of a diagram; a loop has its own logs."""
        if isinstance(self.loop, Diagram):
            row = {name: np.array(p.Eval(self.context)) for name, p in vector_outputs(self.loop)}
            self._rows.append((self.context.get_time(), row))


@checked(ModelError)
def replay(
    loop: ClosedLoop | Diagram,
    context: Context,
    commands: Commands,
    config: SimulatorConfig | None = None,
) -> Record:
    """Repeats a run from its commands and returns the record.

    On the machine of the original run, the numbers are identical.

    Args:
        loop: The loop or diagram of the original run, or one with the same names of inputs.
        context: The initial context of its diagram, which is not changed.
        commands: The changes that a live bench or a page saved.
        config: Drake's settings in the original run.

    Raises:
        ModelError: The loop has no input with the name in a command.
        DrakeDaeError: The loop cannot continue; the message contains time and reason.
    """
    run = HandRun(loop, context, config, commands.tick)
    indices = {name: index for index, name in enumerate(run.inputs.names)}
    changes: dict[int, dict[int, float]] = {}
    for k, name, value in commands.commands:
        if name not in indices:
            names = [name for name in indices if not name.endswith("'")]
            raise ModelError(unknown_name("input of the loop", name, names))
        changes.setdefault(k, {})[indices[name]] = value
    for k in range(commands.end):
        run.set(changes.get(k, {}))
        run.advance()
    return run.record()


class Sampler:
    """Samples the values that a bench in a browser shows.

    Args:
        bench: The bench of the loop.
    """

    def __init__(self, bench: Bench) -> None:
        self._bench, self._ports = bench, dict(bench.ports)
        columns = {name: ca.SX.sym(name, port.size()) for name, port in self._ports.items()}
        symbols = ca.SX.sym("inputs", len(bench.controls.inputs.names))
        value = {"shown": shown_function(bench, columns, symbols)}
        self._function = TracedFunction("bench", {**columns, "inputs": symbols}, value)
        prediction = bench.data["prediction"]
        self._num_coordinates = 0 if prediction is None else prediction["size"]

    def __call__(self, context: Context) -> dict[str, Any]:
        """Returns the values in a context in the form of JSON; None for a missing value."""
        values = {
            name: port.Eval(port.get_system().GetMyContextFromRoot(context))
            for name, port in self._ports.items()
        }
        inputs = self._bench.controls.inputs.values(context)
        shown = self._function(*values.values(), inputs)[0]
        posed = self._bench.scene.posed.poses(context)
        shown[: posed.size] = posed
        z, r, phase, index = self._compared(context, values)
        size = len(shown) - self._num_coordinates
        return {
            "time": context.get_time(),
            "z": _plain(z),
            "r": _plain(r),
            "scene": _plain(shown[:size]),
            "coordinates": _plain(shown[size:]),
            "phase": phase,
            "place": index,
        }

    def _compared(
        self, context: Context, values: Mapping[str, FloatArray]
    ) -> tuple[FloatArray, FloatArray, str, int]:
        """Returns z, r, and the name and the index of the phase; r of a diagram is NaN."""
        loop = self._bench.loop
        if isinstance(loop, Diagram):
            z = np.concatenate([values[name] for name in self._bench.outputs])
            return z, np.full(z.size, np.nan), "", 0
        changes = loop.changes(context)
        phase = (changes[-1].phase, changes[-1].place) if changes else ("", 0)
        return *self._compared_in_loop(loop, context), *phase

    def _compared_in_loop(
        self, loop: ClosedLoop, context: Context
    ) -> tuple[FloatArray, FloatArray]:
        """Returns z and r; r is NaN for outputs without reference."""
        z = loop.diagram.GetOutputPort("controlled_output").Eval(context)
        if "reference" in self._ports:
            reference = self._ports["reference"].Eval(context)
            return z, reference[loop.controller.law.layout.lowest]
        compared = loop.controller.compared(
            loop.controller.GetMyContextFromRoot(context),
            lambda name: loop.diagram.GetOutputPort(name).Eval(context),
        )
        r = np.full(z.size, np.nan)
        if compared is not None:
            names = [signal.name for signal in loop.plant.dae.output_signals]
            for value, signal in zip(compared[1], compared[2], strict=True):
                if signal.name in names:
                    r[names.index(signal.name)] = value
        return z, r


def _plain(values: FloatArray) -> list[float | None]:
    return [value if np.isfinite(value) else None for value in values.tolist()]
