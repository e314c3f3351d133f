"""The joints of a robot that close loops: their coordinates and forces."""

from dataclasses import dataclass
from typing import Self

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae import Signal
from drake_dae.robots.constraints.constraint_set import ConstraintSet
from drake_dae.robots.links.links import Links


@dataclass(frozen=True, eq=False)
class LoopState:
    """The coordinates c of the joints that close loops, as expressions of q and v.

    Attributes:
        state: (c, c'), shape (2 l, 1).
        signals: Their names and units.
        limits: The lower and the upper limits of (c, c'), shape (2 l,) each, infinite where there
            are none.
        force: The generalized force of their springs and dampers, shape (nv, 1).
        motors: The generalized forces of their motors, shape (nv, k).
    """

    state: ca.SX
    signals: tuple[Signal, ...]
    limits: tuple[FloatArray, FloatArray]
    force: ca.SX
    motors: ca.SX

    @classmethod
    def of(cls, bound: ConstraintSet, links: Links) -> Self:
        """The state of these joints, in the order of the constraints."""
        if not bound.joints:
            nv, none = links.v.numel(), np.zeros(0)
            return cls(ca.SX(0, 1), (), (none, none), ca.SX(nv, 1), ca.SX(nv, 0))
        members, joints = [c for c, _ in bound.joints], [joint for _, joint in bound.joints]
        position, rate = bound.joint_state(links)
        columns = bound.joint_columns(links)
        forces = [joint.force(position[i], rate[i]) for i, joint in enumerate(joints)]
        named = [signal for member in members for signal in member.coordinate_signals]
        fastest = [joint.velocity_limit for joint in joints]
        return cls(
            state=ca.vertcat(position, rate),
            signals=(*named, *(signal.derivative(1) for signal in named)),
            limits=(
                np.array([*(j.lower for j in joints), *(-v for v in fastest)]),
                np.array([*(j.upper for j in joints), *fastest]),
            ),
            force=ca.sparsify(ca.mtimes(columns, ca.vertcat(*forces))),
            motors=columns[:, [i for i, joint in enumerate(joints) if joint.motor is not None]],
        )
