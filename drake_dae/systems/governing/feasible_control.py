"""A control within limits that changes the outputs' derivatives least, as a LeafSystem."""

from functools import cached_property

import numpy as np
from pydrake.systems.framework import BasicVector, Context

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.dae.governing.feasible import feasible_control, limits_reached
from drake_dae.dae.structure.structure import Structure
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.timing.motion_limits import MotionLimits
from drake_dae.errors import ModelError
from drake_dae.systems.blocks.block import ParameterizedSystem
from drake_dae.systems.blocks.lifetime import SHARED_DICTIONARY, weakly
from drake_dae.systems.blocks.traced import PARAMETERS, Block, Computation
from drake_dae.trace.functions import TracedFunction

OUTPUTS = ("control", "excess", "departure", "is_limited")
"""The output ports, in the order of the function's results."""


@checked(ModelError)
class FeasibleControl(ParameterizedSystem):
    """The control within limits that is nearest to the commanded one in the outputs' derivatives.

    See `feasible_control` for the law. If the commanded control is within all limits, it does not
    change.

    Input ports:
        estimated_state: x, shape (n,).
        control: The commanded control, shape (p,).
        exogenous: The exogenous signals of the system with their derivatives, such as the
            estimates of an observer; only if it has any.

    Output ports:
        control: u, shape (p,).
        excess: The commanded control minus u, shape (p,): 0 within the limits.
        departure: ubar - ubar_d, the deviation of the outputs' highest derivatives from those of
            (28), shape (p,): 0 while errors follow their prediction (30).
        is_limited: 1 while u is not the commanded control, otherwise 0, shape (1,).

    Numeric parameter 0 holds the model's parameters.

    Args:
        structure: The structure of the law's system.
        limits: Limits of all controls, and others.
        sample_period: The time in s in which the control is constant; 0 if it is continuous.

    Raises:
        ModelError: As of `feasible_control`.
    """

    __slots__ = SHARED_DICTIONARY
    no_gradient = "its control has kinks where limits are reached"

    def __init__(
        self, structure: Structure, limits: MotionLimits, sample_period: float = 0.0
    ) -> None:
        system = structure.system
        names = {"state": system.state_signals, "control": system.control_signals}
        super().__init__(system, system.parameter_values, names)
        self.set_name("feasible_control")
        self._structure, self._kept = structure, (limits, sample_period)
        self.function = feasible_control(structure, *self._kept)
        self._state = self.DeclareVectorInputPort("estimated_state", system.num_states)
        self._commanded = self.DeclareVectorInputPort("control", system.num_controls)
        self._declare_exogenous(system.exogenous.degrees(structure.drift, structure.control_matrix))
        sources = {self.all_input_ports_ticket(), self.all_parameters_ticket()}
        for index, name in enumerate(OUTPUTS):
            size = self.function.outputs[index].size
            self.DeclareVectorOutputPort(name, size, weakly(self._calc, index), sources)

    @property
    def departure_signals(self) -> tuple[Signal, ...]:
        """Names and units of the departure."""
        return tuple(
            Signal(f"departure of {signal.name}", signal.derivative(degree).unit)
            for signal, degree in zip(
                self.dae.output_signals, self._structure.output_degrees, strict=True
            )
        )

    @cached_property
    def _reached(self) -> tuple[TracedFunction, tuple[str, ...]]:
        return limits_reached(self._structure, *self._kept)

    def beyond(
        self, states: FloatArray, controls: FloatArray, exogenous: FloatArray | None = None
    ) -> dict[str, FloatArray]:
        """Name of a limit, such as "largest joint1_motor" -> by what share of it it is exceeded.

        Args:
            states: States, shape (k, n).
            controls: Controls, shape (k, p).
            exogenous: The values of the port `exogenous`, shape (k, e); those of the model's
                parameters if None.

        Returns:
            For each limit an array of shape (k,), negative within the limit.
        """
        function, names = self._reached
        parameters = np.tile(self.dae.parameter_values, (len(states), 1))
        if exogenous is not None:
            parameters[:, self.exogenous_places] = exogenous
        rows = zip(states, controls, parameters, strict=True)
        over = [function(*row)[0] for row in rows]
        found: dict[str, FloatArray] = {}
        # A friction cone has several rows of one name.
        for name, share in zip(names, np.reshape(over, (-1, len(names))).T, strict=True):
            found[name] = np.maximum(share, found.get(name, share))
        return found

    def _calc(self, index: int, context: Context, output: BasicVector) -> None:
        state, control = self._state.Eval(context), self._commanded.Eval(context)
        values = self._checked(self.function, context, state, control)
        output.SetFromVector(values[index].reshape(-1))

    def traced(self) -> Block:
        sources = ("estimated_state", "control", PARAMETERS)
        return Block(
            self,
            (Computation.of(self.function, sources, OUTPUTS),),
            moving=tuple(self.exogenous_places),
            model=self.dae,
            signals=self._signals,
            ports={"control": tuple(self.dae.control_signals)},
        )
