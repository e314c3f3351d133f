"""The run of a diagram in which all traced blocks are one, by Drake's Simulator."""

from collections.abc import Callable
from contextlib import suppress
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
    PortDataType,
    System,
)
from pydrake.systems.primitives import VectorLogSink

from drake_dae.arrays import FloatArray
from drake_dae.blocks.compose import Leaves, compose
from drake_dae.blocks.primitives import symbolic_block
from drake_dae.blocks.traced_system import TracedSystem
from drake_dae.errors import DrakeDaeError
from drake_dae.systems.plant import plants_in

EVERY = 32  # The number of steps after which the context of the diagram as wired gets the results.
# The least number of steps for which composing the diagram takes less time than it saves.
WORTH = 500
USUAL = 0.02  # The usual step with error control in s, of a robot that moves through some radians.
NEAR = 1e-6  # The distance of another state at which ports are compared, in any unit.
# The initialization of a Simulator that goes on from a context.
NO_EVENTS = InitializeParams(suppress_initialization_events=True)


class CompiledRun:
    """A diagram in which one block has the place of all that can be traced, beside the rest.

    The rest, such as Drake's MultibodyPlant and sources of random numbers, are copies. States, logs
    and time of the diagram as wired follow after every few steps; `steps` counts these.
    """

    def __init__(self, diagram: Diagram, context: Context, config: SimulatorConfig) -> None:
        self._context, self.steps, leaves = context, 0, Leaves.of(diagram)
        logs = [s for s in leaves.systems if isinstance(s, VectorLogSink)]
        rest = logs + [s for s in leaves.systems if s not in logs and not _is_traced(s)]
        outputs = {
            f"{system.get_name()}.{system.get_input_port(i).get_name()}": (system, i)
            for system in rest
            for i in range(system.num_input_ports())
            if (system, i) in leaves.sources and _is_traced(leaves.sources[system, i][0])
        }
        sources = {name: leaves.sources[place] for name, place in outputs.items()}
        ports = {name: system.get_output_port(i) for name, (system, i) in sources.items()}
        self.composed = composed = compose(
            diagram, ports, context=context, merge=True, is_whole=True
        )
        (choice, *_) = [p.dae.compiled for p in plants_in(diagram)]
        builder = DiagramBuilder()
        self._block = block = builder.AddSystem(TracedSystem(composed.block, compiled=choice))
        self._copies = copies = {system: builder.AddSystem(_copy(system)) for system in rest}
        for (system, i), (source, k) in leaves.sources.items():
            if system in copies and source in copies:
                written = copies[source].get_output_port(k)
                builder.Connect(written, copies[system].get_input_port(i))
        for name, (system, i) in outputs.items():
            builder.Connect(block.GetOutputPort(name), copies[system].get_input_port(i))
        for name, (source, k) in composed.cuts.items():
            builder.Connect(copies[source].get_output_port(k), block.GetInputPort(name))
        self._diagram = builder.Build()
        self._own = own = self._diagram.CreateDefaultContext()
        own.SetTime(context.get_time())
        for system in rest[len(logs) :]:
            copy, at_system = copies[system], system.GetMyContextFromRoot(context)
            local = copy.GetMyMutableContextFromRoot(own)
            local.SetStateAndParametersFrom(at_system)
            for i in range(system.num_input_ports()):  # Those with a fixed value.
                port = system.get_input_port(i)
                is_vector = port.get_data_type() == PortDataType.kVectorValued
                if (system, i) not in leaves.sources and is_vector and port.HasValue(at_system):
                    copy.get_input_port(i).FixValue(local, port.Eval(at_system))
        at_block = block.GetMyMutableContextFromRoot(own)
        for name, (system, i) in composed.fixed.items():
            port, local = system.get_input_port(i), system.GetMyContextFromRoot(context)
            if port.HasValue(local):
                block.GetInputPort(name).FixValue(at_block, port.Eval(local))
        self._simulator = Simulator(self._diagram, own)
        ApplySimulatorConfig(config, self._simulator)
        own.SetAccuracy(config.accuracy)
        self._simulator.Initialize(NO_EVENTS)
        block.begin_run(at_block)
        for log in logs:  # The log as wired has the start already.
            copies[log].FindMutableLog(own).Clear()

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
            run = cls(diagram, context, config)
            return run if _is_by_wires(diagram, context) else None
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
            self._write_back(count)
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
            self._write_back(count)
        except (DrakeDaeError, RuntimeError):
            if refused is not None:
                raise refused from None
            return False
        if goes_on:
            seen(self._context, count)
        return True

    def _write_back(self, count: int) -> None:
        """Sets time, states and logs of the diagram as wired, after some more steps."""
        own, context, composed = self._own, self._context, self.composed
        context.SetTime(own.get_time())
        self.steps += count
        at_block = self._block.GetMyContextFromRoot(own)
        if composed.states:
            x = at_block.get_continuous_state_vector().CopyToVector()
            for system, part in composed.states.items():
                system.GetMyMutableContextFromRoot(context).SetContinuousState(x[part])
        groups = {name: i for i, name in enumerate(composed.block.held)}
        for (system, index), (name, part) in composed.held.items():
            values = at_block.get_discrete_state(groups[name]).value()[part]
            system.GetMyMutableContextFromRoot(context).SetDiscreteState(index, values)
        for system, copy in self._copies.items():
            at_copy = copy.GetMyMutableContextFromRoot(own)
            if isinstance(system, VectorLogSink):
                log, known = copy.FindMutableLog(own), system.FindMutableLog(context)
                for time, row in zip(log.sample_times(), log.data().T, strict=True):
                    known.AddData(time, row)
                log.Clear()
            elif not isinstance(system, SceneGraph):
                _copy_state(at_copy, system.GetMyMutableContextFromRoot(context))


_GOES_ON = EventStatus.DidNothing()


def _is_traced(system: System) -> bool:
    return isinstance(system, TracedSystem) or symbolic_block(system) is not None


def _copy(system: System) -> System:
    """Another instance of a system of Drake, or of one of ours that says how."""
    again = getattr(system, "again", None)
    copy = system.Clone() if again is None else again()
    copy.set_name(system.get_name())
    return copy


def _copy_state(source: Context, target: Context) -> None:
    """Copies discrete and abstract states; Drake's copy of a context has all parameters as well."""
    states = source.get_state().get_abstract_state()
    copies = target.get_mutable_state().get_mutable_abstract_state()
    for index in range(states.size()):
        copies.get_mutable_value(index).SetFrom(states.get_value(index))
    for index in range(source.num_discrete_state_groups()):
        target.SetDiscreteState(index, source.get_discrete_state(index).value())


def _is_by_wires(diagram: Diagram, context: Context) -> bool:
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
    for (system, number), (source, k) in Leaves.of(diagram).sources.items():
        port, written = system.get_input_port(number), source.get_output_port(k)
        if port.get_data_type() == PortDataType.kVectorValued and port.size():
            given = port.Eval(system.GetMyContextFromRoot(moved))
            value = written.Eval(source.GetMyContextFromRoot(moved))
            if not np.array_equal(given, value, equal_nan=True):
                return False
    return True
