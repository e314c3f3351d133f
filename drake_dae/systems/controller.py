"""The tracking law as a LeafSystem."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context

from drake_dae.dae.tracking import TrackingLaw
from drake_dae.errors import FloatArray, NonFiniteError, SingularityError
from drake_dae.systems.parameters import ParameterizedSystem
from drake_dae.systems.plant import SINGULAR


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
    the gains K (its nonzeros, column by column) as one numeric parameter.

    Raises:
        SingularityError, NonFiniteError: During a simulation, with time and state.
    """

    def __init__(self, law: TrackingLaw) -> None:
        super().__init__(law.system, law.parameter_values())
        self.law = law
        self.set_name("tracking_controller")
        dae = law.system
        self._state_port = self.DeclareVectorInputPort("estimated_state", dae.num_states)
        self._reference_port = self.DeclareVectorInputPort("reference", len(law.reference_signals))
        self._measured_ports = []
        if law.measured_force:
            self._measured_ports = [
                self.DeclareVectorInputPort("measured_force", dae.num_constraints)
            ]
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
        state = self._state_port.Eval(context)
        values = function.evaluate(
            state,
            self._reference_port.Eval(context),
            *[port.Eval(context) for port in self._measured_ports],
            context.get_numeric_parameter(0).value(),
        )
        if function.is_finite and values[2][0] >= SINGULAR:
            return values
        time = context.get_time()
        where = f"at t = {time:.6g} s, state {np.array2string(state, precision=4, separator=', ')}"
        ports = [self._state_port, self._reference_port, *self._measured_ports]
        bad = [port.get_name() for port in ports if not np.all(np.isfinite(port.Eval(context)))]
        if bad:
            raise NonFiniteError(
                f"the controller's input {', '.join(bad)} is not finite {where}", time, state
            )
        raise SingularityError(
            f"A(x) or B(x) of Assumptions (2), (5) is singular {where}: the outputs "
            f"{', '.join(s.name for s in self.law.system.output_signals)} cannot be steered "
            "independently there. Keep the reference away from it, or choose other outputs",
            time,
            state,
        )
