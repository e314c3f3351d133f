"""Parameters of a DaeSystem in a Drake context."""

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import BasicVector, Context

from drake_dae.dae.system import DaeSystem
from drake_dae.errors import FloatArray, ModelError
from drake_dae.systems.autodiff import DifferentiableSystem


class ParameterizedSystem(DifferentiableSystem):
    """A LeafSystem whose numeric parameter 0 starts with all parameters of a DaeSystem.

    So a study changes numbers in a context without tracing again, and a controller can be given
    other numbers than its plant.

    Args:
        dae: The system.
        values: The default: `dae.parameter_values`, and what else the system appends.
    """

    def __init__(self, dae: DaeSystem, values: FloatArray) -> None:
        super().__init__()
        self.dae = dae
        self.DeclareNumericParameter(BasicVector(values))

    def parameters(self, context: Context) -> FloatArray:
        """All parameters in the order of `dae.parameters`, shape (k,)."""
        values = context.get_numeric_parameter(0).value()
        return np.array(values[: self.dae.parameter_values.size])

    def get_parameter(self, context: Context, name: str) -> FloatArray:
        """A parameter by name, shape (k,).

        Raises:
            ModelError: No parameter has that name.
        """
        return self.parameters(context)[self.dae.parameter_slice(name)]

    def set_parameter(self, context: Context, name: str, value: ArrayLike) -> None:
        """Changes a parameter in a context.

        Args:
            context: Of this system.
            name: As in `dae.parameters`.
            value: Shape (k,), or a number for all entries.

        Raises:
            ModelError: No parameter has that name, or a value that does not fit.
        """
        values = context.get_numeric_parameter(0).CopyToVector()
        place = self.dae.parameter_slice(name)
        try:
            values[place] = np.asarray(value, dtype=float)
        except ValueError:
            size = place.stop - place.start
            raise ModelError(f"parameter '{name}' has {size} entries, got {value!r}") from None
        for parameter in self.dae.parameters:
            if parameter.name == name:
                parameter.check(values[place])
        context.get_mutable_numeric_parameter(0).SetFromVector(values)
