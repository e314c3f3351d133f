"""Runs of a diagram whose plant Drake steps; one call computes all other blocks at a sample."""

from collections.abc import Callable
from contextlib import suppress
from math import isfinite
from typing import Self

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, PortDataType, System, TriggerType
from pydrake.systems.primitives import VectorLogSink

from drake_dae.arrays import FloatArray
from drake_dae.blocks.computations import Traced
from drake_dae.blocks.lifetime import SHARED_DICTIONARY
from drake_dae.compiler.called import BufferedFunction
from drake_dae.compiler.compile import compile_diagram
from drake_dae.compiler.compiled import CompiledDiagram
from drake_dae.compiler.groups import discrete_states
from drake_dae.compiler.stepped import NO_EVENTS, Sample, SteppedDiagram
from drake_dae.compiler.wires import Wires
from drake_dae.errors import DrakeDaeError
from drake_dae.systems.plants.contract import Plant

EVERY = 32
"""The number of samples that are computed before the context of the diagram gets their results."""

WORTH = 500
"""The least number of steps of the plant for which tracing the diagram takes less time than it
saves."""

NEAR = 1e-6
"""The distance of another state at which ports are compared, in any unit."""


class SampleLog(VectorLogSink):
    """A log of a signal at the multiples of a period.

    Args:
        size: The number of entries of the signal.
        period: The period, in s.

    Attributes:
        period: The period, in s.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(self, size: int, period: float) -> None:
        super().__init__(size, {TriggerType.kPeriodic}, period)
        self.period = period


class SampledRun:
    """A run of a diagram whose only plant is stepped by Drake, with all other blocks as one call.

    The context of the diagram, its log included, is that of Drake's Simulator, except for the last
    bits of numbers. It changes once in `EVERY` samples.

    Args:
        compiled: The diagram, whose output is what is logged.
        log: The log of the diagram.
        context: The context of the diagram after the initialization events; changed in place.

    Attributes:
        steps: The number of steps.
    """

    def __init__(self, compiled: CompiledDiagram, log: SampleLog, context: Context) -> None:
        self._compiled, self._context, self.steps = compiled, context, 0
        self._row, self._add = BufferedFunction(compiled.row), log.FindMutableLog(context).AddData
        self._time = start = context.get_time()
        (rate, block), self._parameters = compiled.stepped, compiled.values(context)
        assert block.stepped is not None
        self._block, self._first_rest = block, len(rate.places)
        system = self._system = block.stepped.system
        own = system.CreateDefaultContext()
        own.SetTime(start)
        own.SetStateAndParametersFrom(system.GetMyContextFromRoot(context))
        held = compiled.start(context, has_begun=True)[1]
        held = compiled.initialized(start, np.zeros(0), held, self._parameters)
        choice = block.system.dae.compiled if isinstance(block.system, Plant) else "auto"
        self._own = own
        self._diagram = SteppedDiagram(compiled, own, held, self._parameters, choice)
        self._noise = np.zeros(compiled.sizes["noise"])
        self._sources = [_Noise(source, part, compiled, context) for source, part in compiled.noise]
        # The number of the next sample of each rate, and of the log, which has the last bit.
        self._rates = [(rate.period, rate.offset) for rate in compiled.rates]
        self._rates.append((log.period, 0.0))
        self._numbers = [_first_sample(*rate, start) for rate in self._rates]
        # The log has the start already.
        self._due = self._due_at(start) % (1 << len(compiled.rates))

    @classmethod
    def of(cls, diagram: System, context: Context, duration: float) -> Self | None:
        """Returns a run; None if Drake's Simulator has to run the diagram, or is as fast.

        Args:
            diagram: The diagram.
            context: Its context after the initialization events.
            duration: The duration of the run, in s.
        """
        if not isinstance(diagram, Diagram):
            return None
        wires = Wires.of(diagram)
        logs = [system for system in wires.systems if isinstance(system, SampleLog)]
        if len(logs) != 1 or duration < WORTH * logs[0].period:
            return None
        (log,) = logs
        with suppress(DrakeDaeError, RuntimeError):
            source, index = wires.sources[log, 0]
            logged = {"logged": source.get_output_port(index)}
            compiled = compile_diagram(diagram, logged, context=context)
            others = {*wires.systems} - {log, *compiled.blocks}
            if compiled.has_stepped and all(_is_still(each, context) for each in others):
                run = cls(compiled, log, context)
                return run if _is_by_wires(wires, compiled, context) else None
        return None

    def run(self, end: float, seen: Callable[[Context, int], bool]) -> bool:
        """Runs until a time, including the updates of that time.

        Args:
            end: The time, in s.
            seen: A function of the context and the number of steps since its last call; it returns
                whether to go on.

        Returns:
            Whether the run is at its end. Otherwise a block or Drake failed within the next
            samples; Drake's Simulator, which goes on from the context, says what failed.
        """
        goes_on = True
        while True:
            is_over = not goes_on or self._time >= end
            steps = self.steps
            try:
                if not self._advance(self._time if is_over else end):
                    return False
            except (DrakeDaeError, RuntimeError):
                return False
            if is_over:
                return True
            goes_on = seen(self._context, self.steps - steps)

    def _advance(self, end: float) -> bool:
        """Computes samples and sets the context; returns False, with nothing set, if one fails.

        At the end, it makes the updates of this time.
        """
        diagram, log_bit = self._diagram, 1 << len(self._compiled.rates)
        sample = self._sample(self._time, self._due)
        times, rows, steps = list[float](), list[FloatArray](), 0
        if not diagram.begin(sample):
            return False
        for count in range(1, EVERY + 1):
            time = min(end, *map(_sample_time, self._rates, self._numbers))
            due = self._due_at(time)
            is_last = count == EVERY or time >= end
            following = self._sample(time, 0 if is_last else due % log_bit)
            if not diagram.step(sample, following):
                return False
            steps += time > sample.time
            if due & log_bit:
                times.append(time)
                rows.append(diagram.before.copy())
            sample = following
            if is_last:
                break
        if not self._write(times, rows):
            return False
        self._time, self._due = time, due % log_bit
        self.steps += steps
        self._set_context()
        return True

    def _due_at(self, time: float) -> int:
        """The rates with a sample at a time, as bits; their next samples are later ones."""
        due = 0
        for index, rate in enumerate(self._rates):
            if _sample_time(rate, self._numbers[index]) == time:
                self._numbers[index] += 1
                due |= 1 << index
        return due

    def _sample(self, time: float, due: int) -> Sample:
        """The sample at a time, with new random numbers of the sources that are due."""
        for source in self._sources:
            if due & source.bit:
                self._noise = self._noise.copy()
                self._noise[source.part] = source.drawn(time)
        return Sample(time, due, self._noise)

    def _write(self, times: list[float], held: list[FloatArray]) -> bool:
        """Adds samples to the log; returns whether all values are valid."""
        rows, none = list[FloatArray](), np.zeros(0)
        for time, values in zip(times, held, strict=True):
            row, valid = self._row(time, none, values, self._parameters)
            if not isfinite(valid[0]):
                return False
            rows.append(row.copy())
        for time, row in zip(times, rows, strict=True):
            self._add(time, row)
        return True

    def _set_context(self) -> None:
        """Sets time and states of the context."""
        context, system = self._context, self._system
        context.SetTime(self._time)
        for source in self._sources:
            source.set_context(context)
        _copy_state(self._own, system.GetMyMutableContextFromRoot(context))
        for block, part in self._compiled.held:
            values = self._diagram.before[part]
            if block is not self._block.system:
                _set_discrete(block.GetMyMutableContextFromRoot(context), values)
            elif isinstance(block, Diagram):
                # What Drake does not step comes after what it steps.
                for other in block.GetSystems():
                    if other is not system and values.size > self._first_rest:
                        local = other.GetMyMutableContextFromRoot(context)
                        _set_discrete(local, values[self._first_rest :])


class _Noise:
    """A source of random numbers, in a Simulator of its own.

    Attributes:
        bit: Its rate, as a bit.
        part: The slice of its numbers.
    """

    def __init__(
        self, source: System, part: slice, compiled: CompiledDiagram, context: Context
    ) -> None:
        (update,) = compiled.blocks[source].updates
        self.bit, self.part = 1 << compiled.rate_index(update), part
        self._source, self._period = source, update.period
        own = source.CreateDefaultContext()
        own.SetTime(context.get_time())
        own.SetStateAndParametersFrom(source.GetMyContextFromRoot(context))
        self._context, self._simulator = own, Simulator(source, own)
        self._simulator.Initialize(NO_EVENTS)

    def drawn(self, time: float) -> FloatArray:
        """Returns the numbers after its sample at a time."""
        self._simulator.AdvanceTo(time + 0.5 * self._period)
        values: FloatArray = self._source.get_output_port().Eval(self._context)
        return values

    def set_context(self, context: Context) -> None:
        """Sets its state in a context of the diagram."""
        _copy_state(self._context, self._source.GetMyMutableContextFromRoot(context))


def _sample_time(rate: tuple[float, float], number: int) -> float:
    period, offset = rate
    return offset + number * period


def _first_sample(period: float, offset: float, start: float) -> int:
    """The number of the first sample that is not before the start."""
    number = max(int((start - offset) / period) - 1, 0)
    while _sample_time((period, offset), number) < start:
        number += 1
    return number


def _copy_state(source: Context, target: Context) -> None:
    """Copies discrete and abstract states; Drake's copy of a context has all geometry as well."""
    states = source.get_state().get_abstract_state()
    copies = target.get_mutable_state().get_mutable_abstract_state()
    for index in range(states.size()):
        copies.get_mutable_value(index).SetFrom(states.get_value(index))
    for index, values in enumerate(discrete_states(source)):
        target.SetDiscreteState(index, values)


def _set_discrete(context: Context, values: FloatArray) -> None:
    """Sets all groups of the discrete state of a context."""
    stops = np.cumsum([group.size for group in discrete_states(context)])
    for index, group in enumerate(np.split(values, stops[:-1])):
        context.SetDiscreteState(index, group)


def _is_still(system: System, context: Context) -> bool:
    """Whether a traced block has no state, so that a run without it is the same."""
    local = system.GetMyContextFromRoot(context)
    states = local.num_continuous_states(), local.num_discrete_state_groups()
    return isinstance(system, Traced) and not any((*states, local.num_abstract_states()))


def _is_by_wires(wires: Wires, compiled: CompiledDiagram, context: Context) -> bool:
    """Whether each connected input port has the value of its source, not a fixed one.

    Drake does not say which ports have fixed values. So the ports are compared at another state.
    """
    moved = context.Clone()
    moved.SetTime(context.get_time() + NEAR)
    for index, values in enumerate(discrete_states(moved)):
        moved.SetDiscreteState(index, values + NEAR)
    for (system, number), (source, k) in wires.sources.items():
        port, written = system.get_input_port(number), source.get_output_port(k)
        if system in compiled.blocks and port.get_data_type() == PortDataType.kVectorValued:
            given = port.Eval(system.GetMyContextFromRoot(moved))
            value = written.Eval(source.GetMyContextFromRoot(moved))
            if not np.array_equal(given, value, equal_nan=True):
                return False
    return True
