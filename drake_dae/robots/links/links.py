"""What the links of a robot provide: M(q), H(q, v), and their frames."""

from typing import Any, Protocol

import casadi as ca
from pydrake.multibody.plant import MultibodyPlant

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.signals import Parameter, Signal
from drake_dae.robots.links.kinematics import Frames, Kinematics, Reaction


class Links(Frames, Protocol):
    """Rigid links and nothing that they touch: M(q) v' + H(q, v) = B u + R, q' = N(q) v.

    R is the generalized force of a reaction. `MultibodyExpressions` takes links from a
    MultibodyPlant, `LinkExpressions` from equations.

    1. Expressions depend on `q`, `v` and the symbols of `parameters` alone, poses of frames on `q`
       and parameters. `q` and `v` are columns of symbols.
    2. M is symmetric, and positive definite wherever the robot can be; v^T M v / 2 is its kinetic
       energy, with the rotors of `reflected_inertia` in it.
    3. `rotation` is a rotation, and `position(frame, point)` = `position(frame)` + R_WF point. The
       frame "world" stands still at the origin. A frame that is not known raises ModelError, which
       names those that are.
    4. `kinematics(acceleration)` keeps the rules of `Kinematics`, with the same frames.
    5. `generalized_force` of a reaction is tau with tau . v = its power.
    6. `inverse_dynamics` of a reaction is M v' + H - tau.
    7. Signals, limits and numbers of actuators have the sizes of what they are about; a name stands
       once in `position_signals` and `velocity_signals` together.
    """

    @property
    def q(self) -> ca.SX:
        """Generalized positions, symbols, shape (nq, 1)."""

    @property
    def v(self) -> ca.SX:
        """Generalized velocities, symbols, shape (nv, 1)."""

    @property
    def velocity_map(self) -> ca.SX:
        """N(q) of q' = N(q) v, shape (nq, nv)."""

    @property
    def mass_matrix(self) -> ca.SX:
        """M(q), shape (nv, nv)."""

    @property
    def bias(self) -> ca.SX:
        """H(q, v), shape (nv, 1)."""

    @property
    def actuation_matrix(self) -> FloatArray:
        """B, shape (nv, nu)."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Numbers that a study may change."""

    @property
    def position_signals(self) -> tuple[Signal, ...]:
        """Names and units of q."""

    @property
    def velocity_signals(self) -> tuple[Signal, ...]:
        """Names and units of v."""

    @property
    def actuator_signals(self) -> tuple[Signal, ...]:
        """Names and units of u."""

    @property
    def effort_limits(self) -> FloatArray:
        """Largest |u|, shape (nu,), infinite where there is no limit."""

    @property
    def reflected_inertia(self) -> FloatArray:
        """What of M is the rotor of each actuator, kg m^2 (kg), shape (nu,)."""

    @property
    def gear_ratios(self) -> FloatArray:
        """Motor turns per joint turn, shape (nu,)."""

    @property
    def default_positions(self) -> FloatArray:
        """A usual configuration, shape (nq,)."""

    @property
    def position_limits(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper limit of q, shape (nq,) each."""

    @property
    def velocity_limits(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper limit of v, shape (nv,) each."""

    @property
    def plant(self) -> MultibodyPlant | None:
        """The plant that they come from, for Drake's picture of them; None if there is none."""

    def landmarks(self) -> ca.SX:
        """Points of the robot that show where it is, in m, shape (3, k): for a view of it."""

    @property
    def landmark_names(self) -> tuple[str, ...]:
        """The names of the frames whose origins the landmarks are, k of them."""

    def kinematics(self, acceleration: ca.SX | None = None) -> Kinematics:
        """The frames in motion, in which constraints are written.

        Args:
            acceleration: v', shape (nv, 1); a symbol of its own if None.
        """

    def generalized_force(self, kinematics: Any, reaction: Reaction) -> ca.SX:
        """tau of each column of a reaction, shape (nv, k).

        Args:
            kinematics: What the reaction is written in, made by these links.
            reaction: Forces that act on the links.
        """

    def inverse_dynamics(self, kinematics: Any, reaction: Reaction) -> ca.SX:
        """M(q) v' + H(q, v) - tau of (37), shape (nv, 1), with v' of the kinematics.

        Args:
            kinematics: What the reaction is written in, made by these links.
            reaction: Forces that act on the links, one column.
        """
