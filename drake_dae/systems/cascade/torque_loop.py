"""A loop that controls the torque of the springs in a robot's joints."""

import casadi as ca
import numpy as np
from pydrake.systems.framework import Context, EventStatus, State

from drake_dae.arrays import FloatArray, positive
from drake_dae.dae.beyond.spring_loop import SpringLoop
from drake_dae.dae.structure.structure import Structure
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.errors import ModelError
from drake_dae.robots.actuation.stage import AttachedStage, Spring
from drake_dae.robots.model import RobotModel
from drake_dae.systems.blocks.block import NO_TIME_DERIVATIVE, ParameterizedSystem
from drake_dae.systems.blocks.lifetime import SHARED_DICTIONARY, port_value, weakly
from drake_dae.systems.blocks.traced import HELD, PARAMETERS, Block, Computation, Update
from drake_dae.trace.factorization import PositiveDefiniteFactorization
from drake_dae.trace.functions import TracedFunction

_EXCESS = 0.01
"""The largest deviation of the model's acceleration from the measured one, as a torque in effort
limits."""


class TorqueLoop(ParameterizedSystem):
    """The inner loop of a cascade: the torque tau of the springs follows the desired one, tau_d.

    With the shafts B q_2'' = tau_m - tau - f and the springs tau = K (q_2 - q), it is

        tau_m = tau + B (a_d + K^-1 v) + f_o,
        v = w^2 (tau_d - tau) + 2 zeta w (tau_d' - K (q_2' - q')),

    where a_d is the acceleration of the links that the rigid model has under tau_d, f_o an estimate
    of f, the friction of the motors and other disturbances, and tau_d' the difference of samples,
    limited to `slope` and filtered at 2 w. So no derivative of the model is taken. Then e = tau -
    tau_d obeys, without sampling and with q'' - a_d = M^-1 P e + d, where P is the identity
    without the reaction of the constraints, and d an error of the rigid model,

        e'' + 2 zeta w e' + (w^2 + K M^-1 P) e = -tau_d'' - K d + K B^-1 (f_o - f).

    The motors' inertia is shaped to K / w^2 (the gain of the torque is w^2 B / K, one for each
    joint, so that stiff and soft springs have one rate).

    While friction holds the tool, the law commands accelerations that the links do not have: e
    would grow to K / w^2 a_d, and throw the tool off the surface when it breaks away. So a_d is
    limited to the measured acceleration, 2 w (v - its lag), plus or minus 0.01 effort limits as a
    torque K / w^2 a.

    The disturbance f is observed from the momentum B q_2' of the motors:

        f_o' = k_m (f_k - f_o),    f_k = mean(tau_m - tau) - B (q_2',k - q_2',k-1) / T.

    With `DcMotors` tau_m is the torque of the currents, and the voltage makes them follow tau_m +
    tau_m' / k_i at the rate k_i, where tau_m' follows from tau'' = K (B^-1 (tau_m - tau - f_o) -
    a_d): this compensates the lag of the currents.

    Input ports:
        estimated_state: x = (q, v, s), shape (n,).
        wanted_torque: tau_d, shape (p,).
        control: The control that acts on the plant, shape (p,).
        exogenous: As for a `TrackingController` of the rigid law, if its system has any.

    Output ports:
        control: tau_m, or the voltages, shape (p,).
        motor_disturbance: -f_o in N m, shape (p,), held between samples; friction is negative while
            a motor turns forward.

    Args:
        model: The robot with springs, with or without motors that drive them.
        law: The rigid law, of `link_side(model)`.
        loop: The rates.
        sample_period: T in s.
        control_lag: The fraction of T for which the plant uses the previous control; see
            `DisturbanceObserver`.

    Raises:
        ModelError: The joints have no springs, or the stage that drives them is not supported.
    """

    __slots__ = SHARED_DICTIONARY
    no_gradient = NO_TIME_DERIVATIVE

    def __init__(
        self,
        model: RobotModel,
        law: TrackingLaw,
        loop: SpringLoop,
        sample_period: float,
        control_lag: float = 0.0,
    ) -> None:
        spring, drive = stages_of(model)
        dae, system = model.dae, law.system
        of_stages = [parameter for stage in model.stages for parameter in stage.parameters]
        values = np.concatenate([system.parameter_values, *(p.value for p in of_stages)])
        signals = {"state": dae.state_signals, "control": dae.control_signals}
        super().__init__(system, values, signals, sees_steps=False)
        self.set_name("torque_loop")
        self.loop, self.sample_period = loop, positive("sample_period", sample_period)
        self._drive, self._lag, self._model = drive, control_lag, model
        numbers = ca.vertcat(system.parameter_symbol, *(p.symbol for p in of_stages))
        p = dae.num_controls
        self._memory = [ca.SX.sym("held", p) for _ in range(7)]
        self._has_sample = ca.SX.sym("has_sample", 1)
        self._sampled, self._function = self._trace(law.structure, spring, numbers)
        self.disturbance_signals = tuple(
            Signal(f"disturbance of {signal.name}", signal.unit)
            for signal in model.links.actuator_signals
        )
        sizes = {"estimated_state": dae.num_states, "wanted_torque": p, "control": p}
        self._ports = {name: self.DeclareVectorInputPort(name, n) for name, n in sizes.items()}
        self._declare_exogenous(law.exogenous_degrees)
        self._held = self.DeclareDiscreteState(np.zeros(7 * p + 1))
        # Unrestricted, as the step of a discrete MultibodyPlant: so all see one instant.
        self.DeclarePeriodicUnrestrictedUpdateEvent(sample_period, 0.0, weakly(self._sample))
        # The acting control enters the control one sample later.
        held = {self.discrete_state_ticket(self._held)}
        read = [self.GetInputPort(name) for name in self._ports if name != "control"]
        read += [] if self._exogenous is None else [self._exogenous]
        sources = held | {self.input_port_ticket(port.get_index()) for port in read}
        sources.add(self.all_parameters_ticket())
        self.DeclareVectorOutputPort("control", p, port_value(self._control), sources)
        self.DeclareVectorOutputPort("motor_disturbance", p, port_value(self._disturbance), held)

    def _trace(
        self, structure: Structure, spring: Spring, numbers: ca.SX
    ) -> tuple[TracedFunction, TracedFunction]:
        """The discrete state after a sample, and the control, as functions."""
        model, loop, period = self._model, self.loop, self.sample_period
        state, p = model.dae.state, model.dae.num_controls
        desired, acting = ca.SX.sym("wanted_torque", p), ca.SX.sym("control", p)
        has_sample = self._has_sample
        disturbance, last_desired, slope, momentum, torque, last, slow = self._memory
        position, velocity, shaft = self._velocities()
        tau = model.joint_force

        # The slope of the desired torque, the motors' disturbance, the links' acceleration.
        def follow(old: ca.SX, new: ca.SX, rate: float) -> ca.SX:
            return old + has_sample * -np.expm1(-rate * period) * (new - old)

        efforts = np.array(model.links.effort_limits)
        rise = _within((desired - last_desired) / period, ca.DM(loop.slope * efforts))
        slope = follow(slope, rise, 2.0 * loop.rate)
        new_momentum = ca.mtimes(spring.inertia, shaft)
        if self._drive is None:
            now, acted = acting, self._lag * last + (1.0 - self._lag) * acting
        else:
            now = self._drive.force(position, shaft)
            acted = (last + now) / 2.0
        lost = acted - (torque + tau) / 2.0 - (new_momentum - momentum) / period
        slower = ca.if_else(
            has_sample, slow + -np.expm1(-2.0 * loop.rate * period) * (velocity - slow), velocity
        )
        new_disturbance = follow(disturbance, -lost, loop.motor_rate)
        after = ca.vertcat(new_disturbance, desired, slope, new_momentum, tau, now, slower, 1.0)

        # The acceleration by the model, near the measured one.
        elimination, rows = structure.elimination, self._rows()
        rate = elimination.f_star + ca.mtimes(elimination.h_star, desired)  # On N*.
        B = ca.SX(ca.sparsify(ca.DM(model.links.actuation_matrix)))
        springs = PositiveDefiniteFactorization(spring.stiffness)
        measured = 2.0 * loop.rate * (velocity - slower)
        excess = ca.mtimes(spring.stiffness, ca.mtimes(B.T, rate[rows, :]) - measured)
        excess = _within(excess / loop.rate**2, ca.DM(_EXCESS * efforts))
        ahead = measured + loop.rate**2 * springs.solve(excess)

        # The law.
        w, zeta = loop.rate, loop.damping
        moves = ca.mtimes(spring.stiffness, shaft - velocity)
        v = w**2 * (desired - tau) + 2.0 * zeta * w * (slope - moves)
        control = tau + ca.mtimes(spring.inertia, ahead + springs.solve(v)) - disturbance
        if self._drive is not None:
            assert self._drive.drive_for is not None
            inner = PositiveDefiniteFactorization(spring.inertia).solve(now + disturbance - tau)
            bends = ca.mtimes(spring.stiffness, inner - ahead)  # tau''.
            change = w**2 * (slope - moves) - 2.0 * zeta * w * bends  # v'.
            rises = moves + ca.mtimes(spring.inertia, springs.solve(change))
            target = control + rises / loop.current_rate
            control = self._drive.drive_for(target, shaft, ca.SX(loop.current_rate))
        held = ca.vertcat(*self._memory, has_sample)
        name, compiled = model.dae.name, model.dae.compiled
        inputs = {"state": state, "wanted_torque": desired}
        rest = {"held": held, "parameters": numbers}
        sample = TracedFunction(
            f"{name} sample of the torque loop",
            {**inputs, "control": acting, **rest},
            {"held": after},
            compiled=compiled,
        )
        function = TracedFunction(
            f"{name} torque loop",
            {**inputs, **rest},
            {"control": control},
            elimination.pivot,
            "A(x) of Assumption (2)",
            compiled=compiled,
        )
        return sample, function

    def _rows(self) -> list[int]:
        links = self._model.links
        size = links.q.numel()
        return list(range(size, size + links.v.numel()))

    def _velocities(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """q_2, q' of the joints and q_2', shape (p, 1) each."""
        shaft = self._model.stages[0].shaft
        assert shaft is not None
        B = ca.SX(ca.sparsify(ca.DM(self._model.links.actuation_matrix)))
        return shaft[0], ca.mtimes(B.T, self._model.links.v), shaft[1]

    def _inputs(self, context: Context, *names: str) -> list[FloatArray]:
        """The values of input ports, and the discrete state."""
        held = context.get_discrete_state(self._held).value()
        return [*(self._ports[name].Eval(context) for name in names), held]

    def _sample(self, context: Context, state: State) -> EventStatus:
        inputs = self._inputs(context, "estimated_state", "wanted_torque", "control")
        after = self._checked(self._sampled, context, *inputs)[0]
        state.get_mutable_discrete_state().set_value(self._held, after)
        return EventStatus.Succeeded()

    def _control(self, context: Context) -> FloatArray:
        inputs = self._inputs(context, "estimated_state", "wanted_torque")
        return self._checked(self._function, context, *inputs)[0]

    def _disturbance(self, context: Context) -> FloatArray:
        held = context.get_discrete_state(self._held).value()
        return held[: len(self.disturbance_signals)]

    def traced(self) -> Block:
        read, last = ("estimated_state", "wanted_torque"), (HELD, PARAMETERS)
        held = ca.vertcat(*self._memory, self._has_sample)
        shown = ca.Function("shown", [held], [self._memory[0]])
        update = Computation.of(self._sampled, (*read, "control", *last), (HELD,))
        return Block(
            self,
            (
                Computation.of(self._function, (*read, *last), ("control",)),
                Computation(shown, (HELD,), ("motor_disturbance",)),
            ),
            (Update(update, self.sample_period, is_unrestricted=True),),
            moving=tuple(self.exogenous_places),
            signals=self._signals,
            ports={"motor_disturbance": self.disturbance_signals},
        )


def _within(value: ca.SX, limits: ca.DM) -> ca.SX:
    """A column within limits, shape (p, 1)."""
    return ca.fmax(-limits, ca.fmin(limits, value))


def stages_of(model: RobotModel) -> tuple[Spring, AttachedStage | None]:
    """The springs of a robot, and the stage that drives them; None without one.

    Args:
        model: The robot.

    Raises:
        ModelError: There are no springs at the joints, or the stage that drives them cannot be
            commanded a force.
    """
    if not model.stages or model.stages[0].spring is None:
        raise ModelError(
            f"{model.name} has no springs at its joints: the law of a cascade is for "
            "FlexibleJoints, with nothing or DcMotors behind them. For other drives take the "
            "tracking law"
        )
    behind = model.stages[1:]
    if len(behind) > 1 or any(stage.drive_for is None for stage in behind):
        raise ModelError(
            f"{model.name}: behind its springs the law of a cascade knows DcMotors or nothing. "
            "For other drives take the tracking law"
        )
    return model.stages[0].spring, behind[0] if behind else None
