"""A real arm behind its LCM driver, in place of a simulated plant."""

import sys
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike
from pydrake.lcm import DrakeLcmInterface
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.lcm import LcmInterfaceSystem, LcmPublisherSystem, LcmSubscriberSystem

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.dae.structure.constrained import ConstraintStructure
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError
from drake_dae.robots.model import RobotModel
from drake_dae.systems.blocks.lifetime import SHARED_DICTIONARY
from drake_dae.systems.blocks.traced import Block, not_traced
from drake_dae.systems.plants.contract import Plant
from drake_dae.systems.plants.hardware.arm_ports import STATUS_SIGNALS, ArmPorts
from drake_dae.systems.plants.hardware.drivers import DRIVERS

CRASHES = (3, 13)
"""From this version of Python on, Drake 1.51 crashes when it reads a message."""


@checked(ModelError)
class LcmArm(Diagram, Plant):
    """A KUKA iiwa or a Franka Panda behind its LCM driver, with the ports of a `RobotPlant`.

    It reads status messages and publishes torques by Drake's blocks, and takes the place of the
    simulated plant in the same diagram: `make_closed_loop(LcmArm(...), law, ...)`, simulated at
    the rate of real time, `SimulatorConfig(target_realtime_rate=1.0)`. The driver compensates
    gravity and sends an external torque, from which the constraint force is estimated. For its
    behavior before the first message, and without a recent one, see `ArmPorts`.

    Input port:
        control: u, shape (p,): torques of the actuators, N m.

    Output ports:
        state: x = (q, v) of the last message, shape (n,). link_state: The same.
        constraint_force, constraint_residual, controlled_output: As of `ArmPorts`.
        driver_status: 3 before the first message, then 0, and 2 after a stop; and the time since
            the last message, s.

    Args:
        model: The robot, of a MultibodyPlant, with rigid joints and an actuator in each.
        lcm: The LCM interface of the driver, such as DrakeLcm(); DrakeLcm("memq://") in a test.
        driver: "iiwa" or "panda".
        structure: The structure of the model's system.
        period: The period of the torques, s.
        max_age: The largest age of a status, s; then the arm is stopped.
        stop_time: The time in which the torque then goes to zero, s.

    Attributes:
        dae, model, structure, time_step: As for `Plant`.

    Raises:
        ModelError: There is no such driver, the robot has joints without actuators, stages or no
            MultibodyPlant, or a time is not positive.
    """

    __slots__ = SHARED_DICTIONARY
    is_ideal = False

    def __init__(
        self,
        model: RobotModel,
        lcm: DrakeLcmInterface,
        driver: str,
        *,
        structure: ConstraintStructure,
        period: float = 0.001,
        max_age: float = 0.02,
        stop_time: float = 0.1,
    ) -> None:
        super().__init__()
        if sys.version_info >= CRASHES:
            raise ModelError(
                "an LcmArm needs Python 3.11 or 3.12: with later ones Drake's LCM blocks crash here"
            )
        if driver not in DRIVERS:
            raise ModelError(unknown_name("driver", driver, DRIVERS))
        for name, value in {"period": period, "max_age": max_age, "stop_time": stop_time}.items():
            if not 0.0 < value < np.inf:
                raise ModelError(f"{name} is a positive time in s, got {value:g}")
        _check_model(model)
        self.model: RobotModel = model
        self.dae, self.structure, self.time_step = model.dae, structure, period
        chosen, count, builder = DRIVERS[driver], model.links.q.numel(), DiagramBuilder()
        bus = builder.AddSystem(LcmInterfaceSystem(lcm))
        channel = chosen.status_channel, chosen.status, bus
        status = builder.AddSystem(LcmSubscriberSystem.Make(*channel, use_cpp_serializer=True))
        # The same message in Python: not every receiver of Drake has its time stamp on a port.
        stamped = builder.AddSystem(LcmSubscriberSystem.Make(*channel))
        stamped.set_name("stamped_status")
        receiver = builder.AddSystem(chosen.receiver(count))
        ports = builder.AddSystem(ArmPorts(model, structure, chosen, period, max_age, stop_time))
        self._ports = ports
        sender = builder.AddSystem(chosen.sender(count))
        publisher = builder.AddSystem(
            LcmPublisherSystem.Make(
                chosen.command_channel,
                chosen.command,
                bus,
                publish_period=period,
                use_cpp_serializer=True,
            )
        )
        builder.Connect(status.get_output_port(), receiver.get_input_port())
        builder.Connect(stamped.get_output_port(), ports.GetInputPort("message"))
        for name, source in {
            "position": chosen.position,
            "velocity": chosen.velocity,
            "torque_external": "torque_external",
        }.items():
            builder.Connect(receiver.GetOutputPort(source), ports.GetInputPort(name))
        builder.Connect(ports.GetOutputPort("torque"), sender.GetInputPort("torque"))
        builder.Connect(sender.get_output_port(), publisher.get_input_port())
        builder.ExportInput(ports.GetInputPort("control"), "control")
        for index in range(ports.num_output_ports()):
            port = ports.get_output_port(index)
            if port.get_name() != "torque":
                builder.ExportOutput(port, port.get_name())
        builder.BuildInto(self)
        self.set_name(model.dae.name)

    @property
    def further_signals(self) -> Mapping[str, Sequence[Signal]]:
        return {"driver_status": STATUS_SIGNALS}

    def state(self, context: Context) -> FloatArray:
        """The state x in a context, shape (n,): that of the last message, if there was one."""
        return self._ports.state(self.GetSubsystemContext(self._ports, context))

    def set_state(self, context: Context, state: ArrayLike) -> None:
        """Sets the state that is shown before the first message, shape (n,).

        Raises:
            ModelError: The shape is wrong.
        """
        ports_context = self.GetMutableSubsystemContext(self._ports, context)
        self._ports.set_state(ports_context, self.dae.state_vector(state))

    def traced(self) -> Block:
        raise not_traced(f"'{self.get_name()}', an arm behind LCM,")


def _check_model(model: RobotModel) -> None:
    """Refuses a robot whose joints are not driven one by one.

    Raises:
        ModelError: The robot does not fit; the message has the reason.
    """
    links, what = model.links, None
    if model.stages:
        what = "has stages of actuation, and a driver takes torques of joints"
    elif links.plant is None:
        what = "has no MultibodyPlant, which knows its weight"
    elif links.actuation_matrix.shape != (links.q.numel(), links.q.numel()):
        what = (
            f"has {links.actuation_matrix.shape[1]} actuators for {links.q.numel()} joints, and a "
            "driver commands each joint"
        )
    elif model.dae.num_states != 2 * links.q.numel():
        what = "has states besides those of its joints"
    if what is not None:
        raise ModelError(f"'{model.dae.name}' {what}: an LcmArm cannot run it")
