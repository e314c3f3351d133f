"""The frames of a tree of links in motion, with symbols for their poses and velocities.

Constraints are differentiated by these few symbols and not through the joints; the algorithms of
`recursions` provide the motion of the frames in far fewer operations.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import casadi as ca
from numpy.typing import ArrayLike
from pydrake.multibody.tree import Frame

from drake_dae.arrays import FloatArray, vector
from drake_dae.dae import Signal
from drake_dae.robots.links.links import ORIGIN, Application, Kinematics, Reaction, position_index
from drake_dae.robots.links.plant_frames import (
    PlantFrames,
    elementary_joints,
    frame_name,
    position_of,
)
from drake_dae.robots.links.tree import LinkMotion


@dataclass(frozen=True, eq=False)
class _FrameSymbols:
    """The symbols of a moving frame F, all in the world W.

    R_WF' is a symbol besides w, although R_WF' = w x R_WF. So orientation constraints are
    differentiated without products that the recursions have already computed.
    """

    rotation: ca.SX = field(default_factory=lambda: ca.SX.sym("R", 3, 3))
    rotation_rate: ca.SX = field(default_factory=lambda: ca.SX.sym("R'", 3, 3))
    origin: ca.SX = field(default_factory=lambda: ca.SX.sym("p", 3))
    velocity: ca.SX = field(default_factory=lambda: ca.SX.sym("p'", 3))
    spin: ca.SX = field(default_factory=lambda: ca.SX.sym("w", 3))


class TreeKinematics(Kinematics):
    """The frames of a plant in motion; `moving` is how each link moves."""

    def __init__(
        self,
        frames: PlantFrames,
        q: ca.SX,
        v: ca.SX,
        acceleration: ca.SX,
        position_signals: tuple[Signal, ...],
        velocity_map: ca.SX,
        moving: Sequence[LinkMotion],
        gravity: FloatArray,
    ) -> None:
        self.q, self.v, self.acceleration = q, v, acceleration
        self.position_signals = position_signals
        self.moving = moving
        self._frames = frames
        self._position_rate = ca.mtimes(velocity_map, v)
        self._gravity = ca.SX(gravity)
        self._symbols: dict[int, tuple[Frame, _FrameSymbols]] = {}

    def rotation(self, frame: str | Frame) -> ca.SX:
        return self._pose(frame)[0]

    def position(self, frame: str | Frame, point: ArrayLike = ORIGIN) -> ca.SX:
        return position_of(self._pose(frame), point)

    def angular_velocity(self, frame: str | Frame) -> ca.SX:
        symbols = self._moving(self._frames.find(frame))
        return ca.SX.zeros(3) if symbols is None else symbols.spin

    def velocity(self, frame: str | Frame, point: ArrayLike = ORIGIN) -> ca.SX:
        symbols, offset = self._moving(self._frames.find(frame)), vector("a point", point, 3)
        if symbols is None:
            return ca.SX.zeros(3)
        return symbols.velocity + symbols.rotation_rate @ ca.SX(offset)

    def derivative(self, expression: ca.SX) -> ca.SX:
        moving = [(self.q, self._position_rate), (self.v, self.acceleration)]
        for frame, symbols in self._symbols.values():
            index, turn, lever = self._frames.on_link(frame)
            R_WL, link = self._frames.link_poses[index][0], self.moving[index]
            falling = link.acceleration + link.gradient @ ca.SX(lever)
            moving += [
                (symbols.rotation, symbols.rotation_rate),
                (symbols.rotation_rate, R_WL @ (link.gradient @ ca.SX(turn))),
                (symbols.origin, symbols.velocity),
                (symbols.velocity, R_WL @ falling + self._gravity),
                (symbols.spin, R_WL @ link.spin_rate),
            ]
        places, rates = (ca.vertcat(*map(ca.vec, column)) for column in zip(*moving, strict=True))
        return ca.jtimes(expression, places, rates)

    def reaction(self, power: ca.SX) -> Reaction:
        wrenches = {}
        for frame, symbols in self._symbols.values():
            velocities = ca.veccat(symbols.velocity, symbols.rotation_rate, symbols.spin)
            if not ca.depends_on(power, velocities):
                continue
            slope = ca.gradient(power, symbols.rotation_rate)
            moment = ca.gradient(power, symbols.spin)
            for k in range(3):
                moment += ca.cross(symbols.rotation[:, k], slope[:, k])
            wrenches[frame] = (ca.gradient(power, symbols.velocity), moment)
        return Reaction(ca.sparsify(ca.gradient(power, self.v)), wrenches)

    def joint_axis(self, position: str) -> Application | None:
        plant, place = self._frames.plant, position_index(self, position)
        for index in plant.GetJointIndices():
            joint = plant.get_joint(index)
            if joint.num_positions() == 1 and joint.position_start() == place:
                break
        else:
            return None
        (*_, last), rotation = elementary_joints(plant, joint)  # The rotation of a screw joint.
        frame = joint.frame_on_child()
        along, none = self.rotation(frame) @ ca.SX(rotation @ last.directions), ca.SX(3, 1)
        child, parent = (
            frame_name(plant, body.body_frame())
            for body in (joint.child_body(), joint.parent_body())
        )
        axes = (along, none) if last.axis is None else (none, along)
        return Application(self.position(frame), *axes, child, parent)

    def value(self, expression: ca.SX) -> ca.SX:
        pairs = [pair for entry in self._symbols.values() for pair in self._values(*entry)]
        symbols, values = ([ca.vec(pair[i]) for pair in pairs] for i in (0, 1))
        return ca.substitute(expression, ca.vertcat(*symbols), ca.vertcat(*values))

    def _values(self, frame: Frame, symbols: _FrameSymbols) -> list[tuple[ca.SX, ca.SX]]:
        """Each symbol of a frame, and its expression."""
        index, turn, lever = self._frames.on_link(frame)
        R_WL, link = self._frames.link_poses[index][0], self.moving[index]
        R_WF, p_WF = self._frames.pose(frame)
        return [
            (symbols.rotation, R_WF),
            (symbols.rotation_rate, R_WL @ (ca.skew(link.spin) @ ca.SX(turn))),
            (symbols.origin, p_WF),
            (symbols.velocity, R_WL @ (link.velocity + ca.cross(link.spin, ca.SX(lever)))),
            (symbols.spin, R_WL @ link.spin),
        ]

    def _pose(self, frame: str | Frame) -> tuple[ca.SX, ca.SX]:
        resolved = self._frames.find(frame)
        symbols = self._moving(resolved)
        return (
            self._frames.pose(resolved) if symbols is None else (symbols.rotation, symbols.origin)
        )

    def _moving(self, frame: Frame) -> _FrameSymbols | None:
        """The symbols of a frame; None if it is fixed to the world."""
        if self._frames.on_link(frame)[0] == 0:
            return None
        return self._symbols.setdefault(int(frame.index()), (frame, _FrameSymbols()))[1]
