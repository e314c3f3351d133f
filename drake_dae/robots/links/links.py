"""The contract of the links of a robot: M(q), H(q, v), and their frames."""

from typing import Any, Protocol

import casadi as ca
from pydrake.multibody.plant import MultibodyPlant

from drake_dae.arrays import FloatArray
from drake_dae.dae import Parameter, Signal
from drake_dae.robots.links.articulated import ArticulatedBodies
from drake_dae.robots.links.frames import Outline
from drake_dae.robots.links.kinematics import Frames, Kinematics, Reaction


class Links(Frames, Protocol):
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
    7. `articulated_bodies` are factors of M, if the links have them.
    8. Signals, limits and actuator data have matching sizes; names are unique in `position_signals`
       and `velocity_signals` together.
    """

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
        """The part of M from the rotor of each actuator, kg m^2 (kg), shape (nu,)."""

    @property
    def gear_ratios(self) -> FloatArray:
        """Motor turns per joint turn, shape (nu,)."""

    @property
    def default_positions(self) -> FloatArray:
        """A typical configuration, shape (nq,)."""

    @property
    def position_limits(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper limit of q, shape (nq,) each."""

    @property
    def velocity_limits(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper limit of v, shape (nv,) each."""

    @property
    def plant(self) -> MultibodyPlant | None:
        """Their MultibodyPlant, for Drake's visualization; None without one."""

    def articulated_bodies(self, rotors: FloatArray) -> ArticulatedBodies | None:
        """Factors of M by the articulated-body algorithm; None if they are not known.

        Args:
            rotors: The addition of the rotors to the diagonal of M, shape (nv,).
        """

    def landmarks(self) -> ca.SX:
        """Points of the robot for views of it, in m, shape (3, k)."""

    @property
    def landmark_names(self) -> tuple[str, ...]:
        """The names of the frames whose origins the landmarks are, k of them."""

    @property
    def outlines(self) -> tuple[Outline, ...]:
        """Points of the collision geometry of each link, of one without any its origin."""

    def kinematics(self, acceleration: ca.SX | None = None) -> Kinematics:
        """The frames in motion, in which constraints are expressed.

        Args:
            acceleration: v', shape (nv, 1); a symbol of its own if None.
        """

    def generalized_force(self, kinematics: Any, reaction: Reaction) -> ca.SX:
        """tau of each column of a reaction, shape (nv, k).

        Args:
            kinematics: The kinematics of the reaction, made by these links.
            reaction: Forces that act on the links.
        """

    def inverse_dynamics(self, kinematics: Any, reaction: Reaction) -> ca.SX:
        """M(q) v' + H(q, v) - tau of (37), shape (nv, 1), with v' of the kinematics.

        Args:
            kinematics: The kinematics of the reaction, made by these links.
            reaction: Forces that act on the links, one column.
        """


def velocities_are_rates(links: Links) -> bool:
    """Whether q' = v: no body has q' = N(q) v."""
    slope = links.velocity_map - ca.SX.eye(links.velocity_map.shape[0])
    return bool(ca.simplify(slope).is_zero())
