"""The LCM drivers of real arms: their messages, and the signs in them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from drake import lcmt_iiwa_command, lcmt_iiwa_status, lcmt_panda_command, lcmt_panda_status
from pydrake.manipulation import (
    IiwaCommandSender,
    IiwaControlMode,
    IiwaStatusReceiver,
    PandaCommandSender,
    PandaControlMode,
    PandaStatusReceiver,
)
from pydrake.systems.framework import System


@dataclass(frozen=True)
class LcmDriver:
    """The LCM driver of an arm, which takes torques in addition to gravity compensation.

    Attributes:
        status, command: The types of the messages.
        status_channel, command_channel: The names of their channels.
        receiver: Number of joints -> Drake's block that reads a status.
        sender: Number of joints -> Drake's block that writes a command of torques.
        position, velocity: The names of these ports of the receiver.
        external_sign: The sign of the external torque in the message: 1 for the torque on the arm,
            as for a KUKA iiwa, -1 for the torque of the arm, as for a Franka Panda.
    """

    status: Any
    command: Any
    status_channel: str
    command_channel: str
    receiver: Callable[[int], System]
    sender: Callable[[int], System]
    position: str = "position_measured"
    velocity: str = "velocity_measured"
    external_sign: float = 1.0


DRIVERS = {
    "iiwa": LcmDriver(
        lcmt_iiwa_status,
        lcmt_iiwa_command,
        "IIWA_STATUS",
        "IIWA_COMMAND",
        IiwaStatusReceiver,
        lambda count: IiwaCommandSender(count, IiwaControlMode.kTorqueOnly),
        velocity="velocity_estimated",
    ),
    "panda": LcmDriver(
        lcmt_panda_status,
        lcmt_panda_command,
        "PANDA_STATUS",
        "PANDA_COMMAND",
        PandaStatusReceiver,
        lambda count: PandaCommandSender(count, PandaControlMode.kTorque),
        external_sign=-1.0,
    ),
}
"""Name -> driver; signs are those of Drake's manipulation/README.md."""
