"""The steps of what Drake steps in a diagram whose other blocks are traced."""

import numpy as np
from pydrake.systems.framework import Context, Diagram, System

from drake_dae.arrays import FloatArray
from drake_dae.blocks.computations import DrakeStepped
from drake_dae.compiler.wires import Wires


class DrakeSteps:
    """The steps of what Drake steps, each as a forced update of the system that has a state.

    The states are those of a Simulator, bit by bit. A Simulator takes longer: at each step it
    collects the events of all systems, and copies all their states.

    Args:
        stepped: What Drake steps.
        context: A context of `stepped.system` at the start; it is changed in place.
    """

    def __init__(self, stepped: DrakeStepped, context: Context) -> None:
        system, self._context = stepped.system, context
        self._read = stepped.read
        port = system.GetInputPort(stepped.into)
        self._input = port.FixValue(context, np.zeros(port.size()))
        self._part, self._local = _with_state(system, context)

    def step(self, time: float, given: FloatArray, outputs: FloatArray) -> None:
        """Makes the step at a time in s with an input, and writes the outputs after it, stacked.

        Raises:
            RuntimeError: Drake finds no step.
        """
        self._input.GetMutableData().get_mutable_value().SetFromVector(given)
        self._context.SetTime(time)
        self._part.ExecuteForcedEvents(self._local, False)
        self._read(self._context, outputs)


def _with_state(system: System, context: Context) -> tuple[System, Context]:
    """The only part of a system with a state, and its context; the system if several have one."""
    if not isinstance(system, Diagram):
        return system, context
    parts = Wires.of(system).systems
    stated = [
        (part, local)
        for part in parts
        for local in [system.GetMutableSubsystemContext(part, context)]
        if local.num_discrete_state_groups() or local.num_abstract_states()
    ]
    return stated[0] if len(stated) == 1 else (system, context)
