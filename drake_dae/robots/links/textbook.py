"""A robot given by its own equations."""

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, numbers, unknown_name
from drake_dae.dae import Parameter, Signal, as_expression, signals
from drake_dae.dae.signals import is_symbol
from drake_dae.errors import ModelError
from drake_dae.robots.links.links import ORIGIN, Kinematics, Links, Outline, Reaction


@checked(ModelError)
class LinkExpressions(Links):
    """Links with given M(q) and H(q, v), as in a textbook; see `Links`.

    Args:
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

    def __init__(
        self,
        q: ca.SX,
        v: ca.SX,
        mass_matrix: ca.SX,
        bias: ca.SX,
        frames: Mapping[str, ca.SX | tuple[ca.SX, ca.SX]] | None = None,
        velocity_map: ca.SX | None = None,
        actuation_matrix: FloatArray | None = None,
        parameters: tuple[Parameter, ...] = (),
        position_signals: tuple[Signal, ...] = (),
        velocity_signals: tuple[Signal, ...] = (),
        actuator_signals: tuple[Signal, ...] = (),
        effort_limits: FloatArray | None = None,
        reflected_inertia: FloatArray | None = None,
        gear_ratios: FloatArray | None = None,
        default_positions: FloatArray | None = None,
        position_limits: tuple[FloatArray, FloatArray] | None = None,
        velocity_limits: tuple[FloatArray, FloatArray] | None = None,
    ) -> None:
        for name, symbol in (("q", q), ("v", v)):
            if not is_symbol(symbol):
                raise ModelError(f"{name} must be a CasADi SX column of symbols")
        self.q, self.v, self.frames, self.parameters = q, v, dict(frames or {}), parameters
        nq, nv = q.numel(), v.numel()

        def fitting(name: str, given: Any, shape: tuple[int, ...]) -> Any:
            if given.shape != shape:
                raise ModelError(f"{name} has shape {given.shape}, expected {shape}")
            return given

        def matrix(name: str, given: ca.SX | None, shape: tuple[int, int]) -> ca.SX:
            given = ca.SX.eye(nv) if given is None else given
            return fitting(name, as_expression("LinkExpressions", name, given), shape)

        self.mass_matrix = matrix("mass_matrix", mass_matrix, (nv, nv))
        self.bias = matrix("bias", bias, (nv, 1))
        self.velocity_map = matrix("velocity_map", velocity_map, (nq, nv))
        B = numbers(
            "actuation_matrix", np.eye(nv) if actuation_matrix is None else actuation_matrix
        )
        if B.ndim != 2 or B.shape[0] != nv:
            raise ModelError(f"actuation_matrix has shape {B.shape}, expected ({nv}, nu)")
        self.actuation_matrix, nu = B, B.shape[1]
        self.position_signals = position_signals or signals([f"q{i}" for i in range(nq)])
        self.velocity_signals = velocity_signals or signals([f"v{i}" for i in range(nv)])
        self.actuator_signals = actuator_signals or signals([f"u{i}" for i in range(nu)])

        def array(name: str, given: ArrayLike | None, size: int, default: float) -> FloatArray:
            values = np.full(size, default) if given is None else numbers(name, given)
            return fitting(name, values, (size,))

        self.effort_limits = array("effort_limits", effort_limits, nu, np.inf)
        self.reflected_inertia = array("reflected_inertia", reflected_inertia, nu, 0.0)
        self.gear_ratios = array("gear_ratios", gear_ratios, nu, 1.0)
        self.default_positions = array("default_positions", default_positions, nq, 0.0)

        def limits(
            name: str, given: tuple[ArrayLike, ArrayLike] | None, size: int
        ) -> tuple[FloatArray, FloatArray]:
            lower, upper = given or (np.full(size, -np.inf), np.full(size, np.inf))
            ends = array(name, lower, size, 0.0), array(name, upper, size, 0.0)
            if not np.all(ends[0] < ends[1]):
                raise ModelError(f"{name}: the lower limits must be below the upper, got {given!r}")
            return ends

        self.position_limits = limits("position_limits", position_limits, nq)
        self.velocity_limits = limits("velocity_limits", velocity_limits, nv)
        self.outlines = tuple(Outline(name, name) for name in ("world", *self.frames))

    def rotation(self, frame: str) -> ca.SX:
        if frame == "world":
            return ca.SX.eye(3)
        pose = self._pose(frame)
        if not isinstance(pose, tuple):
            raise ModelError(f"frame '{frame}' was given as a position only; give (rotation, p)")
        return pose[0]

    def position(self, frame: str, point: ArrayLike = ORIGIN) -> ca.SX:
        offset = numbers("point", point)
        if frame == "world":
            return ca.SX(offset)
        pose = self._pose(frame)
        origin = pose[1] if isinstance(pose, tuple) else pose
        return origin + ca.mtimes(self.rotation(frame), offset) if offset.any() else origin

    def _pose(self, frame: str) -> ca.SX | tuple[ca.SX, ca.SX]:
        if frame not in self.frames:
            raise ModelError(unknown_name("frame", frame, ["world", *self.frames]))
        return self.frames[frame]

    def landmarks(self) -> ca.SX:
        return ca.horzcat(ca.SX(3, 1), *[self.position(frame) for frame in self.frames])

    def kinematics(self, acceleration: ca.SX | None = None) -> "TextbookKinematics":
        if acceleration is None:
            acceleration = ca.SX.sym("acceleration", self.v.numel())
        return TextbookKinematics(self, acceleration)


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
