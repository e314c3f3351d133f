"""The tracking law as a LeafSystem."""

import warnings

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import BasicVector, Context

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.dae.gains import FeedbackGains, GainDesign
from drake_dae.dae.tracking import TrackingLaw
from drake_dae.dae.zero_dynamics.stability import Verdict
from drake_dae.dae.zero_dynamics.zero_dynamics import ZeroDynamics
from drake_dae.errors import ModelError, NonMinimumPhaseWarning
from drake_dae.systems.block import ParameterizedSystem
from drake_dae.systems.formulas import Formula, TracedFormula
from drake_dae.systems.lifetime import SHARED_DICTIONARY, weakly


@checked(ModelError)
class TrackingController(ParameterizedSystem):
    """The law (28) of any `TrackingLaw`: u = B(x)^-1 (-a(x) + ubar(x, R)).

    Input ports:
        estimated_state: x, shape (n,).
        reference: R, output-major, r_i, ..., r_i^(mu_i); shape (sum (mu_i + 1),).
        measured_force: The constraint force from a sensor, shape (m,); if the law takes it.
        exogenous: The signals w with their derivatives, if the system has any; see
            `ParameterizedSystem`.

    Output ports:
        control: u, shape (p,).
        tracking_error: e = z - r (29) by the controller's own model, one entry per output.

    Both output ports have direct feedthrough from all input ports. The context holds the model's
    parameters and then the gains as one numeric parameter; see `set_parameter` and `set_gains`.
    The block converts to AutoDiffXd.

    Args:
        law: The law.
        outputs: z at which its zero dynamics are judged, shape (p,); see `ZeroDynamics.stability`.

    Warns:
        NonMinimumPhaseWarning: The zero dynamics (35) are unstable about that equilibrium.

    Raises:
        SingularityError: A(x) or B(x) is singular on the way; the exception has time and state.
        NonFiniteError: A value is not finite on the way, likewise.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(self, law: TrackingLaw, outputs: ArrayLike | None = None) -> None:
        dae = law.system
        signals = {
            "state": dae.state_signals,
            "reference": law.reference_signals,
            "measured_force": dae.constraint_input_signals,
        }
        super().__init__(dae, law.all_parameters(), signals)
        _warn_of_zero_dynamics(law, outputs)
        self.law = law
        self.set_name("tracking_controller")
        sizes = {"estimated_state": dae.num_states, "reference": law.layout.reference_size}
        if law.measured_force:
            sizes["measured_force"] = dae.num_constraints
        self._evaluators = [self.DeclareVectorInputPort(*item).Eval for item in sizes.items()]
        self._declare_exogenous(law.exogenous_degrees)
        sources = {self.all_input_ports_ticket(), self.all_parameters_ticket()}
        self.DeclareVectorOutputPort(
            "control", dae.num_controls, weakly(self._calc_control), sources
        )
        self.DeclareVectorOutputPort(
            "tracking_error", dae.num_outputs, weakly(self._calc_tracking_error), sources
        )

    def set_gains(self, context: Context, gains: GainDesign | FeedbackGains) -> None:
        """Changes the gains in a context.

        Args:
            context: The context of this system.
            gains: A design such as `poles(-8.0)`, or finished gains.

        Raises:
            GainError: The gains do not fit, are not Hurwitz, or couple outputs that the law does
                not.
        """
        values = self.law.all_parameters(self.parameters(context), gains)
        context.get_mutable_numeric_parameter(0).SetFromVector(values)

    def all_parameters(self, context: Context) -> FloatArray:
        """What the law's function takes as parameters: the model's at the context's time, and K."""
        self.check_context(context)
        return np.array(self._values(context))

    def _calc_control(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._evaluate(context)[0])

    def _calc_tracking_error(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._evaluate(context)[1])

    def _evaluate(self, context: Context) -> tuple[FloatArray, ...]:
        inputs = [evaluate(context) for evaluate in self._evaluators]
        return self._checked(self.law.function, context, *inputs)

    def _formulas(self) -> dict[str, Formula]:
        function = self.law.function
        sources = ["estimated_state", *function.input_names[1:]]
        return {
            name: TracedFormula(function, name, sources, self._signals)
            for name in ("control", "tracking_error")
        }


def _warn_of_zero_dynamics(law: TrackingLaw, outputs: ArrayLike | None) -> None:
    if not law.structure.zero_dynamics_dimension:
        return
    dynamics = ZeroDynamics(law.system, structure=law.structure)
    stability = dynamics.stability(law.structure.states[0], outputs=outputs)
    if stability.verdict is Verdict.UNSTABLE:
        warnings.warn(
            f"{law.system.name}: {stability.reason}. The outputs follow the reference "
            "while other states, or the control, run off; choose other outputs",
            NonMinimumPhaseWarning,
            stacklevel=3,
        )
