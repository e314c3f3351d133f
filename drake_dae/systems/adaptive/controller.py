"""The adaptive law as a LeafSystem."""

from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import BasicVector, Context, ContinuousState, EventStatus, State

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, vector
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.tracking.gains import FeedbackGains, GainDesign, poles
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.errors import ModelError, WiringError
from drake_dae.systems.adaptive.law import AdaptiveLaw
from drake_dae.systems.blocks.block import ParameterizedSystem
from drake_dae.systems.blocks.formulas import Formula, TracedFormula
from drake_dae.systems.blocks.lifetime import SHARED_DICTIONARY, weakly
from drake_dae.systems.blocks.traced import (
    DERIVATIVE,
    HELD,
    PARAMETERS,
    STATE,
    Block,
    Computation,
    Update,
    zero,
)
from drake_dae.systems.blocks.trials import state_tickets
from drake_dae.systems.control.contract import Controller, Derived, output_errors
from drake_dae.systems.plants.contract import Plant
from drake_dae.trace.functions import TracedFunction

_REFUSED = {
    "observer": "an adaptive law and an observer would both compensate the same model error; take "
    "one of them",
    "governed": "a governor plans with the parameters of the model, which an adaptive law does not "
    "know yet",
}
"""The settings of a loop that it does not support, each with the reason."""


@checked(ModelError)
class AdaptiveController(ParameterizedSystem, Controller):
    """An `AdaptiveLaw` with its estimates as state; that class has the equations and the proof.

    Input ports:
        estimated_state: x = (q, v), shape (n,).
        reference: R, as for a `TrackingLaw` of the same system.
        measured_force: lambda from a sensor, shape (m,); with a force_rate. It is only integrated.
        hold: While it is not 0, estimates and integrals are not updated, shape (1,), for example
            while a drive is at its limit. Without a wire it is 0.

    Output ports:
        control: u, shape (p,).
        parameter_estimate: theta^, shape (k,). It starts at the model's values, or at those of
            `set_estimate`.
        sliding: s, shape (nv,).
        force_integral: zeta, shape (m,); with a force_rate.
        tracking_error: e of the positions by the model, and 0 for forces, shape (p,).

    Numeric parameter 0 has all parameters of the model; the adapted ones are used only for M_0 of
    the damping. With a sample period the estimates are held between samples and change by T theta^'
    at each, and the block does not convert to AutoDiffXd.

    `predicted_error` is e(0) exp(-L t), that of exact parameters and s = 0 at the start. With other
    values only the bound by V holds.

    Args:
        adaptive: The law.
        sample_period: T in s; 0 for continuous estimates.

    Raises:
        ModelError: The period is not valid.
        SingularityError: The outputs' rates and J are dependent during a run.
        NonFiniteError: A value is not finite during a run.
    """

    __slots__ = SHARED_DICTIONARY
    shown = ("tracking_error",)
    refused = _REFUSED

    def __init__(self, adaptive: AdaptiveLaw, sample_period: float = 0.0) -> None:
        dae = adaptive.model.dae
        signals: dict[str, Sequence[Signal]] = {
            "state": dae.state_signals,
            "reference": adaptive.layout.reference_signals(dae.output_signals),
            "measured_force": dae.constraint_input_signals,
            "memory": (*adaptive.signals, *adaptive.force_signals),
        }
        super().__init__(dae, dae.parameter_values, signals)
        if not sample_period >= 0.0:
            raise ModelError(f"sample_period must be 0 s or more, got {sample_period:g} s")
        self.adaptive, self.sample_period = adaptive, sample_period
        self.law = TrackingLaw(
            dae,
            poles(-adaptive.rate),
            structure=adaptive.structure,
            measured_force=bool(adaptive.force_rate),
        )
        self.set_name("adaptive_controller")
        sizes = {"estimated_state": dae.num_states, "reference": adaptive.layout.reference_size}
        ports = [self.DeclareVectorInputPort(*item) for item in sizes.items()]
        self._read = [port.Eval for port in ports]
        self._force = []
        if adaptive.force_rate:
            force = self.DeclareVectorInputPort("measured_force", dae.num_constraints)
            self._force = [force.Eval]
        self._hold = self.DeclareVectorInputPort("hold", 1)
        start = BasicVector(adaptive.start)
        if sample_period:
            self.DeclareDiscreteState(start)
            # Unrestricted, as the step of a discrete MultibodyPlant, so that both see one instant.
            self.DeclarePeriodicUnrestrictedUpdateEvent(sample_period, 0.0, weakly(self._sample))
            by_state = {self.xd_ticket()}
        else:
            self.DeclareContinuousState(start)
            by_state = state_tickets(self)
        sources = {self.input_port_ticket(port.get_index()) for port in ports}
        sources |= by_state | {self.all_parameters_ticket()}
        for place, (name, size) in enumerate(
            {
                "control": dae.num_controls,
                "tracking_error": dae.num_outputs,
                "sliding": adaptive.model.links.v.numel(),
            }.items()
        ):
            self.DeclareVectorOutputPort(name, size, weakly(self._calc, place), sources)
        count, forces = len(adaptive.signals), len(adaptive.force_signals)
        self._parts = {"parameter_estimate": slice(0, count)}
        if forces:
            self._parts["force_integral"] = slice(count, count + forces)
        for name, part in self._parts.items():
            size = part.stop - part.start
            self.DeclareVectorOutputPort(name, size, weakly(self._copy, part), by_state)

    @property
    def further_signals(self) -> Mapping[str, Sequence[Signal]]:
        law = self.adaptive
        speeds = law.model.links.velocity_signals
        signals: dict[str, Sequence[Signal]] = {
            "parameter_estimate": law.signals,
            "sliding": [Signal(f"sliding of {speed.name}", speed.unit) for speed in speeds],
        }
        return {**signals, **({"force_integral": law.force_signals} if law.force_rate else {})}

    def set_estimate(self, context: Context, theta: ArrayLike) -> None:
        """Sets the estimates at the start, and integrals of the force to 0.

        Args:
            context: The context of this system.
            theta: theta^, shape (k,).

        Raises:
            ModelError: The shape is wrong.
        """
        self.check_context(context)
        values = self.adaptive.memory(vector("theta", theta, len(self.adaptive.signals)))
        if self.sample_period:
            context.SetDiscreteState(values)
        else:
            context.SetContinuousState(values)

    def all_parameters(self, context: Context) -> FloatArray:
        return self.law.all_parameters(self.parameters(context))

    def parameters_along(self, context: Context, times: ArrayLike) -> FloatArray:
        values = super().parameters_along(context, times)
        gains = self.law.all_parameters()[values.shape[1] :]
        return np.hstack([values, np.tile(gains, (values.shape[0], 1))])

    def set_gains(self, context: Context, gains: GainDesign | FeedbackGains) -> None:
        if not np.array_equal(self.law.design(gains).matrix, self.law.gains.matrix):
            super().set_gains(context, gains)

    def check_plant(self, plant: Plant) -> None:
        super().check_plant(plant)
        if plant.contacts:
            names = ", ".join(plant.contacts)
            raise WiringError(
                f"an adaptive law is for contacts that stay closed, and {names} may open: take a "
                "plant whose contacts do not open, or a tracking law"
            )

    def derived(
        self, context: Context | None, times: FloatArray, values: Mapping[str, FloatArray]
    ) -> Derived:
        """`desired_output` r and `tracking_error` z - r, from "reference" and z."""
        return output_errors(self.law, values)

    def predicted_error(
        self, times: FloatArray, values: Mapping[str, FloatArray], parameters: FloatArray
    ) -> FloatArray:
        desired = values["reference"][0, self.law.layout.lowest]
        start = values["controlled_output"][0] - desired
        start[self.law.layout.direct] = 0.0
        decay = np.exp(-self.adaptive.rate * (np.asarray(times) - times[0]))
        return decay[:, None] * start

    def _memory(self, context: Context) -> FloatArray:
        if self.sample_period:
            return context.get_discrete_state(0).CopyToVector()
        return context.get_continuous_state_vector().CopyToVector()

    def _calc(self, index: int, context: Context, output: BasicVector) -> None:
        inputs = [read(context) for read in self._read]
        values = self._checked(self.adaptive.function, context, *inputs, self._memory(context))
        output.SetFromVector(values[index])

    def _copy(self, part: slice, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._memory(context)[part])

    def _rate(self, context: Context) -> FloatArray:
        inputs = [read(context) for read in (*self._read, *self._force)]
        memory = self._memory(context)
        rate = self._checked(self.adaptive.rates, context, *inputs, memory)[0]
        if self._hold.HasValue(context) and self._hold.Eval(context)[0] != 0.0:
            return 0.0 * memory
        return rate

    def _sample(self, context: Context, state: State) -> EventStatus:
        after = self._memory(context) + self.sample_period * self._rate(context)
        state.get_mutable_discrete_state().set_value(0, after)
        return EventStatus.Succeeded()

    def DoCalcTimeDerivatives(self, context: Context, derivatives: ContinuousState) -> None:
        if not self.sample_period:
            derivatives.get_mutable_vector().SetFromVector(self._rate(context))

    def traced(self) -> Block:
        law, memory = self.adaptive, HELD if self.sample_period else STATE
        read, last = ("estimated_state", "reference"), (memory, PARAMETERS)
        force = ("measured_force",) if law.force_rate else ()
        size = law.start.size
        held, rate, hold = ca.SX.sym("memory", size), ca.SX.sym("rate", size), ca.SX.sym("hold", 1)
        moves = ca.if_else(hold != 0, 0, rate)
        after = held + self.sample_period * moves if self.sample_period else moves
        shown = [held[part] for part in self._parts.values()]
        moved = Computation(
            ca.Function("adapted", [rate, held, hold], [after]),
            ("memory_rate", memory, "hold"),
            (memory if self.sample_period else DERIVATIVE,),
        )
        computations = [
            Computation.of(law.function, (*read, *last), ("control", "tracking_error", "sliding")),
            Computation.of(law.rates, (*read, *force, *last), ("memory_rate",)),
            Computation(ca.Function("shown", [held], shown), (memory,), tuple(self._parts)),
        ]

        updates: tuple[Update, ...] = ()
        if self.sample_period:
            updates = (Update(moved, self.sample_period, 0.0, True),)
        else:
            computations.append(moved)
        return Block(
            self,
            tuple(computations),
            updates,
            unwired={"hold": zero("hold")},
            model=self.dae,
            signals=self._signals,
            ports={
                "control": tuple(self.dae.control_signals),
                **{name: tuple(signals) for name, signals in self.further_signals.items()},
            },
        )

    def _formulas(self) -> dict[str, Formula]:
        law = self.adaptive
        if self.sample_period:
            raise ModelError(
                f"{self.get_name()} does not convert to AutoDiffXd: its estimates are sampled, and "
                "a sample has no derivative by the time. Give it no sample_period"
            )
        named = {"state": "estimated_state", "memory": "state"}

        def formula(function: TracedFunction, output: str) -> Formula:
            sources = [named.get(name, name) for name in function.input_names]
            return TracedFormula(function, output, sources, self._signals)

        formulas = {name: formula(law.function, name) for name in law.function.output_names}
        formulas["derivative"] = formula(law.rates, "memory_rate")
        memory = ca.SX.sym("memory", law.start.size)
        for name, part in self._parts.items():
            function = TracedFunction(name, {"state": memory}, {"value": memory[part]})
            formulas[name] = TracedFormula(function)
        return formulas
