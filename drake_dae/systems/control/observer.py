"""An observer of model errors: a disturbance, and coefficients of friction."""

from collections.abc import Sequence

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import BasicVector, Context, EventStatus, State

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, numbers, positive
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.errors import ModelError
from drake_dae.systems.blocks.block import ParameterizedSystem
from drake_dae.systems.blocks.formulas import Formula
from drake_dae.systems.blocks.lifetime import SHARED_DICTIONARY, weakly
from drake_dae.systems.blocks.traced import HELD, PARAMETERS, Block, Computation, Update
from drake_dae.systems.control.observer_functions import ObserverFunctions
from drake_dae.systems.control.observer_rates import Observing

_READ = ("estimated_state", "measured_force", "reference")


@checked(ModelError)
class DisturbanceObserver(ParameterizedSystem):
    """Observes the disturbance d of E x' = f + S d + g v + h u, and identifies friction.

    With the momentum p = S^T E x a sample of d is, for samples T apart,

        d_k = (p_k - p_(k-1)) / T - mean((S^T E)' x + S^T f) - S^T (h u + g v),

    whose low-pass r with the rate k_o is the estimate; its part along the constrained directions
    has the rate k_n. A constant d is reached as 1 - e^(-k_o t); velocity noise n leaves noise of
    about k_o M n in r. With flexible joints or motors the law needs derivatives of r: then r is
    the output of several lags in series, see `Lags`. With c = S^T dg/dmu v, friction takes its
    share of r,

        mu' = k_f (c . r) / (c . c),    r' = k_o (d - r) - c mu',

    so that r + c mu follows d with the rate k_o for any k_f, without a jump when the share moves.

    Input ports:
        estimated_state: x, shape (n,).
        control: The applied u, shape (p,).
        measured_force: v, shape (m,).
        hold: Not 0 while a drive is at its limit, shape (1,); 0 without a wire. Then mu is not
            updated; r is, since it depends on the applied u.
        reference: R, as that of the controller; may be without a wire.

    Output ports:
        exogenous: The disturbance to compensate, and mu, each with the derivatives that the law
            needs, for the port of a `TrackingController` with the same law.
        disturbance: r, shape (k,).
        friction: mu, shape (c,).
        hold: 1 while the input `hold` is not 0 or a frictional contact is lost, else 0, shape (1,):
            for the integrals of the controller.

    `disturbance` and `friction` are held between samples; r starts at 0, and mu at the model's
    coefficients.

    Args:
        law: The law, for a system that `with_disturbance` made.
        observing: The rates, and the thresholds for friction.
        sample_period: T in s.
        control_lag: The fraction of T for which the plant uses the previous control, from 0 to 1: 1
            for a discrete plant of that step, 0 for a `ControlHold` without delay before a
            continuous plant.
        control_delay: tau in s, the mean time from a sample until its control acts: the delay, and
            half of T, for which it is held.

    Attributes:
        observation: The observed functions.
        observing, sample_period: The arguments.
        disturbance_signals, friction_signals: Names and units of the output ports.

    Raises:
        ModelError: The law's system has no disturbance, or a number is not valid.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(
        self,
        law: TrackingLaw,
        observing: Observing,
        sample_period: float,
        control_lag: float = 0.0,
        control_delay: float = 0.0,
    ) -> None:
        system = law.system
        signals = {
            "state": system.state_signals,
            "control": system.control_signals,
            "constraint_input": system.constraint_input_signals,
        }
        super().__init__(system, system.parameter_values, signals, sees_steps=False)
        self.set_name("disturbance_observer")
        self.observing, self.sample_period = observing, positive("sample_period", sample_period)
        if not 0.0 <= control_lag <= 1.0:
            raise ModelError(f"control_lag must be from 0 to 1, got {control_lag:g}")
        if not control_delay >= 0.0:
            raise ModelError(f"control_delay must be 0 s or more, got {control_delay:g} s")
        self._functions = found = ObserverFunctions(
            law, observing, sample_period, control_lag, control_delay
        )
        self.observation = observation = found.observation
        size, names = len(observation.rows), list(observation.frictions)
        self.disturbance_signals = tuple(
            Signal(f"disturbance of {system.state_signals[i].name}") for i in observation.rows
        )
        self.friction_signals = tuple(Signal(name) for name in names)
        self._mu = slice(size, size + len(names))
        sizes = {
            "estimated_state": system.num_states,
            "control": system.num_controls,
            "measured_force": system.num_constraints,
            "hold": 1,
            "reference": law.layout.reference_size,
        }
        self._ports = {name: self.DeclareVectorInputPort(name, n) for name, n in sizes.items()}
        start = np.zeros(found.memory.column.numel())
        for j, name in enumerate(names, size):
            start[j : j + 1] = system.parameter_values[system.parameter_slice(name)]
        self._held = self.DeclareDiscreteState(start)
        # Unrestricted, as the step of a discrete MultibodyPlant: so all see one instant.
        self.DeclarePeriodicUnrestrictedUpdateEvent(sample_period, 0.0, weakly(self._sample))
        sources = {self.discrete_state_ticket(self._held), self.all_parameters_ticket()}
        for name, calc, count, read in (
            ("exogenous", self._calc_exogenous, found.exogenous.outputs[0].size, _READ),
            ("disturbance", self._calc_disturbance, size, ()),
            ("friction", self._calc_friction, len(names), ()),
            ("hold", self._calc_hold, 1, ("measured_force", "hold")),
        ):
            tickets = {self.input_port_ticket(self._ports[port].get_index()) for port in read}
            self.DeclareVectorOutputPort(name, count, weakly(calc), sources | tickets)

    @property
    def further_signals(self) -> dict[str, Sequence[Signal]]:
        """Name of an output port in a record -> names and units of its entries."""
        known = {"disturbance": self.disturbance_signals, "friction": self.friction_signals}
        return {name: signals for name, signals in known.items() if signals}

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

    def _given(self, context: Context, *names: str) -> list[FloatArray]:
        return [self._ports[name].Eval(context) for name in names]

    def _holds(self, context: Context) -> FloatArray:
        """What the input port `hold` has; 0 without a wire."""
        port = self._ports["hold"]
        return np.asarray(port.Eval(context)) if port.HasValue(context) else np.zeros(1)

    def _sample(self, context: Context, state: State) -> EventStatus:
        x, u, force = self._given(context, "estimated_state", "control", "measured_force")
        held = context.get_discrete_state(self._held).value()
        given = held, u, force, self._holds(context)
        found = self._checked(self._functions.sample, context, x, *given)[0]
        state.get_mutable_discrete_state().set_value(self._held, found)
        return EventStatus.Succeeded()

    def _calc_exogenous(self, context: Context, output: BasicVector) -> None:
        x, force = self._given(context, "estimated_state", "measured_force")
        held, port = context.get_discrete_state(self._held).value(), self._ports["reference"]
        if port.HasValue(context):
            reference = port.Eval(context)
        else:
            (reference,) = self._checked(self.observation.moving, context, x)
        function = self._functions.exogenous
        output.SetFromVector(self._checked(function, context, x, held, force, reference)[0])

    def _calc_disturbance(self, context: Context, output: BasicVector) -> None:
        held = context.get_discrete_state(self._held).value()
        output.SetFromVector(held[: self._mu.start])

    def _calc_friction(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state(self._held).value()[self._mu])

    def _calc_hold(self, context: Context, output: BasicVector) -> None:
        (force,) = self._given(context, "measured_force")
        output.SetFromVector(self._functions.hold.evaluate(force, self._holds(context))[0])

    def _formulas(self) -> dict[str, Formula]:
        raise ModelError(
            f"{self.get_name()} does not convert to AutoDiffXd: it samples, and a sample has no "
            "derivative by the time"
        )

    def traced(self) -> Block:
        functions, memory = self._functions, self._functions.memory
        read = ("estimated_state", HELD)
        needed = (*read, "measured_force", "reference", PARAMETERS)
        sampled = (*read, "control", "measured_force", "hold", PARAMETERS)
        parts = [memory.disturbance, memory.friction]
        shown = ca.Function("shown", [memory.column], parts)
        moving = ("estimated_state", PARAMETERS)
        return Block(
            self,
            (
                Computation.of(functions.exogenous, needed, ("exogenous",)),
                Computation.of(functions.hold, ("measured_force", "hold"), ("hold",)),
                Computation(shown, (HELD,), ("disturbance", "friction")),
            ),
            (
                Update(
                    Computation.of(functions.sample, sampled, (HELD,)),
                    self.sample_period,
                    is_unrestricted=True,
                ),
            ),
            unwired={
                "hold": Computation(ca.Function("none", [], [ca.SX.zeros(1)]), (), ("hold",)),
                "reference": Computation.of(self.observation.moving, moving, ("reference",)),
            },
            signals=self._signals,
            ports={"disturbance": self.disturbance_signals, "friction": self.friction_signals},
        )
