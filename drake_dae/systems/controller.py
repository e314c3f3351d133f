"""The tracking law as a LeafSystem."""

import warnings

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import BasicVector, Context

from drake_dae.arrays import FloatArray
from drake_dae.dae.tracking import TrackingLaw
from drake_dae.dae.zero_dynamics.zero_dynamics import Verdict, ZeroDynamics
from drake_dae.errors import (
    NonFiniteError,
    NonMinimumPhaseWarning,
    SimulationError,
    SingularityError,
)
from drake_dae.systems.block import Formula, ParameterizedSystem, TracedFormula
from drake_dae.trace.functions import SINGULAR_PIVOT


class TrackingController(ParameterizedSystem):
    """The law (28) of any `TrackingLaw`: u = B(x)^-1 (-a(x) + ubar(x, R)).

    Input ports:
        estimated_state: x, shape (n,).
        reference: R, output-major, r_i, ..., r_i^(mu_i); shape (sum (mu_i + 1),).
        measured_force: Constraint force from a sensor, shape (m,); if the law takes it.

    Output ports:
        control: u, shape (p,).
        tracking_error: e = z - r (29) by the controller's own model, shape (p,).

    Both outputs feed through from all inputs. The context holds the model's parameters and then
    the gains K (its nonzeros, column by column) as one numeric parameter. Converts to AutoDiffXd.

    Args:
        law: The law.
        outputs: At which its zero dynamics are judged, shape (p,); see `ZeroDynamics.stability`.

    Warns:
        NonMinimumPhaseWarning: The zero dynamics (35) are unstable about that equilibrium.

    Raises:
        SingularityError, NonFiniteError: During a simulation, with time and state.
    """

    def __init__(self, law: TrackingLaw, outputs: ArrayLike | None = None) -> None:
        super().__init__(law.system, law.parameter_values())
        if law.structure.zero_dynamics_dimension:
            dynamics = ZeroDynamics(law.structure)
            stability = dynamics.stability(law.structure.states[0], outputs=outputs)
            if stability.verdict is Verdict.UNSTABLE:
                warnings.warn(
                    f"{law.system.name}: {stability.reason}. The outputs follow the reference "
                    "while other states, or the control, run off; choose other outputs",
                    NonMinimumPhaseWarning,
                    stacklevel=2,
                )
        self.law = law
        self.set_name("tracking_controller")
        dae = law.system
        sizes = {"estimated_state": dae.num_states, "reference": len(law.reference_signals)}
        if law.measured_force:
            sizes["measured_force"] = dae.num_constraints
        self._input_ports = [self.DeclareVectorInputPort(*item) for item in sizes.items()]
        sources = {self.all_input_ports_ticket(), self.all_parameters_ticket()}
        self.DeclareVectorOutputPort("control", dae.num_controls, self._calc_control, sources)
        self.DeclareVectorOutputPort(
            "tracking_error", dae.num_controls, self._calc_tracking_error, sources
        )

    def _calc_control(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._evaluate(context)[0])

    def _calc_tracking_error(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._evaluate(context)[1])

    def _evaluate(self, context: Context) -> tuple[FloatArray, ...]:
        function = self.law.function
        arguments = [port.Eval(context) for port in self._input_ports]
        arguments.append(context.get_numeric_parameter(0).value())
        values = function.evaluate(*arguments)
        if function.is_finite and values[2][0] >= SINGULAR_PIVOT:
            return values
        raise self._failure(context.get_time(), *arguments)

    def _failure(self, time: float, state: FloatArray, *others: FloatArray) -> SimulationError:
        where = f"at t = {time:.6g} s, state {np.array2string(state, precision=4, separator=', ')}"
        inputs = (state, *others[:-1])  # The last are the parameters.
        bad = [
            port.get_name()
            for port, value in zip(self._input_ports, inputs, strict=True)
            if not np.all(np.isfinite(value))
        ]
        if bad:
            return NonFiniteError(
                f"the controller's input {', '.join(bad)} is not finite {where}", time, state
            )
        return SingularityError(
            f"A(x) or B(x) of Assumptions (2), (5) is singular {where}: the outputs "
            f"{', '.join(s.name for s in self.law.system.output_signals)} cannot be steered "
            "independently there. Keep the reference away from it, or choose other outputs",
            time,
            state,
        )

    def _formulas(self) -> dict[str, Formula]:
        function = self.law.function
        sources = ["estimated_state", *function.input_names[1:]]
        return {
            name: TracedFormula(function, name, sources, self._failure)
            for name in ("control", "tracking_error")
        }
