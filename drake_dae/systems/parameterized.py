"""Blocks with the parameters of a DaeSystem, and its exogenous signals on a port."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray, numbers, unknown_name
from drake_dae.blocks.block import Block
from drake_dae.blocks.traced_system import TracedSystem
from drake_dae.dae import DaeSystem, DerivativeLayout
from drake_dae.errors import ModelError
from drake_dae.robots import RobotModel


class ParameterizedSystem(TracedSystem):
    """A block whose numeric parameter 0 begins with all parameters of a DaeSystem.

    Exogenous signals w come through an input port `exogenous` with as many derivatives, `degrees`,
    as the block needs, stacked like references; without a wire they keep the values of the
    parameters, at `exogenous_places`.
    """

    __slots__ = TracedSystem.__slots__

    def __init__(
        self,
        dae: DaeSystem,
        block: Block,
        degrees: Sequence[int] | None = None,
        sees_steps: bool | None = None,
    ) -> None:
        if degrees is None:
            after = (held.next for held in block.held.values())
            values = *block.outputs.values(), block.derivative, *after
            degrees = dae.exogenous.degrees(*values)
        self.dae = dae
        self.exogenous_layout = DerivativeLayout(tuple(degrees))
        self.exogenous_places: list[int] = dae.exogenous.places(degrees) if degrees else []
        if self.exogenous_places:
            block = with_exogenous(block, self.exogenous_places)
        super().__init__(block, compiled=dae.compiled, sees_steps=sees_steps)

    def _values(self, context: Context) -> FloatArray:
        values: FloatArray = context.get_numeric_parameter(0).value()
        if self.exogenous_places and self.GetInputPort("exogenous").HasValue(context):
            values = values.copy()
            values[self.exogenous_places] = self.GetInputPort("exogenous").Eval(context)
        return values

    def parameters(self, context: Context) -> FloatArray:
        """All parameters in the order of `dae.parameters`, shape (k,)."""
        self.check_context(context)
        values = context.get_numeric_parameter(0).value()
        return np.array(values[: self.dae.parameter_values.size])

    def current_parameters(self, context: Context) -> FloatArray:
        """All parameters as `parameters`, with exogenous ones at the context's time."""
        self.check_context(context)
        return np.array(self._values(context)[: self.dae.parameter_values.size])

    def get_parameter(self, context: Context, name: str) -> FloatArray:
        """A parameter by name, shape (k,)."""
        return self.parameters(context)[self.dae.parameter_slice(name)]

    def set_parameter(self, context: Context, name: str, value: ArrayLike) -> None:
        """Changes a parameter in a context: its value, shape (k,), or a number for all entries."""
        self.check_context(context)
        values = context.get_numeric_parameter(0).CopyToVector()
        put(self.dae, values, name, value)
        context.get_mutable_numeric_parameter(0).SetFromVector(values)


def with_exogenous(block: Block, places: Sequence[int]) -> Block:
    """The block, whose parameters at some places come through an input port `exogenous`."""
    exogenous, parameters = ca.SX.sym("exogenous", len(places)), ca.SX(block.parameters)
    parameters[list(places)] = exogenous
    moved = block.mapped(lambda v: ca.substitute(v, [block.parameters], [parameters]))
    return replace(
        moved,
        inputs={**block.inputs, "exogenous": exogenous},
        defaults={**moved.defaults, "exogenous": block.parameters[list(places)]},
    )


def changed_parameters(model: RobotModel, parameters: Mapping[str, ArrayLike]) -> FloatArray:
    """All parameters of a robot, some of surfaces, masses and loads changed for its plant."""
    values = model.dae.parameter_values
    parts: list[Any] = [model.links, *model.constraints, *model.stages, *model.known_forces]
    known = [parameter.name for part in parts for parameter in part.parameters]
    for name, value in parameters.items():
        if name not in known:
            raise ModelError(
                f"of this plant {unknown_name('parameter', name, known)}; give "
                "the law's model others instead"
            )
        put(model.dae, values, name, value)
    return values


def put(dae: DaeSystem, values: FloatArray, name: str, value: ArrayLike) -> None:
    """Changes a parameter of a system among all their values."""
    place, given = dae.parameter_slice(name), numbers(f"parameter '{name}'", value)
    if given.shape not in ((), (place.stop - place.start,)):
        raise ModelError(
            f"parameter '{name}' has {place.stop - place.start} entries, got {value!r}"
        )
    values[place] = given
    for parameter in dae.parameters:
        if parameter.name == name:
            parameter.check(values[place])
