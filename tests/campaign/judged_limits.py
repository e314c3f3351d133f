"""Whether a motion within limits ended as it may, by MultibodyPlant and by the error's equation."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cached_property, partial
from pathlib import Path as FilePath
from typing import TYPE_CHECKING

import numpy as np
from pydrake.multibody.tree import JacobianWrtVariable
from scipy.optimize import least_squares
from scipy.signal import lsim

from drake_dae.arrays import FloatArray
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import DrakeDaeError
from drake_dae.robots.model import RobotModel
from drake_dae.running.rollout.rollout import Rollout
from drake_dae.scenario.completion.completion import Completed
from drake_dae.scenario.model import scenario_model
from drake_dae.scenario.scenario import Scenario
from drake_dae.simulation.records.record import Record
from drake_dae.simulation.remarks import departure_remarks, rate_remarks

if TYPE_CHECKING:
    from campaign.random_limits import Run

BAD = ("RAW", "UNCONFIRMED", "EXCEEDS", "OFF", "SILENT", "FAILED")
"""How no run may end."""

GRAVITY = 9.81

KEPT = 2e-3
"""The accepted excess over a limit, as a share of it: speeds and accelerations give way by 1e-6 of
the multipliers of a quadratic program, and steps meet a limit between two of its evaluations."""

OFF = 1e-5
"""The accepted deviation of an error from its prediction, in its unit: the accuracy is 1e-7, and
the reference's acceleration jumps at turns."""

BESIDE = 1.5
"""The accepted error beside that of the same motion without limits, where the plant is another than
the law's: a governor changes when what happens, and so what an error meets."""

BESIDE_SPEED = 0.02
"""The accepted excess over a speed where the plant is another than the law's, as a share of it."""

EXPLAINED = 0.1
"""The accepted part of an error that its recorded departure does not explain: between the rows of a
record, some milliseconds, a departure begins and ends at once."""


class Arm:
    """An arm with its tool on a plane, by MultibodyPlant alone."""

    def __init__(self, scenario: Scenario, model: RobotModel) -> None:
        self.plant = plant = model.links.plant
        self.context = plant.CreateDefaultContext()
        self.names = [signal.name for signal in model.dae.control_signals]
        indices = plant.GetJointActuatorIndices()
        actuators = {
            plant.get_joint_actuator(i).name(): plant.get_joint_actuator(i) for i in indices
        }
        chosen = [actuators[name] for name in self.names]
        self.driven = [actuator.joint().velocity_start() for actuator in chosen]
        self.efforts = np.array([actuator.effort_limit() for actuator in chosen])
        self.speeds = plant.GetVelocityUpperLimits()
        self.accelerations = plant.GetAccelerationUpperLimits()
        joints = (plant.get_joint(i) for i in plant.GetJointIndices())
        self.damping = np.zeros(plant.num_velocities())
        for joint in joints:
            if joint.num_velocities() == 1:
                self.damping[joint.velocity_start()] = joint.default_damping()
        self.nominal = model.nominal_positions
        (self.contact,) = scenario.constraints

    @cached_property
    def normal(self) -> FloatArray:
        return np.asarray(self.contact.surface.normal) / np.linalg.norm(self.contact.surface.normal)

    def pose(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The place of the tool's point in m, and the tool's axes."""
        self.plant.SetPositions(self.context, q)
        frame = self.plant.GetFrameByName(self.contact.frame)
        pose = frame.CalcPoseInWorld(self.context)
        return pose @ np.asarray(self.contact.point, dtype=float), pose.rotation().matrix()

    def jacobian(self, q: FloatArray) -> FloatArray:
        """The Jacobian of the tool's point, shape (3, nv)."""
        self.plant.SetPositions(self.context, q)
        world, frame = self.plant.world_frame(), self.plant.GetFrameByName(self.contact.frame)
        return self.plant.CalcJacobianTranslationalVelocity(
            self.context, JacobianWrtVariable.kV, frame, self.contact.point, world, world
        )

    def torques_at_rest(self, q: FloatArray, force: float) -> FloatArray:
        """The torques that hold the arm while it presses with a force."""
        self.plant.SetPositions(self.context, q)
        weight = self.plant.CalcGravityGeneralizedForces(self.context)
        return (-weight - force * self.normal @ self.jacobian(q))[self.driven]

    def rates(self, q: FloatArray, v: FloatArray, u: FloatArray, force: float, friction: float):
        """v' for torques and a contact force, with Coulomb friction as the contact has it."""
        plant, context = self.plant, self.context
        plant.SetPositions(context, q)
        plant.SetVelocities(context, v)
        jacobian = self.jacobian(q)
        slip = jacobian @ v
        slip -= self.normal * (self.normal @ slip)
        tolerance = self.contact.stiction_tolerance if friction else 1.0
        pull = force * self.normal - friction * force * slip / np.hypot(
            np.linalg.norm(slip), tolerance
        )
        forces = plant.CalcGravityGeneralizedForces(context) - plant.CalcBiasTerm(context)
        forces = forces + pull @ jacobian - self.damping * v
        forces[self.driven] += u
        return np.linalg.solve(plant.CalcMassMatrix(context), forces)


class Path:
    """The references of a scenario at times, and the postures of an arm along them."""

    def __init__(self, run: Run, scenario: Scenario, arm: Arm) -> None:
        self.run, self.scenario, self.arm = run, scenario, arm
        names = [name for name in scenario.references if name not in run.base.held]
        self.force = scenario.references[run.base.force]
        self.moving = [scenario.references[n] for n in names if n != run.base.force]
        self.held = [
            (arm.plant.GetJointByName(name).position_start(), value)
            for key, value in run.base.held.items()
            for name in key.split(", ")
            if "." not in name
        ]

    def pressed(self, time: float) -> float:
        return _value(self.force, time)[0]

    def place(self, time: float) -> FloatArray:
        """Where the tool is."""
        values = np.concatenate([_value(reference, time) for reference in self.moving])
        place = np.array(self.arm.contact.surface.point, dtype=float)
        for name, value in zip(self.run.base.coordinates, values, strict=True):
            place["xyz".index(name[-1])] = value
        return place

    def postures(self, times: FloatArray, errors: FloatArray) -> tuple[FloatArray, FloatArray]:
        """q at times, each from the one before, and how far the tool is from its place there.

        Args:
            times: Times of the reference in s.
            errors: What the tool is off, in m.
        """
        guess, found, off = self._guess(), [], []
        missed = partial(self._missed, turned=self.arm.pose(guess)[1].T @ self.arm.normal)
        for time in times:
            goal = self.place(time) + errors
            solved = least_squares(missed, guess, args=(goal,), xtol=1e-14, ftol=1e-14, gtol=1e-14)
            guess = solved.x
            found.append(guess)
            off.append(float(np.abs(solved.fun).max()))
        return np.array(found), np.array(off)

    def regularity(self, q: FloatArray) -> float:
        """The smallest singular value of the tool's and the held joints' gradients."""
        place, axes = self.arm.pose(q)
        turned = axes.T @ self.arm.normal
        step = 1e-6 * np.eye(q.size)
        columns = [
            self._missed(q + one, place, turned=turned)
            - self._missed(q - one, place, turned=turned)
            for one in step
        ]
        values = np.linalg.svd(np.array(columns) / 2e-6, compute_uv=False)
        return float(values[q.size - 1])

    def _guess(self) -> FloatArray:
        guess = np.array(self.arm.nominal, dtype=float)
        for joint, value in self.scenario.start.positions.items():
            guess[self.arm.plant.GetJointByName(joint).position_start()] = value
        return guess

    def _missed(self, q: FloatArray, goal: FloatArray, turned: FloatArray) -> FloatArray:
        """What the tool's place, the normal in its axes, and the held joints are off."""
        place, axes = self.arm.pose(q)
        held = [q[index] - value for index, value in self.held]
        if len(self.run.base.coordinates) == 1:  # In a plane.
            return (place - goal)[[0, 2]]
        return np.concatenate([place - goal, axes.T @ self.arm.normal - turned, held])


def _value(reference, time: float) -> FloatArray:
    if isinstance(reference, float | int):
        return np.array([float(reference)])
    rows = reference.derivatives([0] * reference.size)(time)
    return np.asarray(rows).reshape(-1)


def confirmed(run: Run, scenario: Scenario, error: DrakeDaeError) -> str:
    """A refusal with whether it is right, by a check that does not use what refused."""
    problems = getattr(error, "problems", (("", str(error)),))
    text = str(error).removeprefix("time_optimal: ")
    if len(problems) != 1:
        return f"UNCONFIRMED: {len(problems)} problems: {error}"
    try:
        why, is_right = _why(run, scenario, text)
    except Exception as failed:
        return f"UNCONFIRMED: {text}: the check failed: {failed!r}"
    return f"refused, {why}: {text}" if is_right else f"UNCONFIRMED, {why}: {text}"


_REST = re.compile(r"at rest at t = (\S+) s of the reference (.+?) is (\S+) .*?, and (may|must) be")
_SLOW = re.compile(r"in slow motion at t = (\S+) s of the reference (.+?) is (\S+) .* beyond its")
_STILL = re.compile(r"cannot continue from t = (\S+) s")


def _why(run: Run, scenario: Scenario, text: str) -> tuple[str, bool]:
    """The kind of a refusal, and whether it is right."""
    if "is for rigid joints" in text:
        return "springs", bool(scenario.actuation)
    begin, least, most = scenario.integrator.start_time, *run.forces
    found = _REST.search(text) or _SLOW.search(text) or _STILL.search(text)
    if found and run.cone:  # By hand.
        weight, effort = 7.0 * GRAVITY, _tray_effort(scenario)
        is_right = found[2] == "tray_z" and abs(float(found[3]) - weight) < 0.01
        return "weight of the tray", is_right and weight >= run.shares["efforts"] * effort
    if not found:
        return _no_posture(run, scenario, text)
    arm = Arm(scenario, scenario_model(scenario))
    path, time = Path(run, scenario, arm), float(found[1])
    if found.re is not _STILL and found[2] == run.base.force:
        pressed = path.pressed(time)
        is_right = pressed <= (least or 0.0) or (most is not None and pressed >= most)
        near = abs(pressed - float(found[3])) < 1e-3 * abs(pressed) + 1e-9
        return "force", is_right and near
    q, off = path.postures(np.linspace(begin, time, 25), np.zeros(3))
    force, bounds = path.pressed(time), arm.efforts * run.shares["efforts"]
    torques = arm.torques_at_rest(q[-1], force)[None]
    if found.re is not _REST and run.friction:
        # Before and after, since the motion may begin, end or turn there.
        step = 1e-2 * scenario.duration
        places = [path.place(time + k * step) for k in (-1, 0, 1)]
        ways = [way / max(float(np.linalg.norm(way)), 1e-12) for way in np.diff(places, axis=0)]
        pulls = [run.friction * force * way @ arm.jacobian(q[-1]) for way in ways]
        torques = torques + np.array(pulls)[:, arm.driven]
    if off.max() > 1e-6:
        return "the check lost the path", False
    if found.re is _STILL:
        return "at a limit", bool(np.max(np.abs(torques) / bounds) > 0.999)
    row, told = arm.names.index(found[2]), float(found[3])
    needed = float(np.abs(torques[:, row]).max())
    if found.re is _REST:
        # The message has four digits.
        near = abs(needed - abs(told)) < 2e-3 * needed + 1e-6
        return "torque at rest", bool(near and needed > bounds[row] * (1.0 - 1e-3))
    # In slow motion, a hundredth of the fastest, friction may not have its full size yet.
    return "torque in slow motion", 0.0 < told < needed - bounds[row] + 0.03 * needed


def _tray_effort(scenario: Scenario) -> float:
    text = FilePath(scenario.robot.file).read_text("utf-8")
    (found,) = re.findall(r'name="tray_z".*?effort="([^"]+)"', text)
    return float(found)


def _no_posture(run: Run, scenario: Scenario, text: str) -> tuple[str, bool]:
    """Whether the path or the start has no posture within the limits of joints, or a singular one.

    Independent postures are found by least squares, each from the one before.
    """
    if run.cone:
        return "no reason that is known", False
    arm = Arm(scenario, scenario_model(scenario))
    path, begin = Path(run, scenario, arm), scenario.integrator.start_time
    errors = np.zeros(3)
    for name, error in scenario.start.errors.items():
        errors["xyz".index(name[-1])] = error
    low, high = arm.plant.GetPositionLowerLimits(), arm.plant.GetPositionUpperLimits()
    if "the robot cannot start outside of its limits" in text:
        (q,), off = path.postures(np.array([begin]), errors)
        return "start beyond a joint's limit", bool(np.any((q < low) | (q > high)))
    if "found no configuration near start.positions" in text:
        _, off = path.postures(np.array([begin]), errors)
        return f"start out of reach by {off.max():.2g}", bool(off.max() > 1e-6)
    if "out of reach" in text or "singular" in text:
        q, off = path.postures(np.linspace(begin, begin + scenario.duration, 60), np.zeros(3))
        least = np.array([path.regularity(one) for one in q])
        is_right = off.max() > 1e-6 or least.min() < 0.1 * least[0]
        return f"path out of reach by {off.max():.2g}, or singular", bool(is_right)
    return "no reason that is known", False


def judged(
    run: Run, completed: Completed, loop: ClosedLoop, found: Rollout, finer: Callable[[], Record]
) -> str:
    """How a run that was not refused ends.

    Args:
        run: The run.
        completed, loop, found: Its scenario, its loop, and what the loop did.
        finer: The same run with more rows, for departures that are shorter than a row.
    """
    record, scenario = found.record, completed.scenario
    if found.failure is not None:
        return f"FAILED: {found.failure}"
    predicted, shares = (
        loop.predicted_error(record),
        exceeded(run, scenario, loop.plant.robot("a campaign"), record),
    )
    off = float(np.max(np.abs(record["tracking_error"] - predicted)))
    name, worst = max(shares.items(), key=lambda item: item[1])
    room = record["path"][:, 3].min() if "path" in record else np.nan
    told = f"{name} {worst:.5g} of its limit, off by {off:.2g}, room {room:.2g}"
    remarks = departure_remarks(record, loop.feasible)
    if not remarks and off > OFF:
        remarks = departure_remarks(finer(), loop.feasible)
    rates = rate_remarks(record, loop.feasible)
    if rates and shares.get("acceleration", 0.0) > 1.0 + KEPT:
        shares["acceleration"], told = 0.0, f"{told}; {rates[0]}"
    is_over = max(shares.values()) > 1.0 + KEPT
    if not remarks:
        if is_over:
            return f"EXCEEDS: {told}"
        kind = "told" if rates else "kept"
        return f"{kind}: {told}" if off <= OFF else f"OFF: {told}"
    if not re.search(r"within the limits \(.+\): .* left their prediction, of .+\.", remarks[0]):
        return f"SILENT: {told}; {remarks}"
    unexplained = unlike(run, loop, record)
    if unexplained > EXPLAINED:
        unexplained = unlike(run, loop, finer())
    told = f"{told}, explained but for {unexplained:.2g}; {remarks[0]}"
    if is_over:
        return f"EXCEEDS: {told}"
    return f"left: {told}" if unexplained <= EXPLAINED else f"OFF: {told}"


def judged_beside(
    run: Run, completed: Completed, loop: ClosedLoop, found: Rollout, free: Callable[[], float]
) -> str:
    """The same for a plant that is not the law's, whose error is off its prediction in any case.

    Args:
        run, completed, loop, found: As for `judged`.
        free: How far the error of the same run without limits is off.
    """
    record, model = found.record, loop.plant.robot("a campaign")
    if found.failure is not None:
        return f"FAILED: {found.failure}"
    state, controls = record["state"], record["control"]
    speed = np.max(np.abs(state[:, 2:]) / model.links.velocity_limits[1])
    torque = np.max(np.abs(controls) / model.control_limits)
    off = float(np.max(np.abs(record["tracking_error"] - loop.predicted_error(record))))
    remarks = departure_remarks(record, loop.feasible)
    told = f"torque {torque:.4g}, speed {speed:.4g} of the limit, off by {off:.2g}"
    if torque > 1.0 or speed > 1.0 + BESIDE_SPEED:
        return f"EXCEEDS: {told}"
    if remarks:
        return f"left, another plant: {told}; {remarks[0]}"
    told += f", without limits by {(alone := free()):.2g}"
    kind = "kept, another plant" if off <= BESIDE * alone + OFF else "OFF"
    return f"{kind}: {told}"


def unlike(run: Run, loop: ClosedLoop, record: Record) -> float:
    """How far the error is from that of (30) with the recorded departure, as a share of its effect.

    (30) with the departure d is e'' - 2 p e' + p^2 e = d for two poles p, and e = d for an output
    of degree 0: when and by how much the record says that it left has to explain the whole error.
    """
    off = record["tracking_error"] - loop.predicted_error(record)
    caused = record["departure"].copy()
    for column, degree in enumerate(loop.controller.law.degrees):
        if degree:
            system = [1.0], np.poly([run.pole] * degree)
            times = record.time - record.time[0]
            caused[:, column] = lsim(system, caused[:, column], times)[1]
    size = np.maximum(np.abs(caused).max(axis=0), OFF / EXPLAINED)
    return float(np.max(np.abs(off - caused).max(axis=0) / size))


def exceeded(run: Run, scenario: Scenario, model: RobotModel, record: Record) -> dict[str, float]:
    """The largest share of each kind of limit, by MultibodyPlant from states and controls."""
    controls, state, force = (record[n] for n in ("control", "state", "constraint_force"))
    if run.cone:
        return _on_tray(run, scenario, model, record)
    arm, half = Arm(scenario, model), state.shape[1] // 2
    shares = {
        "torque": np.abs(controls) / arm.efforts,
        "speed": np.abs(state[:, half:]) / arm.speeds,
    }
    if np.isfinite(arm.accelerations).any():
        rates = [
            arm.rates(x[:half], x[half:], u, f[0], run.friction)
            for x, u, f in zip(state, controls, force, strict=True)
        ]
        shares["acceleration"] = np.abs(rates) / arm.accelerations
    least, most = run.forces
    # In units of the typical force.
    shares["force"] = 1.0 + ((least or 0.0) - force) / max(least or 0.0, 1.0)
    if most is not None:
        shares["force"] = np.maximum(shares["force"], force / most)
    return {name: float(np.max(value)) for name, value in shares.items()}


def _on_tray(run: Run, scenario: Scenario, model: RobotModel, record: Record) -> dict[str, float]:
    """The same of the tray and its block, by Newton's law: 7.2 kg along x, 7 kg along z."""
    controls, state = record["control"], record["state"]
    plant = model.links.plant
    across, up = controls[:, 0] / 7.2, controls[:, 1] / 7.0 - GRAVITY
    sliding, pressing = 2.1 * across, 2.0 * (GRAVITY + up)
    shares = {
        "torque": np.abs(controls) / _tray_effort(scenario),
        "cone": np.abs(sliding) / (run.cone * pressing),
        "speed": np.abs(state[:, 4:]) / plant.GetVelocityUpperLimits(),
        "acceleration": np.abs([across, up]) / plant.GetAccelerationUpperLimits()[0],
    }
    return {name: float(np.max(value)) for name, value in shares.items()}
