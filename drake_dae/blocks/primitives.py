"""Drake's own systems as blocks, by their conversion to symbolic expressions."""

from typing import Any
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.symbolic import Expression, Variable
from pydrake.systems.framework import PortDataType, System

from drake_dae.blocks.block import NOTHING, TIME, Block, Held, stacked
from drake_dae.blocks.symbolic import to_casadi
from drake_dae.errors import ModelError


def symbolic_block(system: System) -> Block | None:
    """A system of Drake, or a LeafSystem templated on the scalar type; None if it is no block."""
    if system not in _KNOWN:
        _KNOWN[system] = _traced(system)
    return _KNOWN[system]


_KNOWN: WeakKeyDictionary[System, Block | None] = WeakKeyDictionary()
"""The blocks of systems that were asked for, since a conversion takes long."""


def _traced(system: System) -> Block | None:
    default = system.CreateDefaultContext()
    is_abstract = default.num_abstract_states() or default.num_abstract_parameters()
    if is_abstract or isinstance(system, MultibodyPlant):  # Whose conversion takes seconds.
        return None
    try:
        return _converted(system, system.ToSymbolic())
    except (RuntimeError, ModelError, SystemExit):
        return None


def _converted(system: System, other: Any) -> Block | None:
    default, context = system.CreateDefaultContext(), other.CreateDefaultContext()
    known: dict[int, ca.SX] = {}

    def variables(column: ca.SX) -> np.ndarray:
        """New variables of Drake, each with its CasADi symbol."""
        own = [Variable(f"x{i}") for i in range(column.numel())]
        known.update({v.get_id(): column[i] for i, v in enumerate(own)})
        return np.array([Expression(v) for v in own], dtype=object)

    def traced(values: Any) -> ca.SX:
        rows = [to_casadi(value, known, smooth=False) for value in np.atleast_1d(values)]
        return ca.densify(stacked(rows))

    context.SetTime(variables(TIME)[0])
    state = ca.SX.sym("state", default.num_continuous_states())
    if state.numel():
        context.SetContinuousState(variables(state))
    groups = range(default.num_discrete_state_groups())
    now = [default.get_discrete_state(i).CopyToVector() for i in groups]
    held = [ca.SX.sym(f"held{i}", now[i].size) for i in groups]
    for i in groups:
        context.SetDiscreteState(i, variables(held[i]))
    counts = range(default.num_numeric_parameter_groups())
    numbers = [default.get_numeric_parameter(i).CopyToVector() for i in counts]
    parameters = [ca.SX.sym(f"parameter{i}", each.size) for i, each in enumerate(numbers)]
    for i, column in enumerate(parameters):
        context.get_mutable_numeric_parameter(i).SetFromVector(variables(column))
    inputs = {}
    for i in range(system.num_input_ports()):
        port = system.get_input_port(i)
        if port.get_data_type() != PortDataType.kVectorValued:
            return None
        inputs[port.get_name()] = column = ca.SX.sym(port.get_name(), port.size())
        other.get_input_port(i).FixValue(context, variables(column))
    outputs = {}
    for i in range(system.num_output_ports()):
        port = system.get_output_port(i)
        if port.get_data_type() == PortDataType.kVectorValued:
            outputs[port.get_name()] = traced(other.get_output_port(i).Eval(context))
    derivative, updated = NOTHING, {}
    if state.numel():
        derivative = traced(other.EvalTimeDerivatives(context).CopyToVector())
    if held:
        event = system.GetUniquePeriodicDiscreteUpdateAttribute()
        if event is None:
            return None
        after = other.EvalUniquePeriodicDiscreteUpdate(context)
        rate = event.period_sec(), event.offset_sec(), False
        updated = {f"held{i}": Held(held[i], traced(after.value(i)), now[i], *rate) for i in groups}
    return Block(
        system.get_name(),
        inputs,
        outputs,
        state,
        derivative,
        updated,
        stacked(parameters),
        {
            "state": default.get_continuous_state_vector().CopyToVector(),
            "parameters": np.concatenate([np.zeros(0), *numbers]),
        },
    )
