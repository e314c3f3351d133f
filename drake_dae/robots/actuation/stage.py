"""The contract of a stage of actuation, between the control and the joints.

Without stages the joints are rigid (37), and the control is the joint torque. A stage applies a
force to its load, the joints or the shaft of the previous stage, and is driven by the next stage or
by the control. All positions, velocities and forces are on the joints' side of the gears.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import casadi as ca

from drake_dae.dae import Parameter, Signal
from drake_dae.robots.links.links import Links


@dataclass(frozen=True, eq=False)
class AttachedStage:
    """A stage at the p actuators of one robot: E s' = drift(load) + drive_matrix * drive.

    Attributes:
        state: s, symbols, shape (k, 1).
        state_signals: Names and units of s.
        mass: E, shape (k, k), symmetric positive definite.
        drift: Takes the load's position and velocity, each of shape (p, 1); returns shape (k, 1).
        drive_matrix: The input matrix of the drive, shape (k, p).
        drive_signals: Names and units of the drive, p of them.
        force: Takes the load's position and velocity; returns the force on the load, shape (p, 1).
        parameters: The parameters of these expressions.
        ports: Output port of the plant -> its entries of s.
        shaft: Position and velocity of the shaft that a next stage drives; None without a shaft.
        carries_rotors: Whether the plant's rotors move with it instead of the links.
    """

    state: ca.SX
    state_signals: tuple[Signal, ...]
    mass: ca.SX
    drift: Callable[[ca.SX, ca.SX], ca.SX]
    drive_matrix: ca.SX
    drive_signals: tuple[Signal, ...]
    force: Callable[[ca.SX, ca.SX], ca.SX]
    parameters: tuple[Parameter, ...] = ()
    ports: Mapping[str, slice] = field(default_factory=dict)
    shaft: tuple[ca.SX, ca.SX] | None = None
    carries_rotors: bool = False


class Stage(ABC):
    """One kind of actuation, to be attached to a robot.

    1. `attach` gives equations for the p actuators of the given links, in new symbols for the
       state; the stage itself does not change and can be attached to many robots.
    2. Numbers are `parameters` of these equations, with names that begin with the kind, as
       "dc_motors.resistance". An invalid value raises ModelError with the name and the value.
    3. E is symmetric positive definite. `drift` and `force` are smooth, and depend on s, on
       parameters, and on the load's position and velocity, not on the drive: so the control does
       not reach the joints in the same instant.
    4. Another stage can drive it exactly if there is a `shaft`; its drive is then a force.
    5. At rest, the drive can balance any force on the load: s' = 0 has a solution (s, drive).
    6. Names of states and ports are unique in a chain. At most one stage carries the rotors.
    """

    @abstractmethod
    def attach(self, links: Links) -> AttachedStage:
        """The equations at the actuators of these links.

        Raises:
            ModelError: A value does not fit.
        """
