"""The ports of a plant, computed from the messages of an arm's driver."""

import casadi as ca
import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, DiscreteValues, EventStatus, LeafSystem

from drake_dae.arrays import FloatArray
from drake_dae.dae.structure.constrained import ConstraintStructure
from drake_dae.dae.system.signals import Signal
from drake_dae.robots.model import RobotModel
from drake_dae.systems.blocks.lifetime import SHARED_DICTIONARY, port_value, weakly
from drake_dae.systems.plants.hardware.drivers import LcmDriver

RUNNING, STOPPED, WAITING = 0.0, 2.0, 3.0
"""The first entry of the port `driver_status`; the numbers are those of an exported controller."""

STATUS_SIGNALS = (Signal("status"), Signal("age", "s"))
"""Names and units of `driver_status`."""


class ArmPorts(LeafSystem):
    """The ports of a plant from the messages of an arm's driver, and its torques from a control:

        tau = B u + g(q),    lambda = argmin |tau_ext - G(x) lambda|,

    with the generalized forces g of gravity, which the driver compensates, and G of the constraint
    forces. Before the first message it is WAITING: the torque is zero, and the state is the one
    that was set. Messages that are not finite are ignored. After max_age without a message, or if
    the control is not finite, it is STOPPED for good: the torque goes linearly to zero within
    stop_time, and the driver compensates gravity.

    Input ports:
        position, velocity, torque_external: q, v and the driver's external torque, shape (k,).
        message: The status message as a Python object.
        control: u, shape (p,).

    Output ports:
        state, link_state, constraint_force, constraint_residual, controlled_output: As of a plant.
        torque: The torque for the driver, N m, shape (k,).
        driver_status: WAITING, RUNNING or STOPPED; and the time since the last message, s.

    Args:
        model: The robot.
        structure: The structure of its system.
        driver: The driver.
        period: The period of the torques, s.
        max_age: The largest time between messages, s.
        stop_time: The time in which the torque goes to zero, s.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(
        self,
        model: RobotModel,
        structure: ConstraintStructure,
        driver: LcmDriver,
        period: float,
        max_age: float,
        stop_time: float,
    ) -> None:
        super().__init__()
        self.set_name("arm_ports")
        dae, links = model.dae, model.links
        assert links.plant is not None  # LcmArm.
        self._plant, self._weight = links.plant, links.plant.CreateDefaultContext()
        self._select, self._sign = links.actuation_matrix, driver.external_sign
        self._max_age, self._stop_time = max_age, stop_time
        self._values, self._manifold = dae.parameter_values, structure.manifold
        count, self._count = links.q.numel(), links.q.numel()
        # With its mass matrix on the left, g of the system has generalized forces.
        mapped = ca.densify(dae.g[count : 2 * count, :])
        self._map = dae.trace("generalized forces", {"map": mapped})
        force = ca.SX.sym("force", dae.num_constraints)
        self._output = dae.trace(
            "controlled output", {"value": dae.outputs(force)}, {"force": force}
        )
        self._ports = {
            name: self.DeclareVectorInputPort(name, count)
            for name in ("position", "velocity", "torque_external")
        }
        self._message = self.DeclareAbstractInputPort("message", Value(driver.status()))
        self._control = self.DeclareVectorInputPort("control", dae.num_controls)
        # The last valid state and force.
        self._start = self.DeclareDiscreteState(dae.nominal_state)
        self._last_force = self.DeclareDiscreteState(dae.num_constraints)
        # The time stamp and the arrival time of the last message, and the time of the stop.
        self._watch = self.DeclareDiscreteState([0.0, 0.0, np.inf])
        self._last_torque = self.DeclareDiscreteState(count)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, weakly(self._update))
        tickets = {
            self.xd_ticket(),
            self.input_port_ticket(self._message.get_index()),
            *(self.input_port_ticket(port.get_index()) for port in self._ports.values()),
        }
        for name, size, value in (
            ("state", dae.num_states, self.state),
            ("link_state", dae.num_states, self.state),
            ("constraint_force", dae.num_constraints, self._force),
            ("constraint_residual", len(self._manifold.residual_signals), self._residual),
            ("controlled_output", dae.num_outputs, self._outputs),
        ):
            self.DeclareVectorOutputPort(name, size, port_value(value), tickets)
        by_time = tickets | {self.time_ticket()}
        self.DeclareVectorOutputPort("driver_status", 2, port_value(self._status), by_time)
        self.DeclareVectorOutputPort("torque", count, port_value(self._torque))

    def state(self, context: Context) -> FloatArray:
        """x of the last valid message, shape (n,); before the first one, the state that was set."""
        measured = self._measured(context)
        if measured is None:
            return np.array(context.get_discrete_state(self._start).value())
        return measured[: 2 * self._count]

    def set_state(self, context: Context, state: FloatArray) -> None:
        """Sets the state before the first message."""
        context.SetDiscreteState(self._start, state)

    def _measured(self, context: Context) -> FloatArray | None:
        """Positions, velocities and external torques of the message; None if it is not valid."""
        if not self._message.Eval(context).utime:
            return None
        values = np.concatenate([port.Eval(context) for port in self._ports.values()])
        return values if np.isfinite(values).all() else None

    def _stamp(self, context: Context) -> float:
        """The time stamp of the last valid message; 0 before the first one."""
        if self._measured(context) is None:
            return float(context.get_discrete_state(self._watch).value()[0])
        return float(self._message.Eval(context).utime)

    def _status(self, context: Context) -> tuple[float, float]:
        """The status, and the time since the last message."""
        stamp, came_at, stopped_at = context.get_discrete_state(self._watch).value()
        age = context.get_time() - came_at if self._stamp(context) == stamp else 0.0
        if np.isfinite(stopped_at):
            return STOPPED, age
        return (RUNNING, age) if self._stamp(context) else (WAITING, age)

    def _commanded(self, context: Context) -> FloatArray:
        """B u + g(q)."""
        self._plant.SetPositions(self._weight, self.state(context)[: self._count])
        gravity = self._plant.CalcGravityGeneralizedForces(self._weight)
        torque: FloatArray = self._select @ self._control.Eval(context) + gravity
        return torque

    def _torque(self, context: Context) -> FloatArray:
        status, _ = self._status(context)
        last: FloatArray = context.get_discrete_state(self._last_torque).value()
        if status == WAITING:
            return np.zeros(self._count)
        if status == STOPPED:
            passed = context.get_time() - context.get_discrete_state(self._watch).value()[2]
            return last * max(0.0, 1.0 - passed / self._stop_time)
        torque = self._commanded(context)
        return torque if np.isfinite(torque).all() else last

    def _update(self, context: Context, values: DiscreteValues) -> EventStatus:
        now, (status, age) = context.get_time(), self._status(context)
        watch = values.get_mutable_vector(self._watch)
        stamp, came_at, stopped_at = watch.CopyToVector()
        if self._stamp(context) != stamp:
            came_at = now
        if status == RUNNING:
            values.get_mutable_vector(self._last_torque).SetFromVector(self._torque(context))
            if age > self._max_age or not np.isfinite(self._commanded(context)).all():
                stopped_at = now
        watch.SetFromVector([self._stamp(context), came_at, stopped_at])
        values.get_mutable_vector(self._start).SetFromVector(self.state(context))
        values.get_mutable_vector(self._last_force).SetFromVector(self._force(context))
        return EventStatus.Succeeded()

    def _force(self, context: Context) -> FloatArray:
        measured = self._measured(context)
        if measured is None:
            return np.array(context.get_discrete_state(self._last_force).value())
        external = self._sign * measured[2 * self._count :]
        (mapped, *_) = self._map(self.state(context), self._values)
        return np.asarray(np.linalg.lstsq(mapped.reshape(self._count, -1), external, None)[0])

    def _residual(self, context: Context) -> FloatArray:
        return self._manifold.residual(self.state(context), self._values)

    def _outputs(self, context: Context) -> FloatArray:
        return self._output(self.state(context), self._force(context), self._values)[0]
