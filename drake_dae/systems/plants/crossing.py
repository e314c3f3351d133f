"""What a plant does at a singular configuration that its motion crosses."""

from collections.abc import Sequence

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.structure.constrained import ConstraintStructure
from drake_dae.dae.structure.passage import Passage
from drake_dae.trace.functions import TracedFunction


class Crossing:
    """The motion, the force and the outputs where gradients of constraints depend on each other.

    They are those along the branch that the velocity leads along, without what grows there without
    bound; see `Passage`.

    Args:
        structure: The structure of the plant's system.

    Attributes:
        doubt: Negative where values that do not know of the crossing are not valid; None where
            there is nothing to cross.
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
        """Tells which functions of the plant it has other values for."""
        self._dynamics = dynamics
        self._known = {force: self._force_of, output: self._output_of}

    def values(
        self,
        function: TracedFunction,
        state: FloatArray,
        inputs: Sequence[FloatArray],
        parameters: FloatArray,
    ) -> tuple[FloatArray, ...] | None:
        """The values of a function whose own are not valid; None where there are none.

        Args:
            function: One of the plant's.
            state: x, shape (n,).
            inputs: The control, if the function takes it.
            parameters: Values of all parameters.
        """
        own = tuple(value.copy() for value in function.evaluate(state, *inputs, parameters))
        if not all(np.isfinite(given).all() for given in (state, *inputs)):
            return None
        is_regular = function.is_regular
        control = inputs[0] if inputs else np.zeros(self._num_controls)
        found = self._passage.motion(state, control, parameters)
        if found is None:
            return own if is_regular else None
        if function is self._dynamics:
            return found[:1]
        given = self._known.get(function)
        return None if given is None else (given(state, found[1], parameters)[0],)

    def happens(self, state: FloatArray, control: FloatArray, parameters: FloatArray) -> bool:
        """Whether the system crosses a singular configuration at a state next to one."""
        return self._passage.motion(state, control, parameters) is not None
