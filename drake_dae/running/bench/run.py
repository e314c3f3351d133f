"""A loop that a person changes while Drake's Simulator runs it, and the same run again."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import Context, Diagram

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, brief, unknown_name
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import DrakeDaeError, ModelError, describe_os_error
from drake_dae.files import read_text
from drake_dae.running.bench.any_diagram import parts_of_diagram, vector_outputs
from drake_dae.running.bench.description import TICK, Bench, shown_function
from drake_dae.running.bench.inputs import Inputs, started
from drake_dae.simulation.records.record import Record, Recorded
from drake_dae.simulation.simulate import check_config
from drake_dae.trace.functions import TracedFunction

MOST = 100_000_000
"""The longest file of commands, in bytes."""


@checked(ModelError)
@dataclass(frozen=True, eq=False)
class Commands:
    """What was changed in a run, and when.

    Attributes:
        commands: (k, name, value): the input of this name has this value from k ticks after the
            start on.
        end: The number of ticks of the run.
        tick: The length of a tick, in s.

    Raises:
        ModelError: They are not in the order of time, or a number makes no sense.
    """

    commands: Sequence[tuple[int, str, float]]
    end: int
    tick: float = TICK

    def __post_init__(self) -> None:
        before = 0
        for one in self.commands:
            try:
                (k, name, value) = one
                is_right = before <= k <= self.end and str(name) == name and np.isfinite(value)
            except (TypeError, ValueError):
                is_right = False
            if not is_right:
                raise ModelError(
                    f"commands: (tick, name, value), at a tick from {before} to {self.end}, is "
                    f"needed, got {brief(repr(one))}"
                )
            before = one[0]
        if not (np.isfinite(self.tick) and self.tick > 0.0):
            raise ModelError(f"commands: the tick is a positive time in s, got {self.tick}")

    def save(self, path: str | Path) -> None:
        """Writes them as JSON."""
        Path(path).write_text(json.dumps(asdict(self), indent=1) + "\n", encoding="utf-8")

    @classmethod
    def load(cls, path: str | Path) -> "Commands":
        """Those of a file, of a live bench or of a page.

        Raises:
            ModelError: It cannot be read, or has no commands.
        """
        try:
            found = json.loads(read_text(path, MOST))
            commands = [(int(k), str(name), float(value)) for k, name, value in found["commands"]]
            return cls(commands, int(found["end"]), float(found["tick"]))
        except OSError as error:
            raise ModelError(f"commands: {describe_os_error(error)}") from error
        except (ValueError, TypeError, KeyError, UnicodeDecodeError) as error:
            raise ModelError(f"'{path}' has no commands of a bench: {error!r}") from None


class HandRun:
    """A run by Drake's Simulator, tick by tick, with changes between ticks.

    Args:
        loop: The loop, or any diagram.
        context: The context of its diagram at the start; not changed.
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
        own = started(loop, context) if isinstance(loop, Diagram) else context.Clone()
        check_config(config)
        own.SetAccuracy(config.accuracy)  # For witness functions, as in `simulate`.
        self._simulator = Simulator(diagram, own)
        ApplySimulatorConfig(config, self._simulator)
        self._simulator.set_target_realtime_rate(0.0)
        self._simulator.Initialize()
        self.count = 0
        self._failure: Exception | None = None
        self._log: list[tuple[int, str, float]] = []
        self._rows = list[tuple[float, dict[str, FloatArray]]]()
        self._keep()

    @property
    def context(self) -> Context:
        """The context of the diagram now."""
        return self._simulator.get_context()

    def set(self, changes: Mapping[int, float]) -> None:
        """Changes inputs from now on; number in `Inputs` -> value.

        Raises:
            ModelError: There is no such input, or a value is not finite.
        """
        names = self.inputs.names
        for number, value in changes.items():
            if not 0 <= number < len(names) or not np.isfinite(value):
                raise ModelError(f"no input number {number} takes {value}; there are {len(names)}")
        self.inputs.set(self._simulator.get_mutable_context(), changes)
        self._log += [(self.count, names[number], value) for number, value in changes.items()]

    def advance(self) -> None:
        """Runs one tick.

        Raises:
            DrakeDaeError: The loop cannot go on: where and why; the same at each further call.
        """
        if self._failure is not None:
            raise self._failure
        try:
            self._simulator.AdvanceTo(self._start + (self.count + 1) * self.tick)
        except (DrakeDaeError, RuntimeError) as error:
            self._failure = error
            raise
        self.count += 1
        self._keep()

    @property
    def commands(self) -> Commands:
        """What was changed so far."""
        return Commands(tuple(self._log), self.count, self.tick)

    def record(self) -> Record:
        """The record so far: of a loop what it logs, of a diagram its output ports at each tick."""
        if not isinstance(self.loop, Diagram):
            return self.loop.record(self.context)
        ports, found = parts_of_diagram(self.loop, self.context), dict[str, Recorded]()
        left = list(ports.signals)
        for name in ports.outputs:
            values = np.array([row[name] for _, row in self._rows])
            own, left = left[: values.shape[1]], left[values.shape[1] :]
            found[name] = Recorded(values, tuple(own))
        return Record(np.array([time for time, _ in self._rows]), found)

    def _keep(self) -> None:
        """Keeps a row of a diagram, which logs nothing by itself."""
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
    """The record of a run with given commands: on the same machine, the same numbers.

    Args:
        loop: The loop or diagram that was commanded, or one with inputs of the same names.
        context: The context of its diagram at the start; not changed.
        commands: What was changed, as a live bench or a page saved it.
        config: Drake's settings, as in that run.

    Raises:
        ModelError: The loop has no input of such a name.
        DrakeDaeError: The loop cannot go on: where and why.
    """
    run = HandRun(loop, context, config, commands.tick)
    places = {name: number for number, name in enumerate(run.inputs.names)}
    waiting = list(commands.commands)
    for name in dict.fromkeys(name for _, name, _ in waiting):
        if name not in places:
            own = [place for place in places if not place.endswith("'")]
            raise ModelError(unknown_name("input of the loop", name, own))
    for k in range(commands.end):
        now = {places[name]: value for at, name, value in waiting if at == k}
        waiting = [one for one in waiting if one[0] > k]
        run.set(now)
        run.advance()
    return run.record()


class Sampler:
    """What a bench in a browser shows of a loop at a moment.

    Args:
        bench: The bench of the loop.
    """

    def __init__(self, bench: Bench) -> None:
        self._bench, inputs = bench, bench.controls.inputs
        self._ports = dict(bench.ports)
        columns = {name: ca.SX.sym(name, port.size()) for name, port in self._ports.items()}
        given = ca.SX.sym("inputs", len(inputs.names))
        value = {"shown": shown_function(bench, columns, given)}
        self._function = TracedFunction("bench", {**columns, "inputs": given}, value)
        count = bench.data["prediction"]
        self._count = 0 if count is None else count["size"]

    def __call__(self, context: Context) -> dict[str, Any]:
        """The sample, as plain data; what has no value is None."""
        bench = self._bench
        values = {
            name: port.Eval(port.get_system().GetMyContextFromRoot(context))
            for name, port in self._ports.items()
        }
        shown = self._function(*values.values(), bench.controls.inputs.values(context))[0]
        posed = bench.scene.posed.poses(context)
        shown[: posed.size] = posed
        z, r, phase, place = self._compared(context, values)
        size = len(shown) - self._count
        return {
            "time": context.get_time(),
            "z": _plain(z),
            "r": _plain(r),
            "scene": _plain(shown[:size]),
            "coordinates": _plain(shown[size:]),
            "phase": phase,
            "place": place,
        }

    def _compared(
        self, context: Context, values: Mapping[str, FloatArray]
    ) -> tuple[FloatArray, FloatArray, str, int]:
        """z and r, which a diagram does not know, and the name and the place of the phase."""
        loop = self._bench.loop
        if isinstance(loop, Diagram):
            z = np.concatenate([values[name] for name in self._bench.outputs])
            return z, np.full(z.size, np.nan), "", 0
        changes = loop.changes(context)
        now = (changes[-1].phase, changes[-1].place) if changes else ("", 0)
        return *self._of_loop(loop, context), *now

    def _of_loop(self, loop: ClosedLoop, context: Context) -> tuple[FloatArray, FloatArray]:
        z = loop.diagram.GetOutputPort("controlled_output").Eval(context)
        own = loop.controller.GetMyContextFromRoot(context)
        if "reference" in self._ports:
            reference = self._ports["reference"].Eval(context)
            return z, reference[loop.controller.law.layout.lowest]
        found = loop.controller.compared(
            own, lambda name: loop.diagram.GetOutputPort(name).Eval(context)
        )
        wanted = np.full(z.size, np.nan)
        if found is not None:
            names = [signal.name for signal in loop.plant.dae.output_signals]
            for value, signal in zip(found[1], found[2], strict=True):
                if signal.name in names:
                    wanted[names.index(signal.name)] = value
        return z, wanted


def _plain(values: FloatArray) -> list[float | None]:
    return [value if np.isfinite(value) else None for value in values.tolist()]
