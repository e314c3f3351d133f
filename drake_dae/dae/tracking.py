"""The tracking law.                                                        (28), (29)"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, listed
from drake_dae.dae.gains import FeedbackGains, GainDesign, designed
from drake_dae.dae.law_model import Deflection, ForceMeasurement, IntegralAction, law_structure
from drake_dae.dae.signals import DerivativeLayout, Signal
from drake_dae.dae.structure import Structure, find_structure, structure_of
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import GainError, ModelError
from drake_dae.trace.functions import TracedFunction


@checked(ModelError)
class TrackingLaw:
    """The tracking law (28), which makes the controlled outputs follow a reference:

        u(x, R) = B(x)^-1 (-a(x) + ubar),
        ubar_i = r_i^(mu_i) - sum_j K_ij (L_f*^(j-1) l*_i - r_i^(j-1)),

    with ubar_i = r_i where mu_i = 0. In closed loop the errors e_i = z_i - r_i (29) obey (30), (31)
    exactly. If there are more controls than outputs, the system's `control_metric` chooses u. The
    law needs the state x, but no measurement of the constraint inputs.

    The reference is output-major: r_1, r_1', ..., r_1^(mu_1), r_2, ...; it holds sum (mu_i + 1)
    numbers; with a `contact_stiffness` two more for each force.

    Args:
        system: The system (1)-(3).
        gains: A design such as `poles(-4.0)`, or finished gains.
        structure: The structure of the system; found if None.
        measured_force: Whether the law takes a measurement of v: see `ForceMeasurement`.
        force_gain: Gbar of (59) for the outputs with mu_i = 0, 0 or more; only with measured_force.
        constraint_damping: Damping of constraints that the plant may violate, such as a compliant
            contact: a design such as `poles(-200.0)`, with r_i - 1 poles of phi': see
            `law_structure`.
        contact_stiffness: k in N/m of compliant contacts, F = -k phi, for references of forces that
            change fast: see `Deflection`.
        integral: The names of the outputs whose errors are integrated as well, positions or
            measured forces: see `IntegralAction`. They have one more pole.
        latency: The mean time in s from the measurement of x to the moment when its control acts,
            for a sampled law delay + period / 2, and half a step more of a stepped plant, whose
            step counts whole without sampling: by it damping is compensated: see `acting_late`.

    `function` is the law as (state, reference, measured_force, integral, parameters) -> control,
    tracking_error, integral_rate, as far as it has them; `outputs` are these as expressions of
    `inputs`, and `pivot` is 0 where the matrix that `regular` names is singular.

    Raises:
        AssumptionError: The system violates an assumption of the theory.
        GainError: The gains do not fit, or are not Hurwitz.
        ModelError: The structure is that of another system, or no output is a constraint input.
    """

    def __init__(
        self,
        system: DaeSystem,
        gains: GainDesign | FeedbackGains,
        *,
        structure: Structure | None = None,
        measured_force: bool = False,
        force_gain: float = 0.0,
        constraint_damping: GainDesign | FeedbackGains | None = None,
        integral: Sequence[str] = (),
        contact_stiffness: float | None = None,
        latency: float = 0.0,
    ) -> None:
        self.structure = structure_of(system, structure, find_structure)
        self.system, self.latency = system, float(latency)
        self.deflection, more = None, tuple[int, ...]()
        if contact_stiffness is not None:
            self.deflection = Deflection(self.structure, contact_stiffness, constraint_damping)
            more = tuple(2 * (i in self.deflection.inputs) for i in range(system.num_outputs))
        self._law_structure = law_structure(
            self.structure, constraint_damping, latency, self.deflection
        )
        self.layout = DerivativeLayout(self.structure.output_degrees, more)
        self.reference_signals = self.layout.reference_signals(system.output_signals)
        if force_gain and not measured_force:
            raise GainError("force_gain needs measured_force=True")
        self.measured_force: ForceMeasurement | None = None
        if measured_force:
            self.measured_force = ForceMeasurement(system, self.layout, force_gain)
        self.integral = IntegralAction(system, self.degrees, integral, self.measured_force)
        self.gains = self.design(gains)
        self.function = self._trace()

    def __repr__(self) -> str:
        outputs = listed(signal.name for signal in self.system.output_signals)
        return f"TrackingLaw('{self.system.name}', outputs={outputs}, degrees={list(self.degrees)})"

    def _trace(self) -> TracedFunction:
        """The law (28) and the tracking error (29) as one function."""
        structure, layout, measured = self._law_structure, self.layout, self.measured_force
        reference = ca.SX.sym("R", layout.reference_size)
        # Symbols only for nonzero entries of K: the errors of most outputs are not coupled.
        gain = ca.SX.sym("K", ca.sparsify(ca.DM(self.gains.matrix)).sparsity())
        values = reference[layout.lowest.tolist(), :]
        highest = reference[layout.highest.tolist(), :]
        own = chain = self._deflected(structure.chain, reference)
        inputs = {"reference": reference}
        if measured:
            chain, highest = measured.chain(chain), measured.highest(highest, values)
            inputs["measured_force"] = measured.symbol
        errors = chain - reference[layout.chained.tolist(), :]
        ubar = highest - ca.mtimes(gain, self.integral.coordinates(errors))  # (28)
        control, pivot = structure.control_for(ubar)
        control = self._deflected(control, reference)
        # By the model; outputs with direct feedthrough have their reference values.
        output = ca.SX(ubar)
        output[layout.dynamic.tolist(), :] = own[layout.heads.tolist(), :]
        self.exogenous_degrees = self.system.exogenous.degrees(control, output)
        outputs = {"control": control, "tracking_error": output - values}  # (29)
        if self.integral.outputs:
            inputs["integral"] = self.integral.symbol
            outputs["integral_rate"] = self.integral.rate(chain, values)
        # The initial value of (30).
        start = self.integral.coordinates(own - reference[layout.chained.tolist(), :])
        names = {"reference": reference, "integral": self.integral.symbol}
        self.coordinates_function = self.system.trace(
            "error coordinates", {"coordinates": start}, names, often=False
        )
        parameters = ca.vertcat(self.system.parameter_symbol, *gain.nonzeros())
        self._ubar, self.outputs, self.pivot = ubar, outputs, pivot
        #: Name -> symbol of each input of `function`.
        self.inputs = {"state": self.system.state, **inputs, "parameters": parameters}
        self.regular = (
            f"A(x) or B(x) of Assumptions (2), (5) for the outputs {', '.join(self.gains.names)}"
        )
        name, compiled = f"{self.system.name} tracking law", self.system.compiled
        return TracedFunction(name, self.inputs, outputs, pivot, self.regular, compiled=compiled)

    def _deflected(self, expression: ca.SX, reference: ca.SX) -> ca.SX:
        if self.deflection is None:
            return expression
        wanted = self.deflection.wanted(reference, self.layout)
        return ca.substitute(expression, self.deflection.symbol, wanted)

    def trace_motion(self) -> TracedFunction | None:
        """Traces x' and v of a plant that equals the law's model, under the law."""
        if self._law_structure is not self.structure:
            return None
        system, motion = self.system, self.structure.derivatives
        # With more controls than outputs, and where friction may leave the motion undetermined.
        if system.control_metric is not None or system.frictional_contacts:
            return None
        shown = ca.vertcat(motion.rate, motion.constraint_input)
        solution = motion.inverse(self.structure.highest_derivatives, self._ubar, shown)
        if solution is None:
            return None
        rate, force = ca.vertsplit(solution[2], [0, system.num_states, shown.numel()])
        outputs, name = {"rate": rate, "force": force}, f"{system.name} under its law"
        return TracedFunction(name, self.inputs, outputs, solution[1], often=False)

    @property
    def degrees(self) -> tuple[int, ...]:
        """mu_1, ..., mu_p: the number of derivatives of each reference that the law needs."""
        return self.layout.degrees

    def design(self, gains: GainDesign | FeedbackGains) -> FeedbackGains:
        """Checks gains, or designs them, for the outputs of this law."""
        names = tuple(signal.name for signal in self.system.output_signals)
        more = [i in self.integral.outputs for i in range(len(names))]  # A pole each.
        degrees = tuple(degree + own for degree, own in zip(self.degrees, more, strict=True))
        return designed("gains", gains, names, degrees)

    def all_parameters(
        self, parameters: ArrayLike | None = None, gains: GainDesign | FeedbackGains | None = None
    ) -> FloatArray:
        """Returns the parameters of `function`: those of the system, then the entries of K.

        The gains are the law's own if None; others must be zero where the law's own are.
        """
        values = self.system.parameter_vector(parameters)
        chosen = self.gains if gains is None else self.design(gains)
        has = self.gains.matrix != 0.0
        if np.any(chosen.matrix[~has]):
            i, j = np.argwhere((chosen.matrix != 0.0) & ~has)[0]
            signals = self.coordinate_signals
            raise GainError(
                f"the law has no gain from the error of {signals[j].name} to "
                f"{self.system.output_signals[i].name}; make a new law with such a gain"
            )
        return np.concatenate([values, chosen.matrix.T[has.T]])

    @property
    def parameter_signals(self) -> list[Signal]:
        """Names and units of the model's parameters, then of the gains, as `all_parameters`."""
        return self.system.parameter_signals + [
            Signal(f"K of {self.system.output_signals[i].name} for {coordinate.name}")
            for j, coordinate in enumerate(self.coordinate_signals)
            for i in np.flatnonzero(self.gains.matrix[:, j])
        ]

    @property
    def coordinate_signals(self) -> list[Signal]:
        """Names and units of the error coordinates."""
        integrals = dict(zip(self.integral.outputs, self.integral.signals, strict=True))
        signals = list[Signal]()
        for i, signal in enumerate(self.system.output_signals):
            signals += [integrals[i]] if i in integrals else []
            signals += [signal.derivative(order) for order in range(self.degrees[i])]
        return signals

    def control(
        self,
        state: ArrayLike,
        reference: ArrayLike,
        *,
        measured_force: ArrayLike | None = None,
        integral: ArrayLike | None = None,
        parameters: ArrayLike | None = None,
    ) -> FloatArray:
        """Returns the control u(x, R) of (28), shape (p,).

        The state has shape (n,), the reference shape (sum (mu_i + 1),), output-major;
        measured_force, shape (m,), is given exactly where the law takes it; the integrals of the
        errors, shape (k,), are zero and the parameters the defaults if None.
        """
        measured = [] if measured_force is None else [measured_force]
        if self.integral.outputs:
            measured.append(np.zeros(len(self.integral.outputs)) if integral is None else integral)
        return self.function(state, reference, *measured, self.all_parameters(parameters))[0]

    def error_coordinates(
        self,
        state: ArrayLike,
        reference: ArrayLike,
        parameters: ArrayLike | None = None,
        integral: ArrayLike | None = None,
    ) -> FloatArray:
        """Returns (e_1, e_1', ..., e_p^(mu_p - 1)), shape (sum mu_i,): the initial value of (30).

        The integral of an error stands before it; the arguments are those of `control`.
        """
        values = self.system.parameter_vector(parameters)
        sigma = np.zeros(len(self.integral.outputs)) if integral is None else integral
        return self.coordinates_function(state, reference, sigma, values)[0]

    def predicted_error(
        self,
        times: ArrayLike,
        state: ArrayLike,
        reference: ArrayLike,
        parameters: ArrayLike | None = None,
        integral: ArrayLike | None = None,
    ) -> FloatArray:
        """Returns the tracking error that the theory predicts at times after a start, shape (k, p).

        The other arguments are those of `control` at the start; times are in s.
        """
        start = self.error_coordinates(state, reference, parameters, integral)
        errors = self.gains.error_response(times, start)
        if self.integral.outputs:  # There the first coordinate is the integral of the error.
            rates = self.gains.error_response(times, self.gains.error_matrix @ start)
            errors[:, self.integral.outputs] = rates[:, self.integral.outputs]
        return errors
