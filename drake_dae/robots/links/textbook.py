"""A robot given by its own equations."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, numbers, unknown_name
from drake_dae.dae import Parameter, Signal, as_expression, signals
from drake_dae.dae.signals import is_symbol
from drake_dae.errors import ModelError
from drake_dae.robots.links.links import ORIGIN, Kinematics, Outline, Reaction


@checked(ModelError)
@dataclass(frozen=True, eq=False)
class LinkExpressions:
    """Links with given M(q) and H(q, v), as in a textbook; see `Links`.

    Attributes:
        q: Generalized positions, SX symbols, shape (nq, 1).
        v: Generalized velocities, SX symbols, shape (nv, 1).
        mass_matrix: M(q), shape (nv, nv), symmetric positive definite.
        bias: H(q, v): Coriolis, centripetal, gravity and friction forces, shape (nv, 1).
        frames: Name -> position p_W(q) in m, shape (3, 1), or (rotation R_WF(q), position).
        velocity_map: N(q) of q' = N(q) v, shape (nq, nv); the identity if None.
        actuation_matrix: B of M v' + H = B u, shape (nv, nu); the identity if None.
        parameters: The parameters of the expressions.
        position_signals, velocity_signals, actuator_signals: Names and units; made up if empty.
        effort_limits: The largest |u|, shape (nu,); infinite if None.
        reflected_inertia: The part of M(q) from rotors, kg m^2 (kg), shape (nu,); 0 if None.
        gear_ratios: Motor turns per joint turn, shape (nu,); 1 if None.
        default_positions: A typical configuration, shape (nq,); zero if None.
        position_limits, velocity_limits: The lower and upper limits, shapes (nq,) and (nv,); none
            if None.

    Raises:
        ModelError: A shape does not fit.
    """

    q: ca.SX
    v: ca.SX
    mass_matrix: ca.SX
    bias: ca.SX
    frames: Mapping[str, ca.SX | tuple[ca.SX, ca.SX]] = field(default_factory=dict)
    velocity_map: ca.SX = None
    actuation_matrix: FloatArray = field(default=None)  # type: ignore[arg-type]
    parameters: tuple[Parameter, ...] = ()
    position_signals: tuple[Signal, ...] = ()
    velocity_signals: tuple[Signal, ...] = ()
    actuator_signals: tuple[Signal, ...] = ()
    effort_limits: FloatArray = field(default=None)  # type: ignore[arg-type]
    reflected_inertia: FloatArray = field(default=None)  # type: ignore[arg-type]
    gear_ratios: FloatArray = field(default=None)  # type: ignore[arg-type]
    default_positions: FloatArray = field(default=None)  # type: ignore[arg-type]
    position_limits: tuple[FloatArray, FloatArray] = field(default=None)  # type: ignore[assignment]
    velocity_limits: tuple[FloatArray, FloatArray] = field(default=None)  # type: ignore[assignment]
    plant: ClassVar[None] = None

    def __post_init__(self) -> None:
        for name in ("q", "v"):
            if not is_symbol(getattr(self, name)):
                raise ModelError(f"{name} must be a CasADi SX column of symbols")
        matrices = ("mass_matrix", "bias", "velocity_map")
        for name in (name for name in matrices if getattr(self, name) is not None):
            value = as_expression("LinkExpressions", name, getattr(self, name))
            object.__setattr__(self, name, value)
        nq, nv = self.q.numel(), self.v.numel()
        actuation = np.eye(nv) if self.actuation_matrix is None else self.actuation_matrix
        actuation = numbers("actuation_matrix", actuation)
        if actuation.ndim != 2 or actuation.shape[0] != nv:
            raise ModelError(f"actuation_matrix has shape {actuation.shape}, expected ({nv}, nu)")
        nu = actuation.shape[1]
        fill = {
            "velocity_map": ca.SX.eye(nv) if self.velocity_map is None else self.velocity_map,
            "actuation_matrix": actuation,
            "position_signals": self.position_signals or signals([f"q{i}" for i in range(nq)]),
            "velocity_signals": self.velocity_signals or signals([f"v{i}" for i in range(nv)]),
            "actuator_signals": self.actuator_signals or signals([f"u{i}" for i in range(nu)]),
            "effort_limits": _filled("effort_limits", self.effort_limits, nu, np.inf),
            "reflected_inertia": _filled("reflected_inertia", self.reflected_inertia, nu, 0.0),
            "gear_ratios": _filled("gear_ratios", self.gear_ratios, nu, 1.0),
            "default_positions": _filled("default_positions", self.default_positions, nq, 0.0),
            "position_limits": _limits("position_limits", self.position_limits, nq),
            "velocity_limits": _limits("velocity_limits", self.velocity_limits, nv),
        }
        for key, value in fill.items():
            object.__setattr__(self, key, value)
        for key, shape in (
            ("mass_matrix", (nv, nv)),
            ("bias", (nv, 1)),
            ("velocity_map", (nq, nv)),
            ("effort_limits", (nu,)),
            ("reflected_inertia", (nu,)),
            ("gear_ratios", (nu,)),
            ("default_positions", (nq,)),
        ):
            given = getattr(self, key).shape
            if given != shape:
                raise ModelError(f"{key} has shape {given}, expected {shape}")

    def rotation(self, frame: str) -> ca.SX:
        """R_WF(q), shape (3, 3): the orientation of a frame in the world.

        Raises:
            ModelError: The frame is unknown, or was given without a rotation.
        """
        if frame == "world":
            return ca.SX.eye(3)
        pose = self._pose(frame)
        if not isinstance(pose, tuple):
            raise ModelError(f"frame '{frame}' was given as a position only; give (rotation, p)")
        return pose[0]

    def position(self, frame: str, point: ArrayLike = ORIGIN) -> ca.SX:
        """p_W(q) in m of a point that is fixed in a frame, shape (3, 1).

        Raises:
            ModelError: The frame is unknown, or has no rotation and the point is off its origin.
        """
        offset = numbers("point", point)
        if frame == "world":
            return ca.SX(offset)
        pose = self._pose(frame)
        origin = pose[1] if isinstance(pose, tuple) else pose
        return origin + ca.mtimes(self.rotation(frame), offset) if offset.any() else origin

    def landmarks(self) -> ca.SX:
        """The origins of all frames, in m, shape (3, k)."""
        return ca.horzcat(ca.SX(3, 1), *[self.position(frame) for frame in self.frames])

    @property
    def landmark_names(self) -> tuple[str, ...]:
        """The names of all frames, in the order of the landmarks."""
        return ("world", *self.frames)

    @property
    def outlines(self) -> tuple[Outline, ...]:
        """The origins of all frames."""
        return tuple(Outline(name, name) for name in self.landmark_names)

    def kinematics(self, acceleration: ca.SX | None = None) -> "TextbookKinematics":
        """The frames in motion with v' = `acceleration`, a symbol if None."""
        if acceleration is None:
            acceleration = ca.SX.sym("acceleration", self.v.numel())
        return TextbookKinematics(self, acceleration)

    def articulated_bodies(self, rotors: FloatArray) -> None:
        """None: these links are no tree."""

    def generalized_force(self, kinematics: "TextbookKinematics", reaction: Reaction) -> ca.SX:
        """tau of each column of a reaction, shape (nv, k)."""
        return reaction.generalized

    def inverse_dynamics(self, kinematics: "TextbookKinematics", reaction: Reaction) -> ca.SX:
        """M(q) v' + H(q, v) - tau of (37), shape (nv, 1)."""
        inertial = ca.mtimes(self.mass_matrix, kinematics.acceleration) + self.bias
        return inertial - reaction.generalized

    def _pose(self, frame: str) -> ca.SX | tuple[ca.SX, ca.SX]:
        if frame not in self.frames:
            raise ModelError(unknown_name("frame", frame, ["world", *self.frames]))
        return self.frames[frame]


class TextbookKinematics(Kinematics):
    """Frames whose poses are expressions of q and are differentiated directly."""

    def __init__(self, links: LinkExpressions, acceleration: ca.SX) -> None:
        self.q, self.v, self.acceleration = links.q, links.v, acceleration
        self.position_signals = links.position_signals
        self._links = links
        self._moving = ca.vertcat(links.q, links.v)
        self._rate = ca.vertcat(ca.mtimes(links.velocity_map, links.v), acceleration)

    def rotation(self, frame: str) -> ca.SX:
        return self._links.rotation(frame)

    def position(self, frame: str, point: ArrayLike = ORIGIN) -> ca.SX:
        return self._links.position(frame, point)

    def angular_velocity(self, frame: str) -> ca.SX:
        rotation = self._links.rotation(frame)
        rate = ca.reshape(self.derivative(ca.vec(rotation)), 3, 3)
        # R' = w x R, so that R' R^T contains w.
        return ca.vertcat(
            ca.mtimes(rate[2, :], rotation[1, :].T),
            ca.mtimes(rate[0, :], rotation[2, :].T),
            ca.mtimes(rate[1, :], rotation[0, :].T),
        )

    def velocity(self, frame: str, point: ArrayLike = ORIGIN) -> ca.SX:
        return self.derivative(self.position(frame, point))

    def derivative(self, expression: ca.SX) -> ca.SX:
        return ca.jtimes(expression, self._moving, self._rate)

    def reaction(self, power: ca.SX) -> Reaction:
        return Reaction(ca.gradient(power, self.v))

    def value(self, expression: ca.SX) -> ca.SX:
        return expression


def _filled(name: str, given: ArrayLike | None, size: int, default: float) -> FloatArray:
    return np.full(size, default) if given is None else numbers(name, given)


def _limits(
    name: str, given: tuple[ArrayLike, ArrayLike] | None, size: int
) -> tuple[FloatArray, FloatArray]:
    lower, upper = (np.full(size, end) for end in (-np.inf, np.inf))
    if given is not None:
        lower, upper = (numbers(name, end) for end in given)
    if lower.shape != (size,) or upper.shape != (size,) or not np.all(lower < upper):
        raise ModelError(
            f"{name} must be a lower and an upper limit of shape ({size},), the lower one below, "
            f"got {given!r}"
        )
    return lower, upper
