"""Blocks with the parameters of a DaeSystem, and its exogenous signals on a port."""

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray, numbers
from drake_dae.blocks.block import Block, Requirement
from drake_dae.blocks.traced_system import TracedSystem
from drake_dae.dae import DaeSystem, DerivativeLayout
from drake_dae.errors import ModelError


class ParameterizedSystem(TracedSystem):
    """A block whose numeric parameter 0 begins with all parameters of a DaeSystem.

    So a study changes numbers in a context without tracing again, and a controller can have other
    numbers than its plant. Varying parameters, the exogenous signals w, come through an input port
    `exogenous` with the derivatives that the block needs, stacked like references: w_1, w_1', ...,
    w_2, ...; see `exogenous_layout`. Without a wire they keep the values of the parameters.

    Attributes:
        dae: The system.
        exogenous_layout: The layout of the port's entries.
        exogenous_places: Their indices among the parameters.

    Args:
        dae: The system.
        block: The block; its parameters begin with those of the system.
        degrees: The number of derivatives of each entry of w that the block needs; by default
            those on which its expressions depend.
        sees_steps: As of `TracedSystem`.
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
            values = *block.outputs.values(), block.derivative, *_next(block)
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
        """A parameter by name, shape (k,).

        Raises:
            ModelError: No parameter has that name.
        """
        return self.parameters(context)[self.dae.parameter_slice(name)]

    def set_parameter(self, context: Context, name: str, value: ArrayLike) -> None:
        """Changes a parameter in a context.

        Args:
            context: The context of this system.
            name: The name of the parameter in `dae.parameters`.
            value: The new value, shape (k,), or a number for all entries.

        Raises:
            ModelError: No parameter has that name, or the value does not fit.
        """
        self.check_context(context)
        values = context.get_numeric_parameter(0).CopyToVector()
        place = self.dae.parameter_slice(name)
        given = numbers(f"parameter '{name}'", value)
        size = place.stop - place.start
        if given.shape not in ((), (size,)):
            raise ModelError(f"parameter '{name}' has {size} entries, got {value!r}")
        values[place] = given
        for parameter in self.dae.parameters:
            if parameter.name == name:
                parameter.check(values[place])
        context.get_mutable_numeric_parameter(0).SetFromVector(values)


def with_exogenous(block: Block, places: Sequence[int]) -> Block:
    """The block, whose parameters at some places come through an input port `exogenous`."""
    exogenous, parameters = ca.SX.sym("exogenous", len(places)), ca.SX(block.parameters)
    parameters[list(places)] = exogenous

    def moved(value: ca.SX) -> ca.SX:
        (value,) = ca.substitute([value], [block.parameters], [parameters])
        return value

    projection = block.projection
    if projection is not None:
        projection = replace(projection, parameters=moved(projection.parameters))
    return replace(
        block,
        projection=projection,
        inputs={**block.inputs, "exogenous": exogenous},
        outputs={name: moved(value) for name, value in block.outputs.items()},
        derivative=moved(block.derivative),
        held={
            name: replace(
                held,
                next=moved(held.next),
                begin=None if held.begin is None else moved(held.begin),
            )
            for name, held in block.held.items()
        },
        defaults={
            **{name: moved(value) for name, value in block.defaults.items()},
            "exogenous": block.parameters[list(places)],
        },
        requirements=tuple(
            Requirement(moved(r.margin), r.reason, r.fault) for r in block.requirements
        ),
    )


def _next(block: Block) -> list[ca.SX]:
    return [held.next for held in block.held.values()]
