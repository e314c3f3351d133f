"""A diagram as a rollout steps it: its block, and the places of its numbers."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache
from itertools import pairwise, starmap
from numbers import Integral
from threading import RLock

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context, Diagram, PortDataType
from pydrake.systems.primitives import RandomSource

from drake_dae.arrays import FloatArray, brief, by_columns, numbers
from drake_dae.blocks.block import Block, Held, stacked
from drake_dae.blocks.compose import compose
from drake_dae.blocks.machine import Stepper, can_run_several, load
from drake_dae.blocks.stepping import RunProblem, StepFunctions
from drake_dae.blocks.traced_system import context_in
from drake_dae.dae import Signal
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.record import Record, computed_record, recorded_values
from drake_dae.errors import ModelError
from drake_dae.running.events import Seed, drawn_noise, events_within, source_period
from drake_dae.systems.plants.contract import plants_in
from drake_dae.systems.plants.dae_plant import DaePlant
from drake_dae.trace.compiled import Compiled, attempts

MAKING = RLock()
"""What is made once is made by one thread; expressions of CasADi cannot be shared by several."""


class RolloutProgram:
    """A closed loop, or any diagram, as one block whose inputs became parameters and held values.

    `signals` are the columns of a row: name of an output port -> names and units of its entries.
    """

    def __init__(self, loop: ClosedLoop | Diagram) -> None:
        signals = dict[str, Sequence[Signal]]()
        self.loop = loop
        self.choice: Compiled = "auto"
        if isinstance(loop, ClosedLoop):
            self.diagram, self.name = loop.diagram, loop.plant.get_name()
            signals, self.choice = {**loop.signals}, loop.plant.dae.compiled
        else:
            self.diagram, self.name = loop, loop.get_name() or "the diagram"
        self.context = self.diagram.CreateDefaultContext()
        ports = map(self.diagram.get_output_port, range(self.diagram.num_output_ports()))
        vectors = {
            p.get_name(): p for p in ports if p.get_data_type() == PortDataType.kVectorValued
        }
        self.ports = {name: p for name, p in vectors.items() if not signals or name in signals}
        if not self.ports:
            raise ModelError(
                "the diagram has no output port with a vector, so that a rollout has nothing to "
                "record: export one, builder.ExportOutput(system.GetOutputPort(...), name)"
            )
        self.composed = compose(self.diagram, self.ports, context=self.context, shares=False)
        self.block = block = self._without_inputs()
        outputs = {name: block.outputs[name] for name in signals or self.ports}
        self.functions = StepFunctions(replace(block, outputs=outputs))
        self.num_states = block.state.numel()
        self.signals = signals or {
            name: self.composed.block.signals.get(name)
            or [Signal(f"{name}[{i}]") for i in range(value.numel())]
            for name, value in outputs.items()
        }
        self.sources = {
            name: source
            for name, (source, _) in self.composed.cuts.items()
            if isinstance(source, RandomSource)
        }
        ends = np.cumsum([0, *(held.symbol.numel() for held in block.held.values())]).tolist()
        self.held_places = dict(zip(block.held, starmap(slice, pairwise(ends)), strict=True))
        every = np.arange(ends[-1])
        drawn = [every[self.held_places[name]] for name in self.sources]
        self.drawn_places = np.concatenate([every[:0], *drawn])
        self.kept_places = np.setdiff1d(every, self.drawn_places)
        self._made = dict[bool, Stepper | None]()

    def machine_code(
        self, choice: Compiled, calls: float, is_all: bool, several: bool = False
    ) -> Stepper | None:
        """Its code for one run or several; None if compiling takes longer than it saves.

        Code that is already in the cache is used in any case, unless further runs will follow.
        """
        tries = attempts("auto", self.functions.num_operations)
        make = choice is True or any(makes and calls >= least for least, makes in tries)
        if choice is False or not (make or is_all) or (several and not self._runs_several):
            return None
        self._made[several] = self._made.get(several) or load(self.functions, choice, make, several)
        return self._made[several]

    @property
    def stepper(self) -> Stepper | None:
        """Its machine code; None if there is none yet."""
        return self._made.get(False)

    @cached_property
    def _runs_several(self) -> bool:
        return can_run_several(self.functions)

    def values_in(self, context: Context) -> tuple[FloatArray, FloatArray, FloatArray]:
        """State, held values and parameters in a context of the diagram."""
        composed, functions = self.composed, self.functions
        state, held = np.zeros(functions.size), np.zeros(functions.sizes[2])
        for system, part in composed.states.items():
            local = context_in(system, context)
            state[part] = local.get_continuous_state_vector().CopyToVector()
        for (system, i), (group, _) in composed.held.items():
            local = context_in(system, context)
            held[self.held_places[group]] = local.get_discrete_state(i).value()
        for name, (system, i) in composed.cuts.items():
            held[self.held_places[name]] = system.get_output_port(i).Eval(
                context_in(system, context)
            )
        values = []
        for system in composed.parameters:
            local = context_in(system, context)
            groups = range(local.num_numeric_parameter_groups())
            values += [local.get_numeric_parameter(i).value() for i in groups]
        for system, i in composed.fixed.values():
            port, local = system.get_input_port(i), context_in(system, context)
            if not port.HasValue(local):
                raise ModelError(
                    f"the input port '{port.get_name()}' of '{system.get_name()}' has no value in "
                    "this context"
                )
            values.append(port.Eval(local))
        return state, held, np.concatenate([np.zeros(0), *values])

    def put(
        self,
        context: Context,
        time: float,
        state: FloatArray,
        held: FloatArray,
        parameters: FloatArray,
    ) -> None:
        """Sets time, states and parameters in a context of the diagram."""
        composed = self.composed
        context.SetTime(time)
        for system, part in composed.states.items():
            system.GetMyMutableContextFromRoot(context).SetContinuousState(state[part])
        for (system, i), (group, _) in composed.held.items():
            local = system.GetMyMutableContextFromRoot(context)
            local.SetDiscreteState(i, held[self.held_places[group]])
        for system, part in composed.parameters.items():
            local, first = system.GetMyMutableContextFromRoot(context), part.start
            for i in range(local.num_numeric_parameter_groups()):
                group = local.get_mutable_numeric_parameter(i)
                group.SetFromVector(parameters[first : first + group.size()])
                first += group.size()
        first = sum(part.stop - part.start for part in composed.parameters.values())
        for system, i in composed.fixed.values():
            port, local = system.get_input_port(i), system.GetMyMutableContextFromRoot(context)
            port.FixValue(local, parameters[first : first + port.size()])
            first += port.size()

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
        is_discrete = any(plant.time_step for plant in plants_in(self.diagram))
        events, due = events_within(rates, times, with_end=not is_discrete)
        if parameters is None:
            parameters = self.values_in(self.context)[2]
        if seeds is not None:
            seeds = [int(seed) if isinstance(seed, Integral) else seed for seed in seeds]
        states = _table("starts", starts, self.num_states + self.kept_places.size)
        rows = _table("parameters", parameters, functions.sizes[3])
        count = max(len(states), len(rows), len(seeds or ()))
        if len(states) == 1:
            states = np.repeat(states, count, axis=0)
        count = len(states)
        if len(rows) not in (1, count):
            raise ModelError(f"{len(rows)} rows of parameters for {count} starts")
        if seeds is not None and len(seeds) != count:
            raise ModelError(f"{len(seeds)} seeds for {count} starts")
        for seed in seeds or ():
            for value in [seed] if isinstance(seed, int) else seed.values():
                if not 0 <= value < 2**32:
                    raise ModelError(f"a seed is a number from 0 to 2^32 - 1, got {brief(value)}")
        # Without noise, or without seeds, it is the same in all runs.
        different: Sequence[Seed | None] = seeds if seeds and self.sources else [None]
        noise = np.array([self._noise(times[0], events, due, seed) for seed in different])
        held = np.zeros((count, functions.sizes[2]))
        held[:, self.kept_places] = states[:, self.num_states :]
        if self.sources:
            held[:, self.drawn_places] = noise[:, 0]
        state = np.zeros((count, functions.size))
        state[:, : self.num_states] = states[:, : self.num_states]
        rows, noise = np.ascontiguousarray(rows), np.ascontiguousarray(noise[:, 1:])
        problems = RunProblem(times, state, held, rows, events, due, noise)
        self._check_starts(problems)
        return problems

    def _noise(
        self, start: float, events: FloatArray, due: np.ndarray, seed: Seed | None
    ) -> FloatArray:
        """The numbers of all sources at the start and at each event, shape (k + 1, q)."""
        columns = [np.zeros((events.size + 1, 0))]
        for number, (name, source) in enumerate(self.sources.items()):
            place = self.held_places[name]
            (i,) = (i for i, r in enumerate(self.functions.rates) if place.start in r.places)
            rows, period = np.flatnonzero(due >> i & 1), self.functions.rates[i].period
            chosen = (seed + number * 2**31) % 2**32 if isinstance(seed, int) else None
            if isinstance(seed, Mapping):
                chosen = seed.get(source.get_name())
            drawn = np.zeros((events.size + 1, place.stop - place.start))
            drawn[[0, *(rows + 1)]] = drawn_noise(source, start, events[rows], period, chosen)
            columns.append(drawn)
        return np.concatenate(columns, axis=1)

    def _check_starts(self, problems: RunProblem) -> None:
        """Refuses starts that are off N*."""
        context, time, parts = self.context.Clone(), float(problems.times[0]), self.composed
        for plant in (s for s in parts.states if isinstance(s, DaePlant)):
            local, part = plant.GetMyContextFromRoot(context), parts.states[plant]
            own = parts.parameters.get(plant, slice(0, 0))
            for i in range(len(problems.state)):
                one = problems.run(i)
                values = one.parameters[own]
                if plant.exogenous_places:
                    self.put(context, time, one.state, one.held, one.parameters)
                    values = plant.current_parameters(local)
                plant.check_start(one.state[part], values)

    def _without_inputs(self) -> Block:
        """The block with values of unwired inputs as parameters, and random numbers as held ones.

        Its only input is "noise", from which sources of random numbers take their next values.
        """
        block, noise, random = self.composed.block, list[ca.SX](), dict[str, Held]()
        for name, (system, index) in self.composed.cuts.items():
            symbol = block.inputs[name]
            if not isinstance(system, RandomSource):
                port = system.get_output_port(index).get_name()
                raise ModelError(
                    f"the output port '{port}' of '{system.get_name()}' cannot be traced, such as "
                    "that of Drake's own contact, for which a CompliantPlant may stand. What "
                    "depends on it only runs in Drake's Simulator, by simulate"
                )
            noise.append(ca.SX.sym(name, symbol.numel()))
            start = np.zeros(symbol.numel())
            random[name] = Held(symbol, noise[-1], start, source_period(system))
        return replace(
            block,
            inputs={"noise": stacked(noise)},
            held={**block.held, **random},
            parameters=stacked(
                [block.parameters, *(block.inputs[name] for name in self.composed.fixed)]
            ),
        )

    def record(self, times: FloatArray, rows: FloatArray, after: float | None = None) -> Record:
        """The record of a run, or of its rows after a time in s."""
        times = times[: len(rows)]
        first = 0 if after is None else int(np.searchsorted(times, after, side="right"))
        columns, stop, signals = by_columns(rows[first:]), 0, {}
        for name, entries in self.signals.items():
            start, stop = stop, stop + len(entries)
            signals[name] = recorded_values(columns[start:stop].T, tuple(entries))
        record = computed_record(times[first:], signals)
        return self.loop.with_errors(record) if isinstance(self.loop, ClosedLoop) else record


def program_of(loop: ClosedLoop | Diagram) -> RolloutProgram:
    """The program of a closed loop or of any diagram, which is made once."""
    with MAKING:
        if isinstance(loop, Diagram):
            return _of_diagram(loop)
        if "program" not in loop.memory:
            loop.memory["program"] = RolloutProgram(loop)
        program: RolloutProgram = loop.memory["program"]
    return program


@lru_cache(maxsize=4)
def _of_diagram(diagram: Diagram) -> RolloutProgram:
    return RolloutProgram(diagram)


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
