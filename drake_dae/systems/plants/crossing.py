"""The motion of a plant through a singular configuration."""

from collections.abc import Sequence

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.structure.constrained import ConstraintStructure
from drake_dae.dae.structure.passage import Passage
from drake_dae.trace.functions import TracedFunction


class Crossing:
    """The motion, force and outputs at states with dependent gradients of constraints.

    They are taken along the branch of the velocity, without the unbounded components; see
    `Passage`.

    Args:
        structure: The structure of the plant's system.

    Attributes:
        doubt: Negative where the regular functions are not valid; None if no singular configuration
            can be crossed.
    """

    def __init__(self, structure: ConstraintStructure) -> None:
        system = structure.system
        self._passage = Passage(structure)
        self.doubt = self._passage.doubt
        v = structure.derivatives.constraint_input
        shown = {"force": system.forces(v), "output": system.outputs(v)}
        self._force_of, self._output_of = (
            system.trace(name, {"value": value}, {"v": v}, often=False)
            for name, value in shown.items()
        )
        self._num_controls = system.num_controls

    def stands_in_for(
        self, dynamics: TracedFunction, force: TracedFunction, output: TracedFunction
    ) -> None:
        """Sets the functions of the plant that it replaces."""
        self._dynamics = dynamics
        self._known = {force: self._force_of, output: self._output_of}

    def values(
        self,
        function: TracedFunction,
        state: FloatArray,
        inputs: Sequence[FloatArray],
        parameters: FloatArray,
    ) -> tuple[FloatArray, ...] | None:
        """The values of a function that is not valid itself; None if there are none.

        Args:
            function: A function of the plant.
            state: x, shape (n,).
            inputs: The control, if the function takes it.
            parameters: Values of all parameters.
        """
        values = tuple(value.copy() for value in function.evaluate(state, *inputs, parameters))
        if not all(np.isfinite(known).all() for known in (state, *inputs)):
            return None
        is_regular = function.is_regular
        control = inputs[0] if inputs else np.zeros(self._num_controls)
        crossed = self._passage.motion(state, control, parameters)
        if crossed is None:
            return values if is_regular else None
        if function is self._dynamics:
            return crossed[:1]
        known = self._known.get(function)
        return None if known is None else (known(state, crossed[1], parameters)[0],)

    def happens(self, state: FloatArray, control: FloatArray, parameters: FloatArray) -> bool:
        """Whether the system passes a singular configuration near a state."""
        return self._passage.motion(state, control, parameters) is not None
