"""Links of a robot: M(q), H(q, v), and frames at rest and in motion; links of equations."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.multibody.plant import MultibodyPlant

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, all_finite, numbers, unknown_name
from drake_dae.dae import Parameter, Signal, as_expression, places_of, signals
from drake_dae.dae.signals import is_symbol
from drake_dae.errors import ModelError

ORIGIN = (0.0, 0.0, 0.0)


class Frames(ABC):
    """The poses of frames, given by name, as expressions; "world" is one."""

    q: ca.SX  # Generalized positions, symbols, shape (nq, 1).
    position_signals: tuple[Signal, ...]  # Names and units of q.

    @abstractmethod
    def rotation(self, frame: Any) -> ca.SX:
        """R_WF, shape (3, 3): the orientation of a frame in the world."""

    @abstractmethod
    def position(self, frame: Any, point: ArrayLike = ORIGIN) -> ca.SX:
        """p_W in m, shape (3, 1): the position of a point that is fixed in a frame."""


def position_index(frames: Frames, name: str) -> int:
    """The index of a name among the generalized positions; ModelError if there is none."""
    return places_of("joint position", [name], frames.position_signals)[0]


@dataclass(frozen=True, eq=False)
class Application:
    """The action of lambda in the world: F = force_axes @ lambda + drag, M = moment_axes @ lambda.

    Frame A exerts F and M on frame B at the point; B exerts the opposite on A at the same point.
    """

    point: ca.SX  # m, shape (3, 1).
    force_axes: ca.SX  # N for a unit of each lambda, shape (3, m).
    moment_axes: ca.SX  # N m for a unit of each lambda, shape (3, m).
    frame_b: str
    frame_a: str = "world"
    drag: ca.SX = field(default_factory=lambda: ca.SX(3, 1))  # N, shape (3, 1).

    def force(self, constraint_force: ca.SX) -> ca.SX:
        """F in N, shape (3, 1), for constraint forces of shape (m, 1)."""
        return ca.mtimes(self.force_axes, constraint_force) + self.drag


@dataclass(frozen=True, eq=False)
class Reaction:
    """Forces that act on a robot; k columns are k reactions.

    `wrenches` are frame -> the force in N at its origin and the moment in N m on it, in the world,
    shapes (3, k).
    """

    generalized: ca.SX  # A generalized force, shape (nv, k).
    wrenches: Mapping[Any, tuple[ca.SX, ca.SX]] = field(default_factory=dict)

    def __add__(self, other: Self) -> "Reaction":
        wrenches = dict(self.wrenches)
        for frame, (force, moment) in other.wrenches.items():
            total = wrenches.get(frame, (0, 0))
            wrenches[frame] = (total[0] + force, total[1] + moment)
        return Reaction(self.generalized + other.generalized, wrenches)

    def map(self, function: Callable[[ca.SX], ca.SX]) -> "Reaction":
        """The reaction with a function applied to every expression in it."""
        wrenches = {frame: (function(f), function(m)) for frame, (f, m) in self.wrenches.items()}
        return Reaction(function(self.generalized), wrenches)


class Kinematics(Frames):
    """The frames of a robot in motion: by default the poses of its links, differentiated directly.

    1. Its expressions contain q, v, the robot's parameters, and symbols of its own for poses and
       velocities of frames; `value` replaces these by their expressions.
    2. `position` and `rotation` are functions of positions, `velocity` and `angular_velocity` are
       linear in velocities, all of them in the world: R' = w x R, and `velocity(frame, point)` is
       the time derivative of `position(frame, point)`.
    3. `derivative(e)` is the time derivative along q' = N(q) v, v' = `acceleration`, of an
       expression e of positions and velocities.
    4. `reaction(power)` are the forces with a given power, linear in velocities: tau . v = power
       with the generalized force tau that `Links` computes from them.
    5. `joint_axis` of a position is how a unit generalized force of its joint acts; None if the
       joint has several positions, or if it is not known.
    """

    def __init__(self, links: "Links", acceleration: ca.SX | None) -> None:
        if acceleration is None:
            acceleration = ca.SX.sym("acceleration", links.v.numel())
        self.q, self.v, self.acceleration = links.q, links.v, acceleration
        self.position_signals, self._links = links.position_signals, links

    def rotation(self, frame: Any) -> ca.SX:
        return self._links.rotation(frame)

    def position(self, frame: Any, point: ArrayLike = ORIGIN) -> ca.SX:
        return self._links.position(frame, point)

    def angular_velocity(self, frame: Any) -> ca.SX:
        """w in rad/s, shape (3, 1): the angular velocity of a frame, in the world."""
        rotation = self.rotation(frame)
        rate = ca.reshape(self.derivative(ca.vec(rotation)), 3, 3)
        # R' = w x R, so that R' R^T contains w.
        return ca.vertcat(
            ca.mtimes(rate[2, :], rotation[1, :].T),
            ca.mtimes(rate[0, :], rotation[2, :].T),
            ca.mtimes(rate[1, :], rotation[0, :].T),
        )

    def velocity(self, frame: Any, point: ArrayLike = ORIGIN) -> ca.SX:
        """p_W' in m/s, shape (3, 1): the velocity of a point that is fixed in a frame."""
        return self.derivative(self.position(frame, point))

    def derivative(self, expression: ca.SX) -> ca.SX:
        """The time derivative of an expression of positions and velocities, shape (k, 1)."""
        rate = ca.vertcat(ca.mtimes(self._links.velocity_map, self.v), self.acceleration)
        return ca.jtimes(expression, ca.vertcat(self.q, self.v), rate)

    def reaction(self, power: ca.SX) -> Reaction:
        """The forces on the links with a power in W that is linear in velocities."""
        return Reaction(ca.gradient(power, self.v))

    def value(self, expression: ca.SX) -> ca.SX:
        """The expression in terms of q, v, `acceleration` and parameters alone."""
        return expression

    def joint_axis(self, position: str) -> Application | None:
        """The action of the joint of a position, by its name, on the child and the parent."""
        return None

    def push(self, frame: Any, force: ca.SX, point: ArrayLike = ORIGIN) -> Reaction:
        """The reaction of a force at a point of a frame, N, in the world; it may depend on v."""
        pushing = ca.SX.sym("force", 3)
        reaction = self.reaction(ca.dot(pushing, self.velocity(frame, point)))
        return reaction.map(lambda part: ca.substitute(part, pushing, ca.densify(force)))


class Outline(NamedTuple):
    """Points of a link in one of its frames, m, shape (k, 3), and a radius around them in m."""

    name: str
    frame: Any
    points: FloatArray = np.zeros((1, 3))
    radius: float = 0.0


class Links(Frames):
    """Rigid links without contact: M(q) v' + H(q, v) = B u + R, q' = N(q) v.

    R is the generalized force of a reaction. `MultibodyExpressions` are links of a MultibodyPlant,
    `LinkExpressions` of given equations.

    1. Expressions depend on `q`, `v` and the symbols of `parameters` alone, poses of frames on `q`
       and parameters. `q` and `v` are columns of symbols.
    2. M is symmetric and positive definite in all configurations; v^T M v / 2 is the kinetic
       energy, including the rotors of `reflected_inertia`.
    3. `rotation` is a rotation, and `position(frame, point)` = `position(frame)` + R_WF point. The
       frame "world" is fixed at the origin. An unknown frame raises ModelError, which lists the
       known ones.
    4. `kinematics(acceleration)` follows the rules of `Kinematics`, with the same frames.
    5. `generalized_force` of a reaction is tau with tau . v = its power.
    6. `inverse_dynamics` of a reaction is M v' + H - tau.
    7. Signals, limits and actuator data have matching sizes; names are unique in `position_signals`
       and `velocity_signals` together.
    """

    v: ca.SX  # Generalized velocities, symbols, shape (nv, 1).
    velocity_map: ca.SX  # N(q) of q' = N(q) v, shape (nq, nv).
    mass_matrix: ca.SX  # M(q), shape (nv, nv).
    bias: ca.SX  # H(q, v), shape (nv, 1).
    actuation_matrix: FloatArray  # B, shape (nv, nu).
    parameters: tuple[Parameter, ...]  # Numbers that a study may change.
    velocity_signals: tuple[Signal, ...]  # Names and units of v.
    actuator_signals: tuple[Signal, ...]
    effort_limits: FloatArray  # Largest |u|, shape (nu,), infinite where there is no limit.
    reflected_inertia: FloatArray  # The part of M from each rotor, kg m^2 (kg), shape (nu,).
    gear_ratios: FloatArray  # Motor turns per joint turn, shape (nu,).
    default_positions: FloatArray  # A typical configuration, shape (nq,).
    position_limits: tuple[FloatArray, FloatArray]  # Lower and upper ones, shape (nq,) each.
    velocity_limits: tuple[FloatArray, FloatArray]  # The same of v, shape (nv,) each.
    plant: MultibodyPlant | None = None  # Their MultibodyPlant, for Drake's visualization.
    outlines: tuple[Outline, ...]  # Of the collision geometry of each link, or its origin.

    def landmarks(self) -> ca.SX:
        """The origins of the frames of `outlines` in m, shape (3, k), the world's first."""
        frames = dict.fromkeys(outline.frame for outline in self.outlines)
        return ca.horzcat(*[self.position(frame) for frame in frames])

    def kinematics(self, acceleration: ca.SX | None = None) -> Kinematics:
        """The frames in motion with v' = `acceleration`, a symbol of its own if None."""
        return Kinematics(self, acceleration)

    def generalized_force(self, kinematics: Any, reaction: Reaction) -> ca.SX:
        """tau of each column of a reaction in kinematics of these links, shape (nv, k)."""
        return reaction.generalized

    def inverse_dynamics(self, kinematics: Any, reaction: Reaction) -> ca.SX:
        """M(q) v' + H(q, v) - tau, shape (nv, 1), with v' of the kinematics."""  # (37)
        inertial = ca.mtimes(self.mass_matrix, kinematics.acceleration) + self.bias
        return inertial - self.generalized_force(kinematics, reaction)


def check_links(links: Links) -> None:
    """Checks signals, limits and actuator data, which can be assigned; see rule 7 of `Links`."""
    nq, nv, nu = links.q.numel(), links.v.numel(), links.actuation_matrix.shape[1]
    for kind, size in (("position", nq), ("velocity", nv), ("actuator", nu)):
        given = getattr(links, name := f"{kind}_signals")
        found = given if isinstance(given, Sequence) else ()
        if [isinstance(signal, Signal) for signal in found] != [True] * size:
            raise ModelError(f"{name} of the links must be {size} Signals, got {given!r}")
    sizes = {"effort_limits": nu, "reflected_inertia": nu, "gear_ratios": nu}
    pairs = {"position_limits": nq, "velocity_limits": nv}
    for name, size in {**sizes, "default_positions": nq, **pairs}.items():
        given = getattr(links, name)
        ends = given if name in pairs and isinstance(given, (tuple, list)) else [given]
        shapes = [isinstance(e, np.ndarray) and e.dtype.kind in "iuf" and e.shape for e in ends]
        if shapes != [(size,)] * (1 + (name in pairs)):
            what = "a lower and an upper NumPy array" if name in pairs else "a NumPy array"
            raise ModelError(f"{name} of the links must be {what} of {size} numbers, got {given!r}")
        if np.any(np.isnan(ends)) or not ("limits" in name or all_finite(ends[0])):
            right = "numbers or inf" if "limits" in name else "finite numbers"
            raise ModelError(f"{name} of the links must be {right}, got {given!r}")
        if name in pairs and np.any(ends[0] > ends[1]):
            raise ModelError(f"{name} of the links: a lower limit is above the upper: {given!r}")
        if name == "effort_limits" and np.any(given < 0.0):
            raise ModelError(f"{name} of the links must be 0 or more, got {given!r}")


def velocities_are_rates(links: Links) -> bool:
    """Whether q' = v: no body has q' = N(q) v."""
    slope = links.velocity_map - ca.SX.eye(links.velocity_map.shape[0])
    return bool(ca.simplify(slope).is_zero())


@checked(ModelError)
class LinkExpressions(Links):
    """Links with given M(q) and H(q, v), as in a textbook; see `Links`.

    Signals are named q0, v0, u0 and so on; there are no limits, no rotors and no gears. Assign to
    the attributes of `Links` for others, before the links are used.

    Args:
        q: Generalized positions, SX symbols, shape (nq, 1).
        v: Generalized velocities, SX symbols, shape (nv, 1).
        mass_matrix: M(q), shape (nv, nv), symmetric positive definite.
        bias: H(q, v): Coriolis, centripetal, gravity and friction forces, shape (nv, 1).
        frames: Name -> position p_W(q) in m, shape (3, 1), or (rotation R_WF(q), position).
        velocity_map: N(q) of q' = N(q) v, shape (nq, nv); the identity if None.
        actuation_matrix: B of M v' + H = B u, shape (nv, nu); the identity if None.
        parameters: The parameters of the expressions.

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
    ) -> None:
        for name, symbol in (("q", q), ("v", v)):
            if not is_symbol(symbol):
                raise ModelError(f"{name} must be a CasADi SX column of symbols")
        self.q, self.v, self.parameters = q, v, parameters
        world = {"world": (ca.SX.eye(3), ca.SX(3, 1))}
        self.frames = world | dict(frames or {}) | world
        self.outlines = tuple(Outline(name, name) for name in self.frames)
        nq, nv = q.numel(), v.numel()

        def matrix(name: str, given: ca.SX | None, shape: tuple[int, int]) -> ca.SX:
            given = ca.SX.eye(nv) if given is None else given
            value = as_expression("LinkExpressions", name, given)
            if value.shape != shape:
                raise ModelError(f"{name} has shape {value.shape}, expected {shape}")
            return value

        self.mass_matrix = matrix("mass_matrix", mass_matrix, (nv, nv))
        self.bias = matrix("bias", bias, (nv, 1))
        self.velocity_map = matrix("velocity_map", velocity_map, (nq, nv))
        given = np.eye(nv) if actuation_matrix is None else actuation_matrix
        self.actuation_matrix = numbers("actuation_matrix", given)
        if self.actuation_matrix.ndim != 2 or len(self.actuation_matrix) != nv:
            shape = self.actuation_matrix.shape
            raise ModelError(f"actuation_matrix has shape {shape}, expected ({nv}, nu)")
        nu = self.actuation_matrix.shape[1]
        self.position_signals = signals([f"q{i}" for i in range(nq)])
        self.velocity_signals = signals([f"v{i}" for i in range(nv)])
        self.actuator_signals = signals([f"u{i}" for i in range(nu)])
        self.effort_limits = np.full(nu, np.inf)
        self.reflected_inertia, self.gear_ratios = np.zeros(nu), np.ones(nu)
        self.default_positions = np.zeros(nq)
        self.position_limits = np.full(nq, -np.inf), np.full(nq, np.inf)
        self.velocity_limits = np.full(nv, -np.inf), np.full(nv, np.inf)

    def _pose(self, frame: str) -> ca.SX | tuple[ca.SX, ca.SX]:
        if frame not in self.frames:
            raise ModelError(unknown_name("frame", frame, self.frames))
        return self.frames[frame]

    def rotation(self, frame: str) -> ca.SX:
        pose = self._pose(frame)
        if not isinstance(pose, tuple):
            raise ModelError(f"frame '{frame}' was given as a position only; give (rotation, p)")
        return pose[0]

    def position(self, frame: str, point: ArrayLike = ORIGIN) -> ca.SX:
        offset, pose = numbers("point", point), self._pose(frame)
        origin = pose[1] if isinstance(pose, tuple) else pose
        return origin + ca.mtimes(self.rotation(frame), offset) if offset.any() else origin
