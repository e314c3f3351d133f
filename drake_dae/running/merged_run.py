"""The run of a diagram in which all traced blocks are one, by Drake's Simulator."""

from collections.abc import Callable, Container, Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Self

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.systems.analysis import (
    ApplySimulatorConfig,
    InitializeParams,
    Simulator,
    SimulatorConfig,
)
from pydrake.systems.framework import (
    Context,
    Diagram,
    DiagramBuilder,
    EventStatus,
    OutputPort,
    PortDataType,
    System,
)
from pydrake.systems.primitives import VectorLogSink

from drake_dae.arrays import FloatArray
from drake_dae.blocks.block import stacked
from drake_dae.blocks.compose import Composed, Leaves, Port, compose, leaf_port
from drake_dae.blocks.symbolic import symbolic_block
from drake_dae.blocks.traced_system import TracedSystem, context_in
from drake_dae.errors import DrakeDaeError
from drake_dae.systems.plant import plants_in
from drake_dae.trace.compiled import Compiled

EVERY = 32  # The number of steps after which the context of the diagram as wired gets the results.
# The least number of steps for which composing the diagram takes less time than it saves.
WORTH = 500
USUAL = 0.02  # The usual step with error control in s, of a robot that moves through some radians.
ROW = "$row"  # The output with the values of `MergedRun.row`.
NEAR = 1e-6  # The distance of another state at which ports are compared, in any unit.
# The initialization of a Simulator that goes on from a context.
NO_EVENTS = InitializeParams(suppress_initialization_events=True)


class MergedRun:
    """A diagram in which one block has the place of all that can be traced, beside the rest.

    The rest, such as Drake's MultibodyPlant and sources of random numbers, are copies; of these
    only what leads to some `ports` if these are given, whose values are then a `row`. States, logs
    and time of the diagram as wired follow after every few steps; `steps` counts these.
    """

    def __init__(
        self,
        diagram: Diagram,
        context: Context,
        ports: Mapping[str, OutputPort] | None = None,
        compiled: Compiled | None = None,
    ) -> None:
        leaves = self._leaves = Leaves.of(diagram)
        needed = set(leaves.systems)
        if ports is not None:
            needed = upstream(leaves, map(leaf_port, ports.values()))
        sinks = [s for s in leaves.systems if s in needed and isinstance(s, VectorLogSink)]
        rest = sinks + [s for s in leaves.systems if s in needed and not _is_traced(s)]
        outputs = {
            f"{system.get_name()}.{system.get_input_port(i).get_name()}": (system, i)
            for system in rest
            for i in range(system.num_input_ports())
            if (system, i) in leaves.sources and _is_traced(leaves.sources[system, i][0])
        }
        sources = {name: leaves.sources[place] for name, place in outputs.items()}
        wanted = {name: system.get_output_port(i) for name, (system, i) in sources.items()}
        wanted |= {f"${name}": port for name, port in (ports or {}).items()}
        # Runs with ports have other numbers each.
        self.composed = composed = compose(
            diagram, wanted, context=context, merge=True, is_whole=True, shares=ports is None
        )
        values = {name: composed.block.outputs[name] for name in outputs}
        row = [value for name, value in composed.block.outputs.items() if name not in outputs]
        block = replace(composed.block, outputs=values | ({ROW: stacked(row)} if row else {}))
        choice = plants_in(diagram)[0].dae.compiled if compiled is None else compiled
        builder = DiagramBuilder()
        self._block = one = builder.AddSystem(TracedSystem(block, compiled=choice))
        self._copies = copies = dict[System, System]()
        for system in rest:  # Systems of ours say how they are copied.
            again = getattr(system, "again", system.Clone)
            copies[system] = builder.AddNamedSystem(system.get_name(), again())
        for (system, i), (source, k) in leaves.sources.items():
            if system in copies and source in copies:
                written = copies[source].get_output_port(k)
                builder.Connect(written, copies[system].get_input_port(i))
        for name, (system, i) in outputs.items():
            builder.Connect(one.GetOutputPort(name), copies[system].get_input_port(i))
        for name, (source, k) in composed.cuts.items():
            builder.Connect(copies[source].get_output_port(k), one.GetInputPort(name))
        self._diagram = builder.Build()
        self._own = self._diagram.CreateDefaultContext()
        self._simulator = Simulator(self._diagram, self._own)

    def begin(self, context: Context, config: SimulatorConfig) -> None:
        """Takes time, states, parameters and fixed values from a context of the diagram."""
        own, one, composed = self._own, self._block, self.composed
        self._context, self.steps = context, 0
        own.SetTime(context.get_time())
        for system, copy in self._copies.items():
            at_system, local = context_in(system, context), copy.GetMyMutableContextFromRoot(own)
            if isinstance(system, VectorLogSink):
                continue
            local.SetStateAndParametersFrom(at_system)
            for i in range(system.num_input_ports()):
                port = system.get_input_port(i)
                is_vector = port.get_data_type() == PortDataType.kVectorValued
                is_wired = (system, i) in self._leaves.sources
                if not is_wired and is_vector and port.HasValue(at_system):
                    copy.get_input_port(i).FixValue(local, port.Eval(at_system))
        at_block, (x, held) = one.GetMyMutableContextFromRoot(own), states_in(composed, context)
        at_block.SetContinuousState(x)
        for index, values in enumerate(held.values()):
            at_block.SetDiscreteState(index, values)
        values = parameters_in(composed, context)
        if values.size:
            at_block.get_mutable_numeric_parameter(0).SetFromVector(values)
        for name, (system, i) in composed.fixed.items():
            port, local = system.get_input_port(i), context_in(system, context)
            if port.HasValue(local):
                one.GetInputPort(name).FixValue(at_block, port.Eval(local))
        ApplySimulatorConfig(config, self._simulator)
        own.SetAccuracy(config.accuracy)
        self._simulator.Initialize(NO_EVENTS)
        one.begin_run(at_block)
        for system, copy in self._copies.items():
            if isinstance(system, VectorLogSink):  # The log as wired has the start already.
                copy.FindMutableLog(own).Clear()

    @classmethod
    def of(
        cls, diagram: System, context: Context, config: SimulatorConfig, duration: float
    ) -> Self | None:
        """Returns a run; None if the diagram has to run as wired, or is as fast."""
        if not isinstance(diagram, Diagram):
            return None
        leaves, plants = Leaves.of(diagram).systems, plants_in(diagram)
        periods = [getattr(system, "sample_period", 0.0) for system in leaves]
        periods += [plant.time_step for plant in plants]
        usual = USUAL if config.use_error_control else config.max_step_size
        step = min([usual, *(period for period in periods if period > 0.0)])
        if not plants or duration < WORTH * step:
            return None
        with suppress(DrakeDaeError, RuntimeError):
            run = cls(diagram, context)
            run.begin(context, config)
            return run if _is_by_wires(run._leaves, context) else None
        return None

    def run(self, end: float, seen: Callable[[Context, int], bool]) -> bool:
        """Runs until a time, including the updates of that time."""
        goes_on, last, count = True, self._own.get_time(), 0
        refused: DrakeDaeError | None = None

        def monitor(own: Context) -> EventStatus:
            nonlocal goes_on, last, count, refused
            now = own.get_time()
            count += now > last  # A step of no length makes the updates at the start.
            last = now
            if count < EVERY:
                return _GOES_ON
            self.write_back(count)
            try:
                goes_on, count = seen(self._context, count), 0
            except DrakeDaeError as error:
                refused = error
                raise
            return _GOES_ON if goes_on else EventStatus.ReachedTermination(self._diagram, "ended")

        self._simulator.set_monitor(monitor)
        try:
            self._simulator.AdvanceTo(end)
            self._simulator.clear_monitor()
            self._simulator.AdvancePendingEvents()
            self.write_back(count)
        except (DrakeDaeError, RuntimeError):
            if refused is not None:
                raise refused from None
            return False
        if goes_on:
            seen(self._context, count)
        return True

    def row(self, time: float) -> FloatArray:
        """The values of the ports at a time in s, before the updates of that time."""
        if time > self._own.get_time():
            self._simulator.AdvanceTo(time)
        self.steps, port = self._simulator.get_num_steps_taken(), self._block.GetOutputPort(ROW)
        row: FloatArray = port.Eval(self._block.GetMyContextFromRoot(self._own))
        return row

    def write_back(self, count: int) -> None:
        """Sets time, states and logs of the diagram as wired, after some more steps."""
        own, context, composed = self._own, self._context, self.composed
        context.SetTime(own.get_time())
        self.steps += count
        at_block = self._block.GetMyContextFromRoot(own)
        names = enumerate(composed.block.held)
        held = {name: at_block.get_discrete_state(i).value() for i, name in names}
        x = at_block.get_continuous_state_vector().CopyToVector()
        put_states(composed, context, x, held)
        for system, copy in self._copies.items():
            at_copy = copy.GetMyMutableContextFromRoot(own)
            if isinstance(system, VectorLogSink):
                log, known = copy.FindMutableLog(own), system.FindMutableLog(context)
                for time, row in zip(log.sample_times(), log.data().T, strict=True):
                    known.AddData(time, row)
                log.Clear()
            elif not isinstance(system, SceneGraph):
                # Drake's copy of a context has all parameters as well.
                wired = system.GetMyMutableContextFromRoot(context)
                states = at_copy.get_state().get_abstract_state()
                for index in range(states.size()):
                    kept = wired.get_mutable_state().get_mutable_abstract_state()
                    kept.get_mutable_value(index).SetFrom(states.get_value(index))
                for index in range(at_copy.num_discrete_state_groups()):
                    wired.SetDiscreteState(index, at_copy.get_discrete_state(index).value())


_GOES_ON = EventStatus.DidNothing()


def _is_traced(system: System) -> bool:
    return isinstance(system, TracedSystem) or symbolic_block(system) is not None


def upstream(leaves: Leaves, ports: Iterable[Port], ends: Container[Port] = ()) -> set[System]:
    """The systems that lead to some ports, no farther than to those of `ends`."""
    found, todo = set[System](), [*ports]
    while todo:
        port = todo.pop()
        if port not in ends and port[0] not in found:
            found.add(port[0])
            todo += [source for place, source in leaves.sources.items() if place[0] is port[0]]
    return found


def states_in(composed: Composed, context: Context) -> tuple[FloatArray, dict[str, FloatArray]]:
    """The state of a block and its held values, by their groups, in a context of the diagram."""
    x = np.zeros(composed.block.state.numel())
    held = {name: np.zeros(each.symbol.numel()) for name, each in composed.block.held.items()}
    for system, part in composed.states.items():
        x[part] = context_in(system, context).get_continuous_state_vector().CopyToVector()
    for (system, i), (group, part) in composed.held.items():
        held[group][part] = context_in(system, context).get_discrete_state(i).value()
    return x, held


def put_states(
    composed: Composed, context: Context, x: FloatArray, held: Mapping[str, FloatArray]
) -> None:
    """Sets the states of the diagram in its context: the inverse of `states_in`."""
    for system, part in composed.states.items():
        context_in(system, context).SetContinuousState(x[part])
    for (system, i), (group, part) in composed.held.items():
        context_in(system, context).SetDiscreteState(i, held[group][part])


def parameters_in(composed: Composed, context: Context) -> FloatArray:
    """All numeric parameters of a block's leaves in a context of the diagram."""
    values = [np.zeros(0)]
    for local in (context_in(system, context) for system in composed.parameters):
        groups = range(local.num_numeric_parameter_groups())
        values += [local.get_numeric_parameter(i).CopyToVector() for i in groups]
    return np.concatenate(values)


def _is_by_wires(leaves: Leaves, context: Context) -> bool:
    """Whether each connected input port has the value of its source, not a fixed one.

    Drake does not say which ports have fixed values. So the ports are compared at another state.
    """
    moved = context.Clone()
    moved.SetTime(context.get_time() + NEAR)
    for index in range(moved.num_discrete_state_groups()):
        moved.SetDiscreteState(index, moved.get_discrete_state(index).value() + NEAR)
    if moved.num_continuous_states():
        values: FloatArray = moved.get_continuous_state_vector().CopyToVector()
        moved.SetContinuousState(values + NEAR)
    for (system, number), (source, k) in leaves.sources.items():
        port, written = system.get_input_port(number), source.get_output_port(k)
        if port.get_data_type() == PortDataType.kVectorValued and port.size():
            given = port.Eval(system.GetMyContextFromRoot(moved))
            value = written.Eval(source.GetMyContextFromRoot(moved))
            if not np.array_equal(given, value, equal_nan=True):
                return False
    return True
