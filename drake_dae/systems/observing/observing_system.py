"""The base class of observers of model errors: their ports, and the hold of integrals."""

from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context

from drake_dae.arrays import numbers, positive
from drake_dae.blocks.block import Block, Held
from drake_dae.blocks.lifetime import SHARED_DICTIONARY
from drake_dae.dae import Signal, TrackingLaw
from drake_dae.errors import ModelError
from drake_dae.systems.observing.observed import Observed
from drake_dae.systems.observing.observer_rates import Observing
from drake_dae.systems.parameterized import ParameterizedSystem


class ObservingSystem(ParameterizedSystem):
    """A sampled observer of a law's disturbance and coefficients of friction.

    Args:
        law: The law.
        observing: The rates, and the thresholds for friction.
        sample_period: T in s.
        functions: The functions of the observer.
        block: Its block, with one group of held values.
        place: The place of mu among these.

    Attributes:
        observing, sample_period: The arguments.
        observation: The observed functions.
        disturbance_signals, friction_signals: Names and units of the output ports.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(
        self,
        law: TrackingLaw,
        observing: Observing,
        sample_period: float,
        functions: Observed,
        block: Block,
        place: int,
    ) -> None:
        self.observing, self.sample_period = observing, sample_period
        self.observation = functions.observation
        self._place = place
        super().__init__(law.system, block, degrees=(), sees_steps=False)

    @property
    def disturbance_signals(self) -> Sequence[Signal]:
        return self.block.signals["disturbance"]

    @property
    def friction_signals(self) -> Sequence[Signal]:
        return self.block.signals["friction"]

    @property
    def further_signals(self) -> dict[str, Sequence[Signal]]:
        """Name of an output port in a record -> names and units of its entries."""
        named = {name: self.block.signals.get(name, ()) for name in self.block.outputs}
        others = ("estimated_state", "exogenous", "hold")
        return {name: signals for name, signals in named.items() if signals and name not in others}

    def set_friction(self, context: Context, friction: ArrayLike) -> None:
        """Sets the initial coefficients of friction, shape (c,), or a number for all.

        Raises:
            ModelError: The shape is wrong, or a value is negative or above the largest.
        """
        self.check_context(context)
        given, most = numbers("friction", friction), self.observing.largest_friction
        count = len(self.friction_signals)
        if given.shape not in ((), (count,)) or not np.all((given >= 0) & (given <= most)):
            raise ModelError(
                f"friction must be from 0 to {most:g}, a number or shape ({count},), got "
                f"{friction!r}"
            )
        values = context.get_discrete_state(0).CopyToVector()
        values[self._place : self._place + count] = given
        context.SetDiscreteState(0, values)


def check_timing(sample_period: float, control_lag: float, control_delay: float) -> float:
    """Checks the numbers of an observer's samples, and returns T.

    Raises:
        ModelError: One is not valid.
    """
    if not 0.0 <= control_lag <= 1.0:
        raise ModelError(f"control_lag must be from 0 to 1, got {control_lag:g}")
    if not control_delay >= 0.0:
        raise ModelError(f"control_delay must be 0 s or more, got {control_delay:g} s")
    return positive("sample_period", sample_period)


def observer_block(
    name: str,
    law: TrackingLaw,
    functions: Observed,
    inputs: Mapping[str, ca.SX],
    outputs: Mapping[str, ca.SX],
    force: ca.SX,
    held: Held,
    place: int,
) -> Block:
    """The block of an observer, with the ports that all have.

    Args:
        name: Its name.
        law: The law.
        functions: The functions of the observer.
        inputs: Its input ports.
        outputs: Its output ports without `hold`.
        force: The constraint force.
        held: Its memory, with zeros at the place of mu in the start.
        place: The place of mu among the held values.
    """
    system, observation = law.system, functions.observation
    names = list(observation.frictions)
    for j, friction in enumerate(names, place):
        held.start[j : j + 1] = system.parameter_values[system.parameter_slice(friction)]
    state = next(symbol for port, symbol in inputs.items() if port.endswith("_state"))
    rates = observation.moving.function(state, system.parameter_symbol)[0]
    hold = functions.hold.function(force, inputs["hold"])[0]
    rows = observation.rows
    return Block(
        name,
        inputs,
        {**outputs, "hold": hold},
        parameters=system.parameter_symbol,
        start={"parameters": system.parameter_values},
        held={"memory": held},
        defaults={"hold": ca.SX.zeros(1), "reference": rates},
        signals={
            "estimated_state": system.state_signals,
            "measured_state": system.state_signals,
            "control": system.control_signals,
            "measured_force": system.constraint_input_signals,
            "disturbance": tuple(
                Signal(f"disturbance of {system.state_signals[i].name}") for i in rows
            ),
            "friction": tuple(Signal(friction) for friction in names),
        },
    )


def columns(law: TrackingLaw, state: str, *, with_force: bool) -> dict[str, ca.SX]:
    """The input ports of an observer, with new symbols."""
    system = law.system
    sizes = {
        state: system.num_states,
        "control": system.num_controls,
        "hold": 1,
        "reference": law.layout.reference_size,
    }
    if with_force:
        sizes["measured_force"] = system.num_constraints
    return {name: ca.SX.sym(name, size) for name, size in sizes.items()}
