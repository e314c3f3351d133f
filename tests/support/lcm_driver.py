"""A simulated arm on its wall, behind the LCM messages of a real one."""

import numpy as np
from pydrake.lcm import DrakeLcm
from pydrake.manipulation import (
    IiwaCommandReceiver,
    IiwaControlMode,
    IiwaStatusSender,
    PandaCommandReceiver,
    PandaControlMode,
    PandaStatusSender,
)
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.lcm import LcmInterfaceSystem, LcmPublisherSystem, LcmSubscriberSystem
from pydrake.systems.primitives import ConstantVectorSource, Demultiplexer

from drake_dae import RobotModel, RobotPlant
from drake_dae.systems.plants.hardware.drivers import DRIVERS

MADE = {
    "iiwa": (
        lambda count: IiwaCommandReceiver(count, IiwaControlMode.kTorqueOnly),
        IiwaStatusSender,
        "velocity_estimated",
        1.0,
    ),
    "panda": (
        lambda count: PandaCommandReceiver(count, PandaControlMode.kTorque),
        PandaStatusSender,
        "velocity_measured",
        -1.0,
    ),
}
"""What reads commands, what writes status messages, and the sign of external torques in them."""


class Inside(LeafSystem):
    """What a driver adds: it bears the weight; and the torques that it feels from outside."""

    def __init__(self, model: RobotModel, sign: float) -> None:
        super().__init__()
        plant, count = model.links.plant, model.links.q.numel()
        context, tool = plant.CreateDefaultContext(), plant.GetFrameByName("tool")

        def placed(own) -> None:
            plant.SetPositionsAndVelocities(context, self.GetInputPort("state").Eval(own))

        def weighed(own, output) -> None:
            placed(own)
            weight = plant.CalcGravityGeneralizedForces(context)
            output.SetFromVector(self.GetInputPort("torque").Eval(own) - weight)

        def felt(own, output) -> None:
            placed(own)
            world = plant.world_frame()
            jacobian = plant.CalcJacobianTranslationalVelocity(
                context, JacobianWrtVariable.kV, tool, np.zeros(3), world, world
            )
            # The wall pushes the tool back along -x.
            pushed = -jacobian[0] * self.GetInputPort("force").Eval(own)
            output.SetFromVector(sign * pushed)

        self.DeclareVectorInputPort("torque", count)
        self.DeclareVectorInputPort("state", 2 * count)
        self.DeclareVectorInputPort("force", 1)
        tickets = {
            name: self.input_port_ticket(self.GetInputPort(name).get_index())
            for name in ("torque", "state", "force")
        }
        inner = {tickets["torque"], tickets["state"]}
        self.DeclareVectorOutputPort("control", count, weighed, inner)
        outer = {tickets["force"], tickets["state"]}
        self.DeclareVectorOutputPort("external", count, felt, outer)


class SimulatedDriver:
    """An ideal `RobotPlant` that takes commands and publishes its status each millisecond."""

    def __init__(self, kind: str, model, structure, lcm: DrakeLcm, start, period=0.001) -> None:
        driver, count = DRIVERS[kind], model.links.q.numel()
        receiver, sender, velocity, sign = MADE[kind]
        builder = DiagramBuilder()
        bus = builder.AddSystem(LcmInterfaceSystem(lcm))
        command = builder.AddSystem(
            LcmSubscriberSystem.Make(
                driver.command_channel, driver.command, bus, use_cpp_serializer=True
            )
        )
        read, write = builder.AddSystem(receiver(count)), builder.AddSystem(sender(count))
        self.plant = plant = builder.AddSystem(RobotPlant(model, structure=structure))
        inside = builder.AddSystem(Inside(model, sign))
        split = builder.AddSystem(Demultiplexer([count, count]))
        nothing = builder.AddSystem(ConstantVectorSource(np.zeros(count)))
        publisher = builder.AddSystem(
            LcmPublisherSystem.Make(
                driver.status_channel,
                driver.status,
                bus,
                publish_period=period,
                use_cpp_serializer=True,
            )
        )
        builder.Connect(command.get_output_port(), read.get_input_port(0))
        builder.Connect(read.GetOutputPort("torque"), inside.GetInputPort("torque"))
        builder.Connect(plant.GetOutputPort("state"), inside.GetInputPort("state"))
        builder.Connect(plant.GetOutputPort("constraint_force"), inside.GetInputPort("force"))
        builder.Connect(inside.GetOutputPort("control"), plant.GetInputPort("control"))
        builder.Connect(plant.GetOutputPort("state"), split.get_input_port())
        sources = {
            "position_measured": split.get_output_port(0),
            "position_commanded": split.get_output_port(0),
            velocity: split.get_output_port(1),
            "torque_external": inside.GetOutputPort("external"),
        }
        for index in range(write.num_input_ports()):
            port = write.get_input_port(index)
            if port.get_name() != "time_measured":
                builder.Connect(sources.get(port.get_name(), nothing.get_output_port()), port)
        builder.Connect(write.get_output_port(), publisher.get_input_port())
        diagram = builder.Build()
        self.simulator = Simulator(diagram)
        context = self.simulator.get_mutable_context()
        self.own = plant.GetMyMutableContextFromRoot(context)
        plant.set_consistent_state(self.own, start)
        self.simulator.get_mutable_integrator().set_maximum_step_size(period)

    @property
    def state(self) -> np.ndarray:
        return self.plant.state(self.own)

    def advance(self, time: float) -> None:
        self.simulator.AdvanceTo(time)
