"""Drake's own systems as traced blocks, by their conversion to symbolic expressions."""

from collections.abc import Iterable
from typing import Any

import casadi as ca
import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.symbolic import Expression, Variable
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, EventStatus, PortDataType, System
from pydrake.systems.primitives import RandomSource

from drake_dae.blocks.computations import (
    DERIVATIVE,
    HELD,
    NOISE,
    PARAMETERS,
    STATE,
    TIME,
    Computation,
    Computations,
    Update,
    not_traced,
)
from drake_dae.blocks.symbolic import to_casadi
from drake_dae.compiler.groups import discrete_states, numeric_parameters
from drake_dae.errors import ModelError


def primitive(system: System) -> Computations:
    """Traces a system of Drake, or a user's LeafSystem, by converting it to symbolic expressions.

    Args:
        system: A leaf system.

    Raises:
        ModelError: The system does not convert, has abstract state, or computes something that
            symbolic expressions cannot represent.
    """
    if isinstance(system, RandomSource):
        return _random_source(system)
    if isinstance(system, MultibodyPlant):
        raise not_traced("Drake's own MultibodyPlant, with its contact,")
    name = f"'{system.get_name()}' ({type(system).__name__})"
    try:
        converted = system.ToSymbolic()
    except RuntimeError:
        raise ModelError(
            f"{name} cannot be traced: it has no traced functions and does not convert to "
            "symbolic expressions, so that it only runs in Drake's Simulator"
        ) from None
    try:
        return _Converted(system, converted, name).block()
    except RuntimeError as error:  # Drake cannot compute it with expressions.
        reason = str(error).splitlines()[0]
        raise ModelError(
            f"{name} cannot be traced, so that it only runs in Drake's Simulator: {reason}"
        ) from None


def _random_source(source: RandomSource) -> Computations:
    """A block that draws new random numbers at each multiple of its period and holds them."""
    size = source.get_output_port().size()
    held, noise = ca.SX.sym("held", size), ca.SX.sym("noise", size)
    output = Computation(
        ca.Function("output", [held], [held]), (HELD,), (source.get_output_port().get_name(),)
    )
    draw = Computation(ca.Function("draw", [noise], [noise]), (NOISE,), (HELD,))
    return Computations(source, (output,), (Update(draw, _period(source), 0.0, True),))


def _period(source: RandomSource) -> float:
    """The time between two draws in s, which is the time of the first event after t = 0."""
    simulator, times = Simulator(source), list[float]()

    def stop(context: Context) -> EventStatus:
        times.append(context.get_time())
        if len(times) < 3:
            return EventStatus.DidNothing()
        return EventStatus.ReachedTermination(source, "seen")

    simulator.set_monitor(stop)
    simulator.AdvanceTo(1e9)
    return next(time for time in times if time > 0.0)


class _Converted:
    """A system converted to symbolic expressions, in a context whose values are variables.

    Args:
        system: The system.
        converted: The system with the scalar type Expression.
        name: The name of the system in messages.
    """

    def __init__(self, system: System, converted: System, name: str) -> None:
        self._system, self._converted, self._name = system, converted, name
        self._context = context = converted.CreateDefaultContext()
        default = system.CreateDefaultContext()
        if default.num_abstract_states() or default.num_abstract_parameters():
            raise ModelError(
                f"{name} cannot be traced: it has an abstract state or parameter, so that it "
                "only runs in Drake's Simulator"
            )
        self._symbols: dict[int, ca.SX] = {}
        self._columns: dict[str, ca.SX] = {}
        time = self._variables(TIME, 1)
        context.SetTime(time[0])
        sizes = {
            STATE: [default.num_continuous_states()],
            HELD: [group.size for group in discrete_states(default)],
            PARAMETERS: [group.size for group in numeric_parameters(default)],
        }
        state, held, parameters = (
            np.split(self._variables(source, sum(each)), np.cumsum(each)[:-1])
            for source, each in sizes.items()
        )
        if sizes[STATE][0]:
            context.SetContinuousState(state[0])
        for index in range(len(sizes[HELD])):
            context.SetDiscreteState(index, held[index])
        for index in range(len(sizes[PARAMETERS])):
            context.get_mutable_numeric_parameter(index).SetFromVector(parameters[index])
        for index in range(system.num_input_ports()):
            port = system.get_input_port(index)
            if port.get_data_type() == PortDataType.kVectorValued:
                variables = self._variables(port.get_name(), port.size())
                converted.get_input_port(index).FixValue(context, variables)
        self._has_state, self._has_held = bool(sizes[STATE][0]), bool(sum(sizes[HELD]))

    def block(self) -> Computations:
        """The system as a traced block."""
        system, converted, context = self._system, self._converted, self._context
        computations = []
        for index in range(system.num_output_ports()):
            port = system.get_output_port(index)
            if port.get_data_type() == PortDataType.kVectorValued:
                values = np.atleast_1d(converted.get_output_port(index).Eval(context))
                computations.append(self._computation(port.get_name(), values))
        if self._has_state:
            rates = converted.EvalTimeDerivatives(context).CopyToVector()
            computations.append(self._computation(DERIVATIVE, rates))
        updates = []
        if self._has_held:
            event = system.GetUniquePeriodicDiscreteUpdateAttribute()
            if event is None:
                raise ModelError(
                    f"{self._name} cannot be traced: its discrete state has no update of one "
                    "period, so that it only runs in Drake's Simulator"
                )
            values = converted.EvalUniquePeriodicDiscreteUpdate(context)
            next_held = np.concatenate(
                [np.atleast_1d(values.value(i)) for i in range(values.num_groups())]
            )
            update = self._computation(HELD, next_held)
            updates.append(Update(update, event.period_sec(), event.offset_sec()))
        return Computations(system, tuple(computations), tuple(updates))

    def _variables(self, source: str, size: int) -> np.ndarray:
        """New Drake variables for a column, each with a CasADi symbol of its own."""
        column = ca.SX.sym(source.strip("$"), size)
        variables = [Variable(f"{source}_{i}") for i in range(size)]
        self._symbols |= {v.get_id(): column[i] for i, v in enumerate(variables)}
        self._columns[source] = column
        return np.array([Expression(variable) for variable in variables], dtype=object)

    def _computation(self, output: str, values: Iterable[Any]) -> Computation:
        try:
            rows = [to_casadi(value, self._symbols, smooth=False) for value in values]
        except ModelError as error:
            raise ModelError(f"{self._name} cannot be traced: {error}") from None
        value = ca.densify(ca.vertcat(ca.SX(0, 1), *rows))
        # Only the columns that it depends on, so that no false feedthrough is reported.
        names = [n for n, column in self._columns.items() if ca.depends_on(value, column)]
        function = ca.Function("computation", [self._columns[name] for name in names], [value])
        return Computation(function, tuple(names), (output,))
