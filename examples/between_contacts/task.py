"""The task, and how a plan is judged: by Drake's MultibodyPlant and an integrator of SciPy."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable
from scipy.integrate import solve_ivp

import drake_dae as dd

WALL = 1.2
"""Where the wall is, in m along x."""

LOW, HIGH = 0.0, 0.6
"""Heights of the tool at both contacts, in m."""

LEAST, MOST = 5.0, 50.0
"""Contact force, in N."""

DURATION = 1.0
"""In s."""

Signal = Callable[[float], np.ndarray]


@dataclass(frozen=True)
class Plan:
    """What a method found.

    Attributes:
        name: The method.
        seconds: How long it took, in s.
        state, control, force: The motion (q, v), the torques and the contact force by the time.
        breaks: Times between which these are smooth.
        converged: Whether the method says that it has converged.
    """

    name: str
    seconds: float
    state: Signal
    control: Signal
    force: Signal
    breaks: np.ndarray
    converged: bool


@dataclass(frozen=True)
class Judged:
    """What a plan is worth.

    Attributes:
        cost: The integral of |u|^2, in (N m)^2 s.
        between: The largest distance of the planned motion from the wall, in m.
        drifts: The largest distance from the wall of the arm without the wall, under the planned
            torques and contact force, in m.
        misses: By how much the arm on the wall misses the second contact under the planned torques,
            in m.
        least, most: The least and the largest contact force that it then has, in N.
    """

    cost: float
    between: float
    drifts: float
    misses: float
    least: float
    most: float


def robot() -> MultibodyPlant:
    """The two-link arm."""
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModels(str(dd.shipped_model("two_link_arm.urdf")))
    plant.Finalize()
    return plant


def robot_model() -> dd.RobotModel:
    """The arm with its tool on the wall."""
    wall = dd.PointOnSurface("tool", dd.Plane((WALL, 0, 0), (-1, 0, 0)), name="wall")
    heights = [dd.PointCoordinates("tool", axes="z")]
    return dd.RobotModel.from_multibody(
        robot(), [wall], outputs=heights, nominal_positions=[1.2, -1.6]
    )


def ends(model: dd.RobotModel) -> tuple[np.ndarray, np.ndarray]:
    """The states at rest at both contacts."""
    first = model.configuration([LOW], guess=[1.2, -1.6])
    last = model.configuration([HIGH], guess=first)
    return np.append(first, [0.0, 0.0]), np.append(last, [0.0, 0.0])


class Arm:
    """The arm's equations by Drake: M v' + bias = u + J^T force, and its tool."""

    def __init__(self) -> None:
        self._plant = robot()
        self._context = self._plant.CreateDefaultContext()
        self._tool = self._plant.GetFrameByName("tool")

    def _at(self, state: np.ndarray) -> None:
        self._plant.SetPositionsAndVelocities(self._context, state)

    def tool(self, state: np.ndarray) -> np.ndarray:
        """Where the tool is, (x, z) in m."""
        self._at(state)
        place = self._plant.CalcRelativeTransform(
            self._context, self._plant.world_frame(), self._tool
        )
        return place.translation()[[0, 2]]

    def _terms(self, state: np.ndarray) -> tuple[np.ndarray, ...]:
        plant, context = self._plant, self._context
        self._at(state)
        mass = plant.CalcMassMatrix(context)
        bias = plant.CalcBiasTerm(context) - plant.CalcGravityGeneralizedForces(context)
        world, by = plant.world_frame(), JacobianWrtVariable.kV
        given = context, by, self._tool, np.zeros(3), world, world
        # The constraint is the distance to the wall, WALL - x.
        slope = -plant.CalcJacobianTranslationalVelocity(*given)[0]
        drift = -plant.CalcBiasTranslationalAcceleration(*given)[0, 0]
        return mass, bias, slope, drift

    def rate(self, state: np.ndarray, control: np.ndarray, force: float) -> np.ndarray:
        """(q', v') under a contact force that is given."""
        mass, bias, slope, _ = self._terms(state)
        return np.append(state[2:], np.linalg.solve(mass, control - bias + slope * force))

    def force(self, state: np.ndarray, control: np.ndarray) -> float:
        """The contact force with which the tool stays on the wall."""
        mass, bias, slope, drift = self._terms(state)
        away = np.linalg.solve(mass, np.column_stack([control - bias, slope]))
        return float(-(slope @ away[:, 0] + drift) / (slope @ away[:, 1]))


def judge(plan: Plan, start: np.ndarray) -> Judged:
    """Integrates a plan with errors of 1e-11, piece by piece."""
    arm = Arm()

    def under(force_at: Callable[[float, np.ndarray], float]) -> tuple[np.ndarray, np.ndarray]:
        """Times and states of the arm under the planned torques."""
        x, times, states = start, [0.0], [start]
        for first, last in zip(plan.breaks[:-1], plan.breaks[1:], strict=True):
            inside = np.nextafter(last, first)

            def rate(t: float, s: np.ndarray, end: float = inside) -> np.ndarray:
                t = min(t, end)  # The next piece begins with other torques.
                return arm.rate(s, plan.control(t), force_at(t, s))

            found = solve_ivp(rate, (first, last), x, method="DOP853", rtol=1e-11, atol=1e-11)
            x = found.y[:, -1]
            times += found.t[1:].tolist()
            states += list(found.y.T[1:])
        return np.array(times), np.array(states)

    def off(states: np.ndarray) -> float:
        return float(max(abs(arm.tool(s)[0] - WALL) for s in states))

    moments = np.linspace(0.0, DURATION, 2001)[:-1]
    _, free = under(lambda t, s: float(plan.force(t)))
    times, held = under(lambda t, s: arm.force(s, plan.control(t)))
    forces = [arm.force(s, plan.control(t)) for t, s in zip(times[:-1], held[:-1], strict=True)]
    return Judged(
        float(np.mean([plan.control(t) @ plan.control(t) for t in moments]) * DURATION),
        off(np.array([plan.state(t) for t in moments])),
        off(free),
        float(abs(arm.tool(held[-1])[1] - HIGH)),
        min(forces),
        max(forces),
    )
