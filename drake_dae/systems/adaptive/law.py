"""An adaptive law for robots with rigid joints in contact, with a proof."""

from collections.abc import Mapping

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, positive, vector
from drake_dae.dae.structure.structure import Structure, structure_of
from drake_dae.dae.system.layout import DerivativeLayout
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError
from drake_dae.robots.model import RobotModel
from drake_dae.systems.adaptive.balance import ForceBalance
from drake_dae.trace.factorization import Factorization
from drake_dae.trace.functions import TracedFunction


@checked(ModelError)
class AdaptiveLaw:
    """A law that adapts parameters of a robot in contact while it tracks, with a proof.

    With rigid joints, M v' = F(q, v) + J^T lambda + B u and J v = 0, where M and F are linear in
    the adapted parameters theta. The desired outputs z_d and the error e = h_1 - z_d define a
    velocity and an acceleration in the tangent space of the constraints,

        T v_r = (z_d' - L e, 0),    T = (dh_1/dq; J),
        T v_r' = (z_d'' - L e', 0) - T' v_r,    s = v - v_r,    so that J s = 0,

    and with W(theta) = M v_r' - C s - F, where C(q, v) has the Christoffel symbols of M, the law is

        u = B^-1 (W(theta^) - K s - J^T S^-1 (z_2d - k_F zeta)),    zeta' = z_2 - z_2d,
        theta^' = -Gamma Y^T s,    Y = dW/dtheta,    K = k M_0(q).

    With theta~ = theta^ - theta and the desired force lambda_c the loop is M s' = Y theta~ -
    (C + K) s + J^T (lambda - lambda_c). Of the function

        V = s^T M s / 2 + theta~^T Gamma^-1 theta~ / 2

    the derivative is, since s^T (M' - 2 C) s = 0 and contact forces have no power on s,

        V' = -s^T K s <= 0.

    So s and theta~ stay bounded by V at the start. If the desired motion is bounded, s goes to 0,
    and so do e, by e' + L e = (dh_1/dq) s, and the rates of the estimates. The estimates converge
    to theta if the motion excites them, that is, if the integral of Y_t^T Y_t grows over each
    period, with the part Y_t of Y in the tangent space. Directions that are not excited do not
    change.

    The force has the error of the model along the normals, lambda - lambda_c = -A^-1 (J M^-1
    (Y theta~ - (C + K) s) + J' s): it goes to zero with theta~ and s, and is bounded otherwise.
    With a measured force, k_F > 0, its error obeys e_F' = -k_F e_F + d', and goes to zero if the
    model error d becomes constant.

    Sources: Slotine and Li, "On the adaptive control of robot manipulators" (1987), for s and Y;
    Arimoto, Liu and Naniwa (1993) and Parra-Vega and Arimoto (1996) for constraints.

    Limits. The plant has exactly this structure, contacts stay closed and frictionless (viscous
    friction may be adapted), and the state is measured. Other effects (other friction, a drive at
    its limit, a compliant contact, for which J s is not 0) add a term to V', and estimates may
    drift in directions that are not excited. Estimates may be temporarily unphysical: the law does
    not invert M. With Coulomb friction of 0.3 on Drake's contact, the mass of the tool of the
    seven-joint wall is estimated as 1.8 kg instead of 1.1, with 43 mm of error. With samples the
    error is of the order of T, and V may rise by the order of T^2.

    Beside a `DisturbanceObserver`: with a link 10 % heavier than known, samples of 1 ms and poles
    at -4 1/s this law leaves 0.05 mm of error, the observer 0.9 mm at 10 1/s and 0.3 mm at 50 1/s.
    Use this law if the errors are in known parameters and the motion excites them, the observer if
    they are not, or change with time.

    Args:
        model: The robot, with rigid joints, as many actuators as coordinates, constraints of
            positions, and all constraint forces among its outputs.
        adapted: Name of a parameter of the model -> its entry of Gamma, positive, in the unit of
            the parameter squared per J.
        rate: L in 1/s, positive.
        damping: k in 1/s, positive; K = k M_0(q) with M of the values of the parameters at the
            start.
        force_rate: k_F in 1/s; 0 without measured force.
        structure: The structure of `model.dae`; found if None.

    Attributes:
        model, adapted, rate, damping, force_rate, structure: The arguments.
        layout: The layout of references, as for a `TrackingLaw`.
        entries: The entries of theta among the parameters.
        signals: Names and units of theta.
        force_signals: Names and units of zeta; empty without measured force.
        function: (state, reference, memory, parameters) -> control, tracking_error and sliding,
            which is s; memory is (theta^, zeta).
        rates: (state, reference, measured_force, memory, parameters) -> memory_rate.
        energy: (state, reference, memory, parameters, theta) -> V and V', of an exact plant.

    Raises:
        AssumptionError: The system violates an assumption of the theory.
        ModelError: A parameter does not enter linearly, constraints or outputs depend on it, or the
            robot does not fit.
    """

    def __init__(
        self,
        model: RobotModel,
        adapted: Mapping[str, float],
        rate: float,
        damping: float,
        force_rate: float = 0.0,
        structure: Structure | None = None,
    ) -> None:
        self.model, self.adapted = model, dict(adapted)
        self.rate, self.damping = positive("rate", rate), positive("damping", damping)
        self.force_rate = positive("force_rate", force_rate) if force_rate else 0.0
        self._balance = balance = ForceBalance(model, tuple(adapted))
        self.structure = structure_of("AdaptiveLaw", model.dae, structure)
        self.layout = DerivativeLayout(self.structure.output_degrees)
        count, forces = balance.num_positions, balance.num_forces
        if self.structure.output_degrees != (2,) * count + (0,) * forces:
            raise ModelError(
                f"{model.name}: an adaptive law needs position outputs of degree 2 and forces of "
                f"degree 0, got {self.structure.output_degrees}"
            )
        self.entries, self.signals = balance.entries, balance.signals
        force_outputs = model.dae.output_signals[count:]
        self.force_signals: tuple[Signal, ...] = ()
        if self.force_rate:
            self.force_signals = tuple(
                Signal(f"integral of {signal.name}", f"{signal.unit} s") for signal in force_outputs
            )
        sizes = [
            balance.parameters[name].value.size * [positive(f"adapted['{name}']", gain)]
            for name, gain in adapted.items()
        ]
        self.gamma: FloatArray = np.array([entry for each in sizes for entry in each])
        self._trace()

    def __repr__(self) -> str:
        return (
            f"AdaptiveLaw('{self.model.name}', adapted={self.adapted}, rate={self.rate:g}, "
            f"damping={self.damping:g}, force_rate={self.force_rate:g})"
        )

    @property
    def start(self) -> FloatArray:
        """(theta^, zeta) at the start: the values of the model's parameters, and zeros."""
        return self.memory(self.model.dae.parameter_values[self.entries])

    def memory(self, theta: ArrayLike) -> FloatArray:
        """(theta^, zeta) of given estimates, shape (k,), without integrals of the force."""
        estimates = vector("theta", theta, len(self.signals))
        return np.concatenate([estimates, np.zeros(len(self.force_signals))])

    def _trace(self) -> None:
        dae, balance, layout = self.model.dae, self._balance, self.layout
        q, v, n = balance.q, balance.v, balance.num_positions
        reference = ca.SX.sym("R", layout.reference_size)
        estimate = ca.SX.sym("estimate", len(self.signals))
        integral = ca.SX.sym("integral", len(self.force_signals))
        memory = ca.vertcat(estimate, integral)

        # The desired motion in the tangent space.
        lowest = layout.lowest.tolist()
        desired, desired_force = reference[lowest[:n], :], reference[lowest[n:], :]
        speed = reference[[i + 1 for i in lowest[:n]], :]
        acceleration = reference[[i + 2 for i in lowest[:n]], :]
        error, moves = balance.positions - desired, ca.jtimes(balance.positions, q, v)
        tangent = Factorization(balance.rows)
        still = ca.SX.zeros(balance.num_forces)
        tangent_velocity = tangent.solve(ca.vertcat(speed - self.rate * error, still))
        symbols = ca.SX.sym("held", tangent_velocity.numel())
        turned = ca.jtimes(ca.mtimes(balance.rows, symbols), q, v)
        turned = ca.substitute(turned, symbols, tangent_velocity)
        rises = ca.vertcat(acceleration - self.rate * (moves - speed), still)
        tangent_acceleration = tangent.solve(rises - turned)
        sliding = v - tangent_velocity

        # The law.
        shares = Factorization(balance.shares)
        pivot = ca.fmin(tangent.pivot, shares.pivot)
        force, regressor = desired_force, balance.regressor(tangent_acceleration, sliding, estimate)
        if self.force_rate:
            force = desired_force - self.force_rate * integral
        effort = balance.needed(tangent_acceleration, sliding, estimate)
        effort -= self.damping * ca.mtimes(balance.mass, sliding)
        if balance.num_forces:
            effort -= ca.mtimes(balance.jacobian.T, shares.solve(force))
        control = ca.mtimes(ca.SX(ca.sparsify(ca.DM(balance.inverse))), effort)
        measured = ca.SX.sym("measured_force", balance.num_forces)
        gamma = ca.DM(self.gamma)
        rate = -gamma * ca.mtimes(regressor.T, sliding)
        if self.force_rate:
            rate = ca.vertcat(rate, ca.mtimes(balance.shares, measured) - desired_force)

        theta = ca.SX.sym("theta", len(self.signals))
        real = ca.substitute(balance.mass, balance.theta, theta)
        apart = estimate - theta
        energy = (
            ca.bilin(real, sliding, sliding) / 2.0 + ca.dot(apart / gamma, apart) / 2.0  # V
        )
        lost = -self.damping * ca.bilin(balance.mass, sliding, sliding)  # V'

        inputs = {"state": dae.state, "reference": reference}
        force_inputs = {"measured_force": measured} if self.force_rate else {}
        memory_inputs = {"memory": memory, "parameters": dae.parameter_symbol}
        outputs = {
            "control": control,
            "tracking_error": ca.vertcat(error, still),
            "sliding": sliding,
        }
        regular = "the outputs' rates and J, or S, of the adaptive law"
        self.function = TracedFunction(
            f"{dae.name} adaptive law",
            {**inputs, **memory_inputs},
            outputs,
            pivot,
            regular,
            compiled=dae.compiled,
        )
        self.rates = TracedFunction(
            f"{dae.name} adaptation",
            {**inputs, **force_inputs, **memory_inputs},
            {"memory_rate": rate},
            pivot,
            regular,
            compiled=dae.compiled,
        )
        self.energy = TracedFunction(
            f"{dae.name} energy of the adaptive law",
            {**inputs, **memory_inputs, "theta": theta},
            {"value": energy, "rate": lost, "regressor": regressor},
            pivot,
            regular,
            often=False,
        )
