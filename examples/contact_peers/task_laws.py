"""Laws of the textbooks in the coordinates of the task, each with the exact model of the robot.

All feed the wall's force forward, with the friction in which they believe, and hold the posture of
the arm in the null space of the task. Gains are accelerations per error, or bandwidths, in 1/s.
"""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from pydrake.systems.framework import BasicVector, Context, EventStatus, LeafSystem, State
from scipy.linalg import eigh

from contact_peers.plants import PERIOD
from contact_peers.robot import NORMAL, Goal, Goals, Robot, RobotState
from drake_dae.arrays import FloatArray
from drake_dae.systems.blocks.lifetime import SHARED_DICTIONARY, weakly


class TaskLaw(LeafSystem):
    """A law u = control(robot, goal, measured force, memory), whose memory grows by a rate.

    Input ports:
        estimated_state: x = (q, v), shape (14,).
        reference: R of our law, shape (19,).
        measured_force: Shape (1,).

    Output port:
        control: u, N m, shape (7,).

    Args:
        robot: The robot as the law knows it.
        goals: What the task wants.
        gains: Name -> number; the names are those of `LIMITS`.
        start: x where the task begins, shape (14,).
    """

    __slots__ = SHARED_DICTIONARY

    LIMITS: ClassVar[Mapping[str, tuple[float, float]]] = {}
    """Name of a gain -> where it is sought."""

    MEMORY: ClassVar[int] = 0

    KNOWS: ClassVar[bool] = True
    """Whether its gains are sought with the friction known."""

    def __init__(
        self, robot: Robot, goals: Goals, gains: Mapping[str, float], start: FloatArray
    ) -> None:
        super().__init__()
        self.robot, self.goals, self.gains = robot, goals, dict(gains)
        sizes = {"estimated_state": 14, "reference": 19, "measured_force": 1}
        self._evaluate = [self.DeclareVectorInputPort(*item).Eval for item in sizes.items()]
        self.DeclareDiscreteState(self.MEMORY)
        self.DeclareVectorOutputPort("control", 7, weakly(self._calc_control))
        if self.MEMORY:
            # Unrestricted, as the step of a discrete MultibodyPlant: so both see one instant.
            self.DeclarePeriodicUnrestrictedUpdateEvent(PERIOD, 0.0, weakly(self._remember))

    def control(
        self, robot: RobotState, goal: Goal, force: float, memory: FloatArray
    ) -> FloatArray:
        """u, shape (7,)."""
        raise NotImplementedError

    def rate(self, goal: Goal, force: float, memory: FloatArray) -> FloatArray:
        """What the memory grows by per second."""
        raise NotImplementedError

    def _now(self, context: Context) -> tuple[FloatArray, Goal, float, FloatArray]:
        state, reference, force = (evaluate(context) for evaluate in self._evaluate)
        memory = context.get_discrete_state(0).CopyToVector()
        return state, self.goals.at(reference), float(force[0]), memory

    def _calc_control(self, context: Context, output: BasicVector) -> None:
        state, goal, force, memory = self._now(context)
        output.SetFromVector(self.control(self.robot.at(state), goal, force, memory))

    def _remember(self, context: Context, state: State) -> EventStatus:
        now, goal, force, memory = self._now(context)
        after = self.next_memory(self.robot.at(now), goal, force, memory)
        state.get_mutable_discrete_state().set_value(0, after)
        return EventStatus.Succeeded()

    def next_memory(
        self, robot: RobotState, goal: Goal, force: float, memory: FloatArray
    ) -> FloatArray:
        """The memory of the next sample."""
        return memory + PERIOD * self.rate(goal, force, memory)


def posture(robot: RobotState, goal: Goal, rate: float) -> FloatArray:
    """The accelerations of the joints that lead to the posture of the task, shape (7,)."""
    off, slip = goal.q - robot.q, goal.v - robot.v
    return goal.acceleration_of_joints + 2.0 * rate * slip + rate**2 * off


def operational(
    robot: RobotState, forces: FloatArray, free: FloatArray, contact: FloatArray
) -> FloatArray:
    """u of operational-space forces, with the free accelerations in their null space (Khatib).

    u = bias - J_p^T contact + J^T forces + N^T M free,    N^T = 1 - J^T Lambda J M^-1.
    """
    pull = robot.mass @ free
    seen = robot.inertia @ (robot.jacobian @ free)
    return robot.bias + robot.jacobian.T @ (forces - seen) + pull - robot.jacobian[:3].T @ contact


class Hybrid(TaskLaw):
    """Hybrid position and force control (Raibert and Craig, Khatib) with PI control of the force.

    Along the wall x'' = x_d'' + 2 w e' + w^2 e; into it x'' = -d x', under the force
    f = f_d + K_p (f_d - f_m) + K_i int (f_d - f_m), with K_i = (1 + K_p) w_f.
    """

    LIMITS: ClassVar = {
        "motion": (8.0, 25.0),
        "force_rate": (2.0, 25.0),
        "force_gain": (0.01, 0.5),
        "damping": (20.0, 120.0),
    }
    MEMORY = 1

    def control(
        self, robot: RobotState, goal: Goal, force: float, memory: FloatArray
    ) -> FloatArray:
        rate, gain = self.gains["motion"], self.gains["force_gain"]
        wanted = critically_damped(robot, goal, rate)
        wanted[0] = -self.gains["damping"] * robot.velocity[0]
        pushed = gain * (goal.force - force)
        pushed += (1.0 + gain) * self.gains["force_rate"] * memory[0]
        forces = robot.inertia @ (wanted - robot.drift)
        contact = goal.contact + pushed * NORMAL
        return operational(robot, forces, posture(robot, goal, rate), contact)

    def rate(self, goal: Goal, force: float, memory: FloatArray) -> FloatArray:
        return np.array([goal.force - force])


def critically_damped(robot: RobotState, goal: Goal, rate: float) -> FloatArray:
    """x_d'' + 2 w (x_d' - x') + w^2 (x_d - x), shape (5,)."""
    slip, off = goal.velocity - robot.velocity, goal.position - robot.position
    return goal.acceleration + 2.0 * rate * slip + rate**2 * off


class Impedance(TaskLaw):
    """Impedance control (Hogan) without shaping of the inertia, with the force fed forward.

    Lambda (x'' - x_d'') + D (x' - x_d') + K (x - x_d) = what pushes. K_i = w_i^2 Lambda_ii is
    constant, with Lambda at the start; D gives all modes one damping ratio (double diagonalization,
    Albu-Schaeffer), and the contact d Lambda_xx besides.
    """

    LIMITS: ClassVar = {
        "normal": (0.3, 10.0),
        "normal_damping": (10.0, 120.0),
        "motion": (8.0, 25.0),
        "axis": (4.0, 25.0),
        "damping_ratio": (0.3, 1.5),
    }

    def __init__(
        self, robot: Robot, goals: Goals, gains: Mapping[str, float], start: FloatArray
    ) -> None:
        super().__init__(robot, goals, gains, start)
        masses = np.diag(robot.at(start).inertia)
        rates = np.array([gains[name] for name in ("normal", *2 * ["motion"], *2 * ["axis"])])
        self._stiffness = masses * rates**2
        self._at_contact = masses[0] * gains["normal_damping"]

    def control(
        self, robot: RobotState, goal: Goal, force: float, memory: FloatArray
    ) -> FloatArray:
        damping = modal_damping(robot.inertia, self._stiffness, self.gains["damping_ratio"])
        damping[0, 0] += self._at_contact
        forces = robot.inertia @ (goal.acceleration - robot.drift)
        forces += self._stiffness * (goal.position - robot.position)
        forces += damping @ (goal.velocity - robot.velocity)
        free = posture(robot, goal, self.gains["motion"])
        return operational(robot, forces, free, goal.contact)


def modal_damping(inertia: FloatArray, stiffness: FloatArray, ratio: float) -> FloatArray:
    """D with which each mode of Lambda s^2 + D s + diag(K) has one damping ratio, shape (k, k)."""
    squares, modes = eigh(np.diag(stiffness), inertia)
    seen = inertia @ modes
    return seen @ np.diag(2.0 * ratio * np.sqrt(squares)) @ seen.T


class WithObserver(TaskLaw):
    """Another law, less the disturbance torque r of a momentum observer (De Luca and Mattone).

    With p = M v, r' = w (p' - M' v - u - J_p^T F + bias - r), where u is what acts, and F the
    measured force with the friction of the goal. In samples (M v)' - M' v is M times the difference
    of v. The memory after that of the law is v, the last two controls, r, and 1 after the first.
    """

    KNOWS = False
    LAW: ClassVar[type[TaskLaw]]

    def __init__(
        self, robot: Robot, goals: Goals, gains: Mapping[str, float], start: FloatArray
    ) -> None:
        super().__init__(robot, goals, gains, start)
        self._law = self.LAW(robot, goals, gains, start)

    def control(
        self, robot: RobotState, goal: Goal, force: float, memory: FloatArray
    ) -> FloatArray:
        size = self._law.MEMORY
        known: FloatArray = self._law.control(robot, goal, force, memory[:size])
        return known - memory[size:-1].reshape(4, 7)[3]

    def next_memory(
        self, robot: RobotState, goal: Goal, force: float, memory: FloatArray
    ) -> FloatArray:
        size = self._law.MEMORY
        inner = memory[:size]
        if size:
            inner = self._law.next_memory(robot, goal, force, inner)
        velocity, before, acting, r = memory[size:-1].reshape(4, 7)
        contact = robot.jacobian[:3].T @ (goal.contact * force / goal.force)
        d = robot.mass @ (robot.v - velocity) / PERIOD - acting - contact + robot.bias
        share = 1.0 - np.exp(-self.gains["observer"] * PERIOD)
        r = r + memory[-1] * share * (d - r)
        control = self.control(robot, goal, force, memory)
        return np.concatenate([inner, robot.v, control, before, r, [1.0]])


class HybridWithObserver(WithObserver):
    """`Hybrid` with a momentum observer."""

    LAW = Hybrid
    LIMITS: ClassVar = {**Hybrid.LIMITS, "observer": (5.0, 200.0)}
    MEMORY = Hybrid.MEMORY + 29


class ImpedanceWithObserver(WithObserver):
    """`Impedance` with a momentum observer."""

    LAW = Impedance
    LIMITS: ClassVar = {**Impedance.LIMITS, "observer": (5.0, 200.0)}
    MEMORY = 29


class Admittance(TaskLaw):
    """Admittance control: what the force lacks moves the goal of a position law into the wall,

    x_c'' + d x_c' = g (f_d - f_m),    x'' = (x_d + x_c)'' + 2 zeta w e' + w^2 e.
    """

    LIMITS: ClassVar = {
        "motion": (8.0, 25.0),
        "damping_ratio": (0.5, 1.5),
        "admittance": (1e-3, 0.3),
        "damping": (10.0, 150.0),
    }
    MEMORY = 2

    def control(
        self, robot: RobotState, goal: Goal, force: float, memory: FloatArray
    ) -> FloatArray:
        rate = self.gains["motion"]
        off, slip = goal.position - robot.position, goal.velocity - robot.velocity
        wanted = goal.acceleration.copy()
        off[0] += memory[0]
        slip[0] += memory[1]
        wanted[0] += self.rate(goal, force, memory)[1]
        wanted += 2.0 * self.gains["damping_ratio"] * rate * slip + rate**2 * off
        forces = robot.inertia @ (wanted - robot.drift)
        return operational(robot, forces, posture(robot, goal, rate), goal.contact)

    def rate(self, goal: Goal, force: float, memory: FloatArray) -> FloatArray:
        lacking = self.gains["admittance"] * (goal.force - force)
        return np.array([memory[1], lacking - self.gains["damping"] * memory[1]])


class LeastSquares(TaskLaw):
    """Inverse dynamics by least squares over accelerations, torques and the force, as of TSID.

    min |J_t v' + J_t' v - a|^2 + p |v' - a_posture|^2 + |f - f_d|^2 over (v', u, f), subject to
    M v' + bias = u + G f and to the contact, J_x v' + J_x' v = -d x' - c^2 (x - x_d); a has double
    poles. The task, the posture and the force can be had at once, so that weights do not matter.
    """

    LIMITS: ClassVar = {
        "motion": (8.0, 25.0),
        "damping_ratio": (0.5, 1.5),
        "contact": (0.1, 10.0),
        "contact_damping": (20.0, 120.0),
    }

    def control(
        self, robot: RobotState, goal: Goal, force: float, memory: FloatArray
    ) -> FloatArray:
        gains, rate = self.gains, self.gains["motion"]
        off, slip = goal.position - robot.position, goal.velocity - robot.velocity
        wanted = goal.acceleration + 2.0 * gains["damping_ratio"] * rate * slip + rate**2 * off
        held = gains["contact_damping"] * slip[0] + gains["contact"] ** 2 * off[0]
        per_force = robot.jacobian[:3].T @ (goal.contact / goal.force)
        return least_squares(
            robot,
            (robot.jacobian[1:], wanted[1:] - robot.drift[1:]),
            (robot.jacobian[:1], held - robot.drift[:1]),
            posture(robot, goal, rate),
            per_force,
            goal.force,
        )


def least_squares(
    robot: RobotState,
    task: tuple[FloatArray, FloatArray],
    held: tuple[FloatArray, FloatArray],
    free: FloatArray,
    per_force: FloatArray,
    force: float,
    weight: float = 1e-4,
) -> FloatArray:
    """u of the problem in `LeastSquares`, by its conditions of optimality, shape (7,).

    Args:
        robot: M and bias.
        task: The rows A and a of |A v' - a|^2.
        held: The rows C and c of C v' = c.
        free: The accelerations of the joints wanted besides, shape (7,).
        per_force: G, shape (7,).
        force: f_d, N.
        weight: p.
    """
    joints, contacts = free.size, held[1].size
    size = 2 * joints + 1
    cost = np.zeros((size, size))
    cost[:joints, :joints] = task[0].T @ task[0] + weight * np.eye(joints)
    cost[-1, -1] = 1.0
    slope = np.concatenate([task[0].T @ task[1] + weight * free, np.zeros(joints), [force]])
    rows = np.zeros((joints + contacts, size))
    rows[:joints] = np.hstack([robot.mass, -np.eye(joints), -per_force[:, None]])
    rows[joints:, :joints] = held[0]
    none = np.zeros((joints + contacts, joints + contacts))
    whole = np.block([[cost, rows.T], [rows, none]])
    found = np.linalg.solve(whole, np.concatenate([slope, -robot.bias, held[1]]))
    return found[joints : 2 * joints]
