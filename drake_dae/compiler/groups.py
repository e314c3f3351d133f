"""The groups of discrete states and numeric parameters in a context of one system."""

from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray


def discrete_states(context: Context) -> list[FloatArray]:
    """The values of each group of discrete states."""
    groups = range(context.num_discrete_state_groups())
    return [context.get_discrete_state(i).value() for i in groups]


def numeric_parameters(context: Context) -> list[FloatArray]:
    """The values of each group of numeric parameters."""
    groups = range(context.num_numeric_parameter_groups())
    return [context.get_numeric_parameter(i).value() for i in groups]
