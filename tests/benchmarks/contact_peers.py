"""One task on Drake's own contact, by our law and by what users would do today.

    python tests/benchmarks/contact_peers.py

The tool of a 7-joint arm goes round a circle of 0.1 m radius at 0.1 m/s on a wall, and presses with
20 + 5 sin 2t N. The coefficient of friction is 0.3; laws run at 1 kHz, and act one sample late. All
rivals have the exact model of the robot, feed the wall's force forward with the friction in which
they believe, hold the posture of the arm in the null space of the task, and have gains from one
search (28 points each, on points of 1e5 N/m with the friction known). Printed are rms errors after
2 s, position in mm / force in N, and the rms difference of torques between two samples under noise,
N m. A law is lost if it is out of contact for a tenth of the time.
"""

from collections import namedtuple
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
from pydrake.common import RandomDistribution, RandomGenerator
from pydrake.math import VectorToSkewSymmetric
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import DiagramBuilder, EventStatus, LeafSystem, TriggerType
from pydrake.systems.primitives import Adder, LogVectorOutput, MatrixGain, RandomSource
from scipy.linalg import eigh

from drake_dae import (
    ContactPlant,
    Encoders,
    ForceSensor,
    ReferenceGenerator,
    load_scenario,
    simulate,
)
from drake_dae.arrays import FloatArray
from drake_dae.errors import DrakeDaeError
from drake_dae.scenario.build import build_completed, make_plant
from drake_dae.scenario.gains import advised
from drake_dae.scenario.model import completed_model, scenario_structure
from drake_dae.scenario.start import start_scenario
from drake_dae.systems import ControlHold

FRICTION, PERIOD, SETTLED = 0.3, 1e-3, 2.0
DURATION = SETTLED + np.pi  # Half a turn, and a period of the force.
ANGLE_NOISE, RATE_NOISE, FORCE_NOISE = 5e-6, 1e-3, 0.3  # Standard deviations, rad, rad/s, N.
WALL, NORMAL = 0.7, np.array([-1.0, 0.0, 0.0])
POSTURE = [2, 6]  # The joints that the task leaves free.
STEPS = SimulatorConfig(
    integration_scheme="explicit_euler", max_step_size=PERIOD, use_error_control=False
)


class Condition(NamedTuple):
    """A plant: its scenario, and what it has otherwise."""

    title: str
    setting: str = "plant.stiffness=1e5"
    scenario: str = "wall_point_contact"
    noise: float = 0.0


CONDITIONS = (
    Condition("point 1e5 N/m"),
    Condition("point 1e6 N/m", "plant.stiffness=1e6"),
    Condition("hydro 1e8 Pa", "plant.modulus=1e8", "wall_hydroelastic"),
    Condition("wall +2 mm", "plant.parameters={wall.position: [0.702, 0, 0]}"),
    Condition("tool +0.5 kg", "plant.payloads=[{frame: tool, mass: 0.5}]"),
    Condition("noise", noise=1.0),
)


Robot = namedtuple("Robot", "q v mass bias jacobian drift position velocity inertia")
Goal = namedtuple("Goal", "position velocity acceleration force contact q v joints")


def robot_at(plant: MultibodyPlant, context, state: FloatArray):
    """M v' + bias = u + J_p^T F at (q, v), and the coordinates of the task with their rates J v.

    The coordinates are x into the wall, y and z of the tool, and the y and z of its axis; J_p are
    the first three rows of J, drift is J' v, and the inertia (J M^-1 J^T)^-1.
    """
    plant.SetPositionsAndVelocities(context, state)
    q, v = np.split(np.array(state), 2)
    tool, world = plant.GetFrameByName("tool"), plant.world_frame()
    of = JacobianWrtVariable.kV, tool, np.zeros(3), world, world
    spatial = plant.CalcJacobianSpatialVelocity(context, *of)
    drift = plant.CalcBiasSpatialAcceleration(context, *of)
    pose = tool.CalcPoseInWorld(context)
    axis, turning = pose.rotation().col(2), spatial[:3] @ v
    of_axis = -VectorToSkewSymmetric(axis)  # axis' = omega x axis
    axis_drift = of_axis @ drift.rotational()
    axis_drift += turning * (turning @ axis) - axis * (turning @ turning)
    jacobian = np.vstack([spatial[3:], (of_axis @ spatial[:3])[1:]])
    mass = plant.CalcMassMatrix(context)
    bias = plant.CalcBiasTerm(context) - plant.CalcGravityGeneralizedForces(context)
    position = np.concatenate([pose.translation(), axis[1:]])
    inertia = np.linalg.inv(jacobian @ np.linalg.solve(mass, jacobian.T))
    drift = np.concatenate([drift.translational(), axis_drift[1:]])
    return Robot(q, v, mass, bias, jacobian, drift, position, jacobian @ v, inertia)


class Known:
    """What a rival knows: the robot's model, the start, and a coefficient of friction."""

    def __init__(self, plant: MultibodyPlant, start: FloatArray, friction: float) -> None:
        self.plant, self.start, self._friction = plant, start, friction
        self._context, self._q = plant.CreateDefaultContext(), start[:7]

    def robot(self, state: FloatArray):
        return robot_at(self.plant, self._context, state)

    def goal(self, reference: FloatArray):
        """Coordinates, force, what the wall does, and joints, at R of our law."""
        rows, force = reference[:18].reshape(6, 3), float(reference[18])
        position, velocity, acceleration = (
            np.concatenate([[first], rows[:4, k]]) for k, first in enumerate((WALL, 0.0, 0.0))
        )
        for _ in range(20):  # The joints: Newton from where they were last.
            found = self.robot(np.concatenate([self._q, np.zeros(7)]))
            whole = np.vstack([found.jacobian, np.eye(7)[POSTURE]])
            off = np.concatenate([found.position - position, self._q[POSTURE] - rows[4:, 0]])
            if np.max(np.abs(off)) < 1e-12:
                break
            self._q = self._q - np.linalg.solve(whole, off)
        v = np.linalg.solve(whole, np.concatenate([velocity, rows[4:, 1]]))
        drift = self.robot(np.concatenate([self._q, v])).drift
        joints = np.linalg.solve(whole, np.concatenate([acceleration - drift, rows[4:, 2]]))
        along = np.array([0.0, *velocity[1:3]])
        # Friction fades at rest, as in the model of a `PointOnSurface`.
        contact = force * (NORMAL - self._friction * along / np.hypot(np.linalg.norm(along), 1e-3))
        return Goal(position, velocity, acceleration, force, contact, self._q, v, joints)


class Rival(LeafSystem):
    """A law with `control`, u, and `later`, the memory of the next sample."""

    MEMORY = 0

    def __init__(self, known: Known, gains: dict[str, float]) -> None:
        super().__init__()
        self.known, self.gains, self.start = known, gains, known.robot(known.start)
        sizes = {"estimated_state": 14, "reference": 19, "measured_force": 1}
        self._inputs = [self.DeclareVectorInputPort(*item) for item in sizes.items()]
        self.DeclareDiscreteState(self.MEMORY)
        self.DeclareVectorOutputPort("control", 7, self._calc_control)
        if self.MEMORY:
            # Unrestricted, as the step of a discrete MultibodyPlant: so both see one instant.
            self.DeclarePeriodicUnrestrictedUpdateEvent(PERIOD, 0.0, self._remember)

    def _now(self, context):
        state, reference, force = (port.Eval(context) for port in self._inputs)
        memory = context.get_discrete_state(0).CopyToVector()
        goal = self.known.goal(reference)  # Before the robot: both set one context.
        return self.known.robot(state), goal, float(force[0]), memory

    def _calc_control(self, context, output):
        output.SetFromVector(self.control(*self._now(context)))

    def _remember(self, context, state):
        state.get_mutable_discrete_state().set_value(0, self.later(*self._now(context)))
        return EventStatus.Succeeded()


def operational(robot, goal, forces, w, contact):
    """u of operational-space forces, with the posture in their null space (Khatib)."""
    free = goal.joints + 2.0 * w * (goal.v - robot.v) + w**2 * (goal.q - robot.q)
    seen = robot.inertia @ (robot.jacobian @ free)
    pull = robot.jacobian.T @ (forces - seen) - robot.jacobian[:3].T @ contact
    return robot.bias + robot.mass @ free + pull


def along(robot, goal, w):
    """x_d'' + 2 w (x_d' - x') + w^2 (x_d - x), shape (5,)."""
    slip, off = goal.velocity - robot.velocity, goal.position - robot.position
    return goal.acceleration + 2.0 * w * slip + w**2 * off


class InverseDynamics(Rival):
    """Drake's InverseDynamicsController without integrals, and J^T lambda."""

    def control(self, robot, goal, force, memory):
        w, ratio = self.gains["motion"], self.gains["ratio"]
        wanted = goal.joints + 2.0 * ratio * w * (goal.v - robot.v) + w**2 * (goal.q - robot.q)
        there = self.known.robot(np.concatenate([goal.q, goal.v]))
        return robot.mass @ wanted + robot.bias - there.jacobian[:3].T @ goal.contact


class Hybrid(Rival):
    """Hybrid position and force control (Raibert and Craig, Khatib), PI control of the force."""

    MEMORY = 1

    def control(self, robot, goal, force, memory):
        w, gain = self.gains["motion"], self.gains["force_gain"]
        wanted = along(robot, goal, w)
        wanted[0] = -self.gains["damping"] * robot.velocity[0]
        pushed = gain * (goal.force - force)
        pushed += (1.0 + gain) * self.gains["force_rate"] * memory[0]
        forces = robot.inertia @ (wanted - robot.drift)
        return operational(robot, goal, forces, w, goal.contact + pushed * NORMAL)

    def later(self, robot, goal, force, memory):
        return memory + PERIOD * (goal.force - force)


class Impedance(Rival):
    """Impedance control (Hogan) with the force fed forward; K_i = w_i^2 Lambda_ii at the start.

    D gives all modes one damping ratio (double diagonalization, Albu-Schaeffer).
    """

    def control(self, robot, goal, force, memory):
        gains, masses = self.gains, np.diag(self.start.inertia)
        rates = np.array([gains[name] for name in ("normal", *2 * ["motion"], *2 * ["axis"])])
        stiffness = masses * rates**2
        squares, modes = eigh(np.diag(stiffness), robot.inertia)
        seen = robot.inertia @ modes
        damping = seen @ np.diag(2.0 * gains["ratio"] * np.sqrt(squares)) @ seen.T
        damping[0, 0] += masses[0] * gains["contact"]
        forces = robot.inertia @ (goal.acceleration - robot.drift)
        forces += stiffness * (goal.position - robot.position)
        forces += damping @ (goal.velocity - robot.velocity)
        return operational(robot, goal, forces, gains["motion"], goal.contact)


class WithObserver(Rival):
    """Another law, less the disturbance torque r of a momentum observer (De Luca and Mattone).

    With p = M v, r' = w (p' - M' v - u - J_p^T F + bias - r), where u is what acts. In samples
    (M v)' - M' v is M times the difference of v. The memory after that of the law is v, the last
    two controls, r, and 1 after the first.
    """

    def control(self, robot, goal, force, memory):
        size = self.MEMORY - 29
        return super().control(robot, goal, force, memory[:size]) - memory[size + 21 : -1]

    def later(self, robot, goal, force, memory):
        size = self.MEMORY - 29
        inner = super().later(robot, goal, force, memory[:size]) if size else memory[:0]
        velocity, before, acting, r = memory[size:-1].reshape(4, 7)
        contact = robot.jacobian[:3].T @ (goal.contact * force / goal.force)
        d = robot.mass @ (robot.v - velocity) / PERIOD - acting - contact + robot.bias
        r = r + memory[-1] * (1.0 - np.exp(-self.gains["observer"] * PERIOD)) * (d - r)
        control = self.control(robot, goal, force, memory)
        return np.concatenate([inner, robot.v, control, before, r, [1.0]])


HybridWithObserver = type("HybridWithObserver", (WithObserver, Hybrid), {"MEMORY": 30})
ImpedanceWithObserver = type("ImpedanceWithObserver", (WithObserver, Impedance), {"MEMORY": 29})


def gains(text: str) -> dict[str, float]:
    return {name: float(value) for name, value in (each.split() for each in text.split(", "))}


RIVALS = {
    "InverseDynamicsController + J^T lambda": (InverseDynamics, "motion 16.58, ratio 0.3093"),
    "hybrid, PI": (Hybrid, "motion 25, force_rate 8.43, force_gain 0.1444, damping 20"),
    "impedance": (Impedance, "normal 0.4713, contact 10, motion 17, axis 20.3, ratio 0.713"),
    "hybrid, PI + momentum observer": (
        HybridWithObserver,
        "motion 22.85, force_rate 7.178, force_gain 0.09905, damping 34.04, observer 186.1",
    ),
    "impedance + momentum observer": (
        ImpedanceWithObserver,
        "normal 0.4511, contact 10.75, motion 19.42, axis 19.69, ratio 0.7324, observer 94.04",
    ),
}
OURS = "drake_dae, as shipped"


@cache
def ours(condition: Condition, friction: float):
    """The loop as shipped, its start, and the scenario with the gains that it computes."""
    sensor = f"{{sample_period: {PERIOD}, noise_deviation: {FORCE_NOISE * condition.noise}}}"
    settings = [
        f"plant.friction={FRICTION}",
        f"constraints.0.friction={friction}",
        f"sensors.force={sensor}",
        f"duration={DURATION}",
    ]
    settings += ["plant.stiffness=1e5"] * (condition.scenario == "wall_point_contact")
    given = load_scenario(condition.scenario, [*settings, condition.setting])
    model = completed_model(given)[1]
    scenario = advised(given, model, scenario_structure(model)).scenario
    if condition.noise:  # Its gains are those for sensors without noise.
        noisy = Encoders(position_noise=ANGLE_NOISE, velocity_noise=RATE_NOISE, seed=1)
        scenario = replace(scenario, sensors=replace(scenario.sensors, encoders=noisy))
    _, loop = build_completed(scenario)
    return loop, start_scenario(scenario, loop), scenario


def run(law: str, condition: Condition, friction: float) -> tuple[float, ...]:
    """Position error in mm, force error in N, roughness in N m, and the share without contact."""
    loop, context, scenario = ours(condition, friction if law == OURS else 0.0)
    diagram, config, own = loop.diagram, scenario.integrator, context.Clone()
    if law != OURS:
        start = ours(CONDITIONS[0], 0.0)
        state = start[0].plant.state(start[0].plant.GetMyContextFromRoot(start[1]))
        known = Known(loop.plant.model.links.plant, state, friction)
        plant = make_plant(scenario, loop.plant.model, loop.plant.structure)
        kind, text = RIVALS[law]
        diagram, logs = wired(kind(known, gains(text)), plant, loop, scenario, condition.noise)
        own, config = diagram.CreateDefaultContext(), STEPS
        diagram.SetRandomContext(own, RandomGenerator(1))
        plant.set_consistent_state(plant.GetMyMutableContextFromRoot(own), state)
    try:
        simulate(diagram, own, DURATION, config)
    except (DrakeDaeError, RuntimeError):
        return np.inf, np.inf, np.inf, 1.0
    if law == OURS:
        record = loop.record(own)
        time, z, u = record.time, record["controlled_output"], record["control"]
    else:
        found = [log.FindLog(own) for log in logs]
        time, z, u = found[0].sample_times(), found[0].data().T, found[1].data().T
    late = time > SETTLED
    lowest = loop.controller.law.layout.lowest
    goal = np.array([loop.reference.reference(t)[lowest] for t in time])
    error = (z - goal)[late]
    rms = [np.linalg.norm(error[:, :2], axis=1), error[:, -1], np.diff(u[late], axis=0)]
    position, force, rough = (float(np.sqrt(np.mean(part**2))) for part in rms)
    return 1e3 * position, force, rough, float(np.mean(z[late, -1] <= 0.0))


def wired(law: Rival, plant: ContactPlant, loop, scenario, noise: float):
    """A rival on the plant, with the noise of encoders, and logs of outputs and controls."""
    builder = DiagramBuilder()
    degrees = (*loop.reference.degrees[:-1], 0)  # A rival knows no rate of the force.
    reference = ReferenceGenerator(loop.reference.references, degrees)
    hold = ControlHold(7, scenario.sampling)
    sensor = ForceSensor(1, sample_period=PERIOD, noise_deviation=noise * FORCE_NOISE)
    deviations = noise * np.repeat([ANGLE_NOISE, RATE_NOISE], 7)
    scaled, measured = MatrixGain(np.diag(deviations)), Adder(2, 14)
    for system in (plant, law, reference, hold, sensor, scaled, measured):
        builder.AddSystem(system)

    def add_noise(size: int, port) -> None:
        noisy = builder.AddSystem(RandomSource(RandomDistribution.kGaussian, size, PERIOD))
        builder.Connect(noisy.get_output_port(), port)

    add_noise(14, scaled.get_input_port())
    builder.Connect(plant.GetOutputPort("state"), measured.get_input_port(0))
    builder.Connect(scaled.get_output_port(), measured.get_input_port(1))
    builder.Connect(measured.get_output_port(), law.GetInputPort("estimated_state"))
    builder.Connect(reference.GetOutputPort("reference"), law.GetInputPort("reference"))
    builder.Connect(plant.GetOutputPort("constraint_force"), sensor.GetInputPort("force"))
    if sensor.HasInputPort("noise"):
        add_noise(1, sensor.GetInputPort("noise"))
    builder.Connect(sensor.GetOutputPort("measured_force"), law.GetInputPort("measured_force"))
    builder.Connect(law.GetOutputPort("control"), hold.get_input_port())
    builder.Connect(hold.get_output_port(), plant.GetInputPort("control"))
    ports = plant.GetOutputPort("controlled_output"), hold.get_output_port()
    kind = {TriggerType.kPeriodic}
    logs = [LogVectorOutput(port, builder, kind, PERIOD) for port in ports]
    return builder.Build(), logs


def main() -> None:
    for friction, word in ((FRICTION, "known"), (0.0, "unknown")):
        print(f"| friction {word} | {' | '.join(c.title for c in CONDITIONS)} | roughness |")
        print(f"|{'---|' * (len(CONDITIONS) + 2)}")
        for law in (*RIVALS, OURS):
            found = [run(law, condition, friction) for condition in CONDITIONS]
            cells = ["lost" if f[3] >= 0.1 else f"{f[0]:.2g} / {f[1]:.2g}" for f in found]
            print(f"| {law} | {' | '.join(cells)} | {found[-1][2]:.2g} |", flush=True)


if __name__ == "__main__":
    main()
