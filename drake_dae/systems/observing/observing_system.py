"""The base class of observers of model errors: their ports, and the hold of integrals."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context, DependencyTicket

from drake_dae.arrays import FloatArray, numbers, positive
from drake_dae.blocks.computations import PARAMETERS, Block, Computation, Update, zero
from drake_dae.blocks.lifetime import SHARED_DICTIONARY, port_value
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.errors import ModelError
from drake_dae.systems.blocks.block import NO_TIME_DERIVATIVE, ParameterizedSystem
from drake_dae.systems.observing.observed import Observed
from drake_dae.systems.observing.observer_rates import Observing


class ObservingSystem(ParameterizedSystem):
    """A sampled observer of a law's disturbance and coefficients of friction.

    Args:
        law: The law.
        observing: The rates, and the thresholds for friction.
        sample_period: T in s.
        control_lag: The fraction of T for which the plant uses the previous control, from 0 to 1.
        control_delay: tau in s, the mean time from a sample until its control acts.

    Attributes:
        observing, sample_period: The arguments.
        observation: The observed functions.
        disturbance_signals, friction_signals: Names and units of the output ports.

    Raises:
        ModelError: A number is not valid.
    """

    __slots__ = SHARED_DICTIONARY
    no_gradient = NO_TIME_DERIVATIVE

    def __init__(
        self,
        law: TrackingLaw,
        observing: Observing,
        sample_period: float,
        control_lag: float,
        control_delay: float,
    ) -> None:
        system = law.system
        signals = {
            "state": system.state_signals,
            "control": system.control_signals,
            "constraint_input": system.constraint_input_signals,
        }
        super().__init__(system, system.parameter_values, signals, sees_steps=False)
        self.observing, self.sample_period = observing, positive("sample_period", sample_period)
        if not 0.0 <= control_lag <= 1.0:
            raise ModelError(f"control_lag must be from 0 to 1, got {control_lag:g}")
        if not control_delay >= 0.0:
            raise ModelError(f"control_delay must be 0 s or more, got {control_delay:g} s")

    def _declare(
        self, law: TrackingLaw, functions: Observed, state: str, start: FloatArray
    ) -> None:
        """Declares input ports and the discrete state.

        Args:
            law: The law.
            functions: The functions of the observer.
            state: The name of the port of the state.
            start: The discrete state before the first sample, with zeros for friction at `_mu`.
        """
        system, self._observed = law.system, functions
        self.observation = observation = functions.observation
        names = list(observation.frictions)
        self.disturbance_signals = tuple(
            Signal(f"disturbance of {system.state_signals[i].name}") for i in observation.rows
        )
        self.friction_signals = tuple(Signal(name) for name in names)
        sizes = {
            state: system.num_states,
            "control": system.num_controls,
            "hold": 1,
            "reference": law.layout.reference_size,
        }
        if self._measures:
            sizes["measured_force"] = system.num_constraints
        self._ports = {name: self.DeclareVectorInputPort(name, n) for name, n in sizes.items()}
        for j, name in enumerate(names, self._mu.start):
            start[j : j + 1] = system.parameter_values[system.parameter_slice(name)]
        self._held = self.DeclareDiscreteState(start)

    def _declare_hold(self, force: DependencyTicket) -> None:
        """Declares the output port `hold`, which depends on the force."""
        tickets = {force, self.input_port_ticket(self._ports["hold"].get_index())}
        self.DeclareVectorOutputPort("hold", 1, port_value(self._hold_output), tickets)

    @property
    def _measures(self) -> bool:
        """Whether the constraint force comes from a sensor."""
        return True

    def _force(self, context: Context) -> FloatArray:
        """The constraint force."""
        return np.asarray(self._ports["measured_force"].Eval(context))

    @property
    def _mu(self) -> slice:
        """The part of the discrete state that is mu."""
        raise NotImplementedError

    @property
    def further_signals(self) -> dict[str, Sequence[Signal]]:
        """Name of an output port in a record -> names and units of its entries."""
        ports = {"disturbance": self.disturbance_signals, "friction": self.friction_signals}
        return {name: signals for name, signals in ports.items() if signals}

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
        values = context.get_discrete_state(self._held).CopyToVector()
        values[self._mu] = given
        context.SetDiscreteState(self._held, values)

    def _inputs(self, context: Context, *names: str) -> list[FloatArray]:
        """The values of input ports."""
        return [self._ports[name].Eval(context) for name in names]

    def _held_up(self, context: Context) -> FloatArray:
        """The input port `hold`; 0 without a wire."""
        port = self._ports["hold"]
        return np.asarray(port.Eval(context)) if port.HasValue(context) else np.zeros(1)

    def _reference(self, context: Context, state: FloatArray) -> FloatArray:
        """The input port `reference`; without a wire the current rates."""
        port = self._ports["reference"]
        if port.HasValue(context):
            return np.asarray(port.Eval(context))
        return self._checked(self.observation.moving, context, state)[0].copy()

    def _hold_output(self, context: Context) -> FloatArray:
        return self._observed.hold.evaluate(self._force(context), self._held_up(context))[0]

    def _block(
        self,
        computations: Sequence[Computation],
        sample: Computation,
        force: str = "measured_force",
    ) -> Block:
        """The observer with some computations, and the update of its state at samples.

        Args:
            computations: All computations except that of the port `hold`.
            sample: The computation of its state after a sample.
            force: The source of the constraint force.
        """
        rates = self.observation.moving, ("estimated_state", PARAMETERS), ("reference",)
        return Block(
            self,
            (*computations, Computation.of(self._observed.hold, (force, "hold"), ("hold",))),
            (Update(sample, self.sample_period, is_unrestricted=True),),
            unwired={
                "hold": zero("hold"),
                "reference": Computation.of(*rates),
            },
            signals=self._signals,
            ports={"disturbance": self.disturbance_signals, "friction": self.friction_signals},
        )
