"""A robot given by its own equations."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arrays import FloatArray
from drake_dae.dae.signals import Parameter, Signal, signals
from drake_dae.errors import ModelError
from drake_dae.robots.links.links import Residual


@dataclass(frozen=True, eq=False)
class LinkExpressions:
    """A robot given by its own M(q) and H(q, v), as in a textbook.

    Attributes:
        q: Generalized positions, SX symbols, shape (nq, 1).
        v: Generalized velocities, SX symbols, shape (nv, 1).
        mass_matrix: M(q), shape (nv, nv), symmetric positive definite.
        bias: H(q, v): Coriolis, centripetal, gravity and friction forces, shape (nv, 1).
        frames: Name -> position p_W(q) in m, shape (3, 1), or (rotation R_WF(q), position).
        velocity_map: N(q) of q' = N(q) v, shape (nq, nv); the identity if None.
        actuation_matrix: B of M v' + H = B u, shape (nv, nu); the identity if None.
        parameters: Parameters of the expressions.
        position_signals, velocity_signals, actuator_signals: Names and units; made up if empty.
        effort_limits: Largest |u|, shape (nu,); infinite if None.
        reflected_inertia: What of M(q) is rotors, kg m^2 (kg), shape (nu,); 0 if None.
        gear_ratios: Motor turns per joint turn, shape (nu,); 1 if None.
        default_positions: A usual configuration, shape (nq,); zero if None.
        position_limits, velocity_limits: Lower and upper, shapes (nq,) and (nv,); none if None.

    Raises:
        ModelError: A shape that does not fit.
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

    def __post_init__(self) -> None:
        nq, nv = self.q.numel(), self.v.numel()
        actuation = np.eye(nv) if self.actuation_matrix is None else self.actuation_matrix
        actuation = np.array(actuation, dtype=float)
        if actuation.ndim != 2 or actuation.shape[0] != nv:
            raise ModelError(f"actuation_matrix has shape {actuation.shape}, expected ({nv}, nu)")
        nu = actuation.shape[1]
        fill = {
            "velocity_map": ca.SX.eye(nv) if self.velocity_map is None else self.velocity_map,
            "actuation_matrix": actuation,
            "position_signals": self.position_signals or signals([f"q{i}" for i in range(nq)]),
            "velocity_signals": self.velocity_signals or signals([f"v{i}" for i in range(nv)]),
            "actuator_signals": self.actuator_signals or signals([f"u{i}" for i in range(nu)]),
            "effort_limits": _numbers(self.effort_limits, nu, np.inf),
            "reflected_inertia": _numbers(self.reflected_inertia, nu, 0.0),
            "gear_ratios": _numbers(self.gear_ratios, nu, 1.0),
            "default_positions": _numbers(self.default_positions, nq, 0.0),
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
            found = getattr(self, key).shape
            if found != shape:
                raise ModelError(f"{key} has shape {found}, expected {shape}")

    def rotation(self, frame: str) -> ca.SX:
        """R_WF(q), shape (3, 3).

        Raises:
            ModelError: An unknown frame, or one given without a rotation.
        """
        if frame == "world":
            return ca.SX.eye(3)
        pose = self._pose(frame)
        if not isinstance(pose, tuple):
            raise ModelError(f"frame '{frame}' was given as a position only; give (rotation, p)")
        return pose[0]

    def position(self, frame: str, point: ArrayLike = (0.0, 0.0, 0.0)) -> ca.SX:
        """Position in the world of a point that is fixed in a frame, m, shape (3, 1).

        Raises:
            ModelError: An unknown frame, or a point off the origin of one without rotation.
        """
        offset = np.asarray(point, dtype=float)
        if frame == "world":
            return ca.SX(offset)
        pose = self._pose(frame)
        origin = pose[1] if isinstance(pose, tuple) else pose
        return origin + ca.mtimes(self.rotation(frame), offset) if offset.any() else origin

    def jacobian(self, phi: Residual) -> ca.SX:
        """J = (dphi/dq) N of constraints phi(q), shape (m, nv)."""
        return ca.mtimes(ca.jacobian(phi(self), self.q), self.velocity_map)

    def motion(self, acceleration: ca.SX, phi: Residual, multiplier: ca.SX) -> tuple[ca.SX, ca.SX]:
        """M(q) v' + H(q, v) - J(q)^T lambda of (37), shape (nv, 1), and phi'', shape (m, 1)."""
        residual, velocity = phi(self), ca.mtimes(self.velocity_map, self.v)
        reaction = ca.jtimes(residual, self.q, multiplier, True)
        inertial = ca.mtimes(self.mass_matrix, acceleration) + self.bias
        rate, moving = ca.jtimes(residual, self.q, velocity), ca.vertcat(self.q, self.v)
        twice = ca.jtimes(rate, moving, ca.vertcat(velocity, acceleration))
        return inertial - ca.mtimes(self.velocity_map.T, reaction), twice

    def _pose(self, frame: str) -> ca.SX | tuple[ca.SX, ca.SX]:
        if frame not in self.frames:
            near = get_close_matches(frame, self.frames, n=1)
            hint = f"did you mean '{near[0]}'? " if near else ""
            raise ModelError(
                f"no frame '{frame}'; {hint}frames: {', '.join(['world', *self.frames])}"
            )
        return self.frames[frame]


def _numbers(given: ArrayLike | None, size: int, default: float) -> FloatArray:
    return np.full(size, default) if given is None else np.array(given, dtype=float)


def _limits(
    name: str, given: tuple[ArrayLike, ArrayLike] | None, size: int
) -> tuple[FloatArray, FloatArray]:
    lower, upper = (np.full(size, end) for end in (-np.inf, np.inf))
    if given is not None:
        lower, upper = (np.array(end, dtype=float) for end in given)
    if lower.shape != (size,) or upper.shape != (size,) or not np.all(lower < upper):
        raise ModelError(
            f"{name} must be a lower and an upper limit of shape ({size},), the lower one below, "
            f"got {given!r}"
        )
    return lower, upper
