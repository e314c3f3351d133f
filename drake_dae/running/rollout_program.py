"""A diagram as a rollout steps it: its block, and the places of its numbers."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise, starmap
from threading import RLock
from typing import Any, cast

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.common import RandomGenerator
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, EventStatus, PortDataType
from pydrake.systems.primitives import LogVectorOutput, RandomSource

from drake_dae.arguments import uncollected
from drake_dae.arrays import FloatArray, brief, by_columns, numbers
from drake_dae.blocks.block import Block, Held, stacked
from drake_dae.blocks.compose import Leaves, compose, laws_of
from drake_dae.blocks.machine import Stepper, can_run_several, load
from drake_dae.blocks.stepping import RunProblem, StepFunctions
from drake_dae.blocks.traced_system import TracedSystem, context_in
from drake_dae.dae import Signal
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.record import Record, Recorded, computed_record
from drake_dae.errors import ModelError
from drake_dae.running.merged_run import parameters_in, put_states, states_in
from drake_dae.systems.ideal_plants import DaePlant
from drake_dae.systems.plant import ParameterizedSystem, plants_in
from drake_dae.trace.compiled import Compiled, attempts

# The seed of the noise of a run: one number, or name of a RandomSource -> number.
Seed = int | Mapping[str, int]
SAME = 1e-9  # Times that differ by less than this, in periods, are equal.
# What is made once is made by one thread; expressions of CasADi cannot be shared by several.
MAKING = RLock()


class RolloutProgram:
    """A closed loop, or any diagram, as one block, whose inputs became parameters and held values.

    `drake` is the `ContactPlant` that Drake steps, `signals` are the columns of a row, and `choice`
    is whether it becomes machine code by default. With `like`, each plant shares the parameters of
    its law, and `columns` are its parameters among those of `like`.
    """

    @uncollected
    def __init__(self, loop: ClosedLoop | Diagram, like: "RolloutProgram | None" = None) -> None:
        self.loop, self.made = loop, dict[str, Any]()
        signals, self.choice = dict[str, Sequence[Signal]](), cast(Compiled, "auto")
        if isinstance(loop, ClosedLoop):
            self.diagram, self.name = loop.diagram, loop.plant.get_name()
            signals, self.choice = {**loop.signals}, loop.plant.dae.compiled
        else:
            self.diagram, self.name = loop, loop.get_name() or "the diagram"
        diagram, self.context = self.diagram, self.diagram.CreateDefaultContext()
        self.laws = laws_of(Leaves.of(diagram).systems)
        for plant, law in self.laws.items() if like is not None else ():
            own = plant.GetMyMutableContextFromRoot(self.context).get_mutable_numeric_parameter(0)
            values = law.GetMyContextFromRoot(self.context).get_numeric_parameter(0).value()
            own.SetFromVector(values[: own.size()])
        ports = [diagram.get_output_port(i) for i in range(diagram.num_output_ports())]
        ports = [p for p in ports if p.get_data_type() == PortDataType.kVectorValued]
        self.ports = {p.get_name(): p for p in ports if not signals or p.get_name() in signals}
        stepped = [plant for plant in plants_in(diagram) if plant.time_step]
        self.is_discrete = bool(stepped)
        self.drake = next((p for p in stepped if not isinstance(p, TracedSystem)), None)
        self.composed = composed = compose(
            diagram, self.ports, context=self.context, shares=like is not None
        )
        self.block = block = self._without_inputs()
        outputs = {each: block.outputs[each] for each in signals or self.ports}
        self.functions = StepFunctions(replace(block, outputs=outputs))
        self.num_states = block.state.numel()
        self.signals = signals or {
            each: composed.block.signals.get(each)
            or [Signal(f"{each}[{i}]") for i in range(value.numel())]
            for each, value in outputs.items()
        }
        if not self.signals:
            raise ModelError(
                "the diagram has no output port with a vector, so that a rollout has nothing to "
                "record: export one, builder.ExportOutput(system.GetOutputPort(...), name)"
            )
        cuts = {name: source for name, (source, _) in composed.cuts.items()}
        self.sources = {n: source for n, source in cuts.items() if isinstance(source, RandomSource)}
        ends = np.cumsum([0, *(held.symbol.numel() for held in block.held.values())]).tolist()
        self.held_places = dict(zip(block.held, starmap(slice, pairwise(ends)), strict=True))
        every = np.arange(ends[-1])
        drawn = [every[self.held_places[name]] for name in self.sources]
        self.drawn_places = np.concatenate([every[:0], *drawn])
        self.kept_places = np.setdiff1d(every, self.drawn_places)
        if like is not None:
            places, total = like.composed.parameters, np.arange(like.functions.sizes[3])
            own = [total[places[system]] for system in composed.parameters]
            fixed = max((part.stop for part in places.values()), default=0)
            self.columns = np.concatenate([*own, total[fixed:]])

    def kept(self, name: str, make: Callable[[], Any]) -> Any:
        with MAKING:
            if name not in self.made:
                self.made[name] = make()
            return self.made[name]

    def for_numbers(self, problems: RunProblem) -> "tuple[RolloutProgram, RunProblem]":
        """The program in which plants and their laws share numbers, if they do so in all runs."""
        parts, parameters = self.composed.parameters, problems.parameters
        for plant, law in self.laws.items():
            own = parameters[:, parts.get(plant, slice(0, 0))]
            differs = (own != parameters[:, parts[law]][:, : own.shape[1]]).any(axis=0)
            if isinstance(plant, ParameterizedSystem) and plant.exogenous_places and differs.size:
                context = plant.GetMyContextFromRoot(self.context)
                if plant.GetInputPort("exogenous").HasValue(context):
                    differs[plant.exogenous_places] = False
            if differs.any():
                return self, problems
        if not self.laws:
            return self, problems
        shared = self.kept("shared", lambda: RolloutProgram(self.loop, like=self))
        columns = np.ascontiguousarray(parameters[:, shared.columns])
        return shared, replace(problems, parameters=columns)

    def machine_code(
        self, choice: Compiled, calls: float, is_all: bool, several: bool = False
    ) -> Stepper | None:
        """Its code for one run or several; None if compiling takes longer than it saves."""
        tries = attempts("auto", self.functions.num_operations)
        make = choice is True or any(makes and calls >= least for least, makes in tries)
        if choice is False or self.drake is not None or not (make or is_all):
            return None
        if several and not self.kept("lanes do", lambda: can_run_several(self.functions)):
            return None
        name = "lanes" if several else "code"
        self.made[name] = self.made.get(name) or load(self.functions, choice, make, several)
        code: Stepper | None = self.made[name]
        return code

    @property
    def drake_state(self) -> slice:
        """The place of the state of Drake's plant among the held values."""
        assert self.drake is not None
        size, every = self.drake.dae.num_states, self.held_places
        parts = [every[name] for name in self.composed.cuts if name not in self.sources]
        return next(part for part in parts if part.stop - part.start == size)

    def values_in(self, context: Context) -> tuple[FloatArray, FloatArray, FloatArray]:
        """State, held values and parameters in a context of the diagram."""
        composed, (x, groups) = self.composed, states_in(self.composed, context)
        state, none = np.zeros(self.functions.size), np.zeros(0)
        state[: x.size] = x
        for name, (system, i) in composed.cuts.items():
            groups[name] = system.get_output_port(i).Eval(context_in(system, context))
        held = np.concatenate([none, *(groups[name] for name in self.block.held)])
        values = [parameters_in(composed, context)]
        for system, i in composed.fixed.values():
            port, local = system.get_input_port(i), context_in(system, context)
            if not port.HasValue(local):
                raise ModelError(
                    f"the input port '{port.get_name()}' of '{system.get_name()}' has no value in "
                    "this context"
                )
            values.append(port.Eval(local))
        return state, held, np.concatenate(values)

    def put(
        self,
        context: Context,
        time: float,
        state: FloatArray,
        held: FloatArray,
        parameters: FloatArray,
    ) -> None:
        """Sets time, states and parameters in a context of the diagram."""
        composed, first = self.composed, 0
        context.SetTime(time)
        put_states(composed, context, state, {n: held[p] for n, p in self.held_places.items()})
        for system in composed.parameters:
            local = system.GetMyMutableContextFromRoot(context)
            for i in range(local.num_numeric_parameter_groups()):
                group = local.get_mutable_numeric_parameter(i)
                group.SetFromVector(parameters[first : first + group.size()])
                first += group.size()
        for system, i in composed.fixed.values():
            port, local = system.get_input_port(i), system.GetMyMutableContextFromRoot(context)
            port.FixValue(local, parameters[first : first + port.size()])
            first += port.size()
        if self.drake is not None:
            local = self.drake.GetMyMutableContextFromRoot(context)
            self.drake.set_state(local, held[self.drake_state])

    def problems(
        self,
        starts: ArrayLike,
        parameters: ArrayLike | None,
        times: FloatArray,
        seeds: Sequence[Seed] | None,
    ) -> RunProblem:
        """The runs of `rollout`, from its arguments."""
        functions = self.functions
        rates = [(rate.period, rate.offset) for rate in functions.rates]
        # A discrete plant logs its steps before the updates of their times.
        events, due = events_within(rates, times, with_end=not self.is_discrete)
        if parameters is None:
            parameters = self.values_in(self.context)[2]
        seeds = None if seeds is None else list(seeds)
        states = _table("starts", starts, self.num_states + self.kept_places.size)
        rows = _table("parameters", parameters, functions.sizes[3])
        count = max(len(states), len(rows), len(seeds or ()))
        if len(states) == 1:
            states = np.repeat(states, count, axis=0)
        count = len(states)
        for what, given in (("rows of parameters", rows), ("seeds", seeds)):
            allowed = (count,) if what == "seeds" else (1, count)
            if given is not None and len(given) not in allowed:
                raise ModelError(f"{len(given)} {what} for {count} starts")
        # Without noise, or without seeds, it is the same in all runs.
        different = [self.seeds(seed) for seed in seeds or ()]
        different = different if different and self.sources else [{}]
        noise = np.array([self._noise(times[0], events, due, seed) for seed in different])
        held = np.zeros((count, functions.sizes[2]))
        held[:, self.kept_places] = states[:, self.num_states :]
        held[:, self.drawn_places] = noise[:, 0]
        state = np.zeros((count, functions.size))
        state[:, : self.num_states] = states[:, : self.num_states]
        rows, noise = np.ascontiguousarray(rows), np.ascontiguousarray(noise[:, 1:])
        problems = RunProblem(times, state, held, rows, events, due, noise)
        self._check_starts(problems)
        return problems

    def seeds(self, seed: Seed | None) -> dict[str, int]:
        """Name of a source -> its seed in a run, of those that have one."""
        for value in seed.values() if isinstance(seed, Mapping) else [seed or 0]:
            if not 0 <= value < 2**32:
                raise ModelError(f"a seed is a number from 0 to 2^32 - 1, got {brief(value)}")
        named = {each: source.get_name() for each, source in self.sources.items()}
        if isinstance(seed, Mapping):
            found = {each: seed[name] for each, name in named.items() if name in seed}
        else:
            found = {} if seed is None else dict.fromkeys(named, seed)
        shift = 0 if isinstance(seed, Mapping) else 2**31  # Sources have numbers of their own.
        places = {each: shift * k for k, each in enumerate(named)}
        return {each: (int(value) + places[each]) % 2**32 for each, value in found.items()}

    def _noise(
        self, start: float, events: FloatArray, due: np.ndarray, seeds: Mapping[str, int]
    ) -> FloatArray:
        """The numbers of all sources at the start and at each event, shape (k + 1, q)."""
        columns = [np.zeros((events.size + 1, 0))]
        for name, source in self.sources.items():
            place = self.held_places[name]
            (i,) = (i for i, r in enumerate(self.functions.rates) if place.start in r.places)
            rows, period = np.flatnonzero(due >> i & 1), self.functions.rates[i].period
            drawn = np.zeros((events.size + 1, place.stop - place.start))
            numbers = drawn_noise(source, start, events[rows], period, seeds.get(name))
            drawn[[0, *(rows + 1)]] = numbers
            columns.append(drawn)
        return np.concatenate(columns, axis=1)

    def _check_starts(self, problems: RunProblem) -> None:
        """Refuses starts that are off N*."""
        context, time, parts = self.context.Clone(), float(problems.times[0]), self.composed
        for plant in (s for s in parts.states if isinstance(s, DaePlant)):
            own = parts.parameters.get(plant, slice(0, 0))
            for one in map(problems.run, range(len(problems.state))):
                values = one.parameters[own]
                if plant.exogenous_places:
                    self.put(context, time, one.state, one.held, one.parameters)
                    values = plant.current_parameters(plant.GetMyContextFromRoot(context))
                plant.check_start(one.state[parts.states[plant]], values)

    def _without_inputs(self) -> Block:
        """The block with "noise" as its input alone; others are parameters, or held if Drake's."""
        composed, block, drake = self.composed, self.composed.block, self.drake
        inside = Leaves.of(drake).systems if isinstance(drake, Diagram) else [drake]
        noise, random, stepped = list[ca.SX](), dict[str, Held](), dict[str, Held]()
        for name, (system, index) in composed.cuts.items():
            symbol, start = block.inputs[name], np.zeros(block.inputs[name].numel())
            if isinstance(system, RandomSource):
                noise.append(ca.SX.sym(name, symbol.numel()))
                random[name] = Held(symbol, noise[-1], start, source_period(system))
            elif drake is not None and system in inside:
                stepped[name] = Held(symbol, symbol, start, drake.time_step)
            else:
                port = system.get_output_port(index).get_name()
                raise ModelError(
                    f"the output port '{port}' of '{system.get_name()}' cannot be traced. What "
                    "depends on it only runs in Drake's Simulator"
                )
        fixed = [block.inputs[name] for name in composed.fixed]
        return replace(
            block,
            inputs={"noise": stacked(noise)},
            held={**stepped, **block.held, **random},
            parameters=stacked([block.parameters, *fixed]),
        )

    def record(self, times: FloatArray, rows: FloatArray, after: float | None = None) -> Record:
        """The record of a run, or of its rows after a time in s."""
        times = times[: len(rows)]
        first = 0 if after is None else int(np.searchsorted(times, after, side="right"))
        columns, stop, signals = by_columns(rows[first:]), 0, {}
        for name, entries in self.signals.items():
            start, stop = stop, stop + len(entries)
            signals[name] = Recorded(columns[start:stop].T, tuple(entries))
        record = computed_record(times[first:], signals)
        return self.loop.with_errors(record) if isinstance(self.loop, ClosedLoop) else record


_of_diagram = lru_cache(maxsize=4)(RolloutProgram)


def program_of(loop: ClosedLoop | Diagram) -> RolloutProgram:
    """The program of a closed loop or of any diagram, which is made once."""
    with MAKING:
        if isinstance(loop, Diagram):
            return _of_diagram(loop)
        if "program" not in loop.memory:
            loop.memory["program"] = RolloutProgram(loop)
        program: RolloutProgram = loop.memory["program"]
        return program


def _table(what: str, given: ArrayLike, size: int) -> FloatArray:
    table = np.atleast_2d(numbers(what, given))
    if table.ndim != 2 or table.shape[1] != size:
        raise ModelError(
            f"{what} must have shape ({size},), or (k, {size}) for k runs, got "
            f"{np.shape(given)}: see start_values"
        )
    if not np.isfinite(table).all():
        raise ModelError(f"{what} must be finite")
    return table


def events_within(
    rates: Sequence[tuple[float, float]], times: FloatArray, with_end: bool = True
) -> tuple[FloatArray, np.ndarray]:
    """The times of updates in s, and which rates are due at each, as bits; shapes (k,).

    As in Drake, those that differ by round-off follow each other; one close to a row moves to it.
    """
    due: dict[float, int] = {}
    for number, (period, offset) in enumerate(rates):
        first = int(np.ceil((times[0] - offset) / period - SAME))
        last = int(np.floor((times[-1] - offset) / period + SAME))
        for k in range(max(first, 0), last + 1):
            moment = offset + k * period
            due[moment] = due.get(moment, 0) | 1 << number
    moments = np.array(sorted(due), dtype=float)
    bits = np.array([due[moment] for moment in moments.tolist()], dtype=np.int64)
    if moments.size:
        shortest = min(period for period, _ in rates)
        near = np.clip(np.searchsorted(times, moments), 1, times.size - 1)
        for candidate in (times[near - 1], times[near]):
            is_near = np.abs(candidate - moments) <= SAME * shortest
            moments[is_near] = candidate[is_near]
    if not with_end:
        is_before = moments < times[-1]
        moments, bits = moments[is_before], bits[is_before]
    return moments, bits


def source_period(source: RandomSource) -> float:
    """The time between two draws in s, which is the time of the first event after t = 0."""
    simulator = Simulator(source)
    simulator.Initialize()
    simulator.set_monitor(lambda context: EventStatus.ReachedTermination(source, "an event"))
    simulator.AdvanceTo(1e9)
    return float(simulator.get_context().get_time())


def drawn_noise(
    source: RandomSource, start: float, times: FloatArray, period: float, seed: int | None
) -> FloatArray:
    """The output of Drake's source at the start and after each of its updates; shape (k + 1, q)."""
    builder = DiagramBuilder()
    copy = builder.AddSystem(source.Clone())
    logger = LogVectorOutput(copy.get_output_port(), builder)
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    own = copy.GetMyMutableContextFromRoot(context)
    if seed is None:  # The default of a source differs from that of its copy.
        own.SetStateAndParametersFrom(source.CreateDefaultContext())
    else:
        copy.SetRandomContext(own, RandomGenerator(seed))
    context.SetTime(start)
    simulator = Simulator(diagram, context)
    simulator.Initialize()
    simulator.AdvanceTo((times[-1] if times.size else start) + 0.5 * period)
    log = logger.FindLog(context)
    # A step ends before the updates of its time.
    after = np.searchsorted(log.sample_times(), times + 1e-3 * period)
    return np.vstack([log.data()[:, :1].T, log.data()[:, after].T])
