"""The limits of a robot: of its drives, joints, contacts and friction cones."""

from collections.abc import Sequence

import casadi as ca
import numpy as np

from drake_dae.analysis.limits import LimitKind, SignalLimits, SignalRange
from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.dae import Signal
from drake_dae.diagrams.record import Record
from drake_dae.errors import ModelError
from drake_dae.robots import FrictionCone, RobotModel


def robot_limits(model: RobotModel, cones: Sequence[FrictionCone] = ()) -> SignalLimits:
    """The limits of a robot: efforts of drives and joints, positions, speeds, pushing, cones.

    Args:
        model: The robot.
        cones: Friction cones of contacts that must not slide.

    Raises:
        ModelError: A cone names a force that the robot does not have.
    """
    dae, links, loops = model.dae, model.links, model.loop_joints
    control = ca.SX.sym("u", dae.num_controls)
    force = ca.SX.sym("force", len(dae.force_signals))
    names = [signal.name for signal in dae.force_signals]
    signals, kinds, values, bounds = list[Signal](), list[LimitKind](), list[ca.SX](), []

    def add(
        kind: LimitKind, of: Sequence[Signal], value: ca.SX, low: FloatArray, high: FloatArray
    ) -> None:
        signals.extend(of)
        kinds.extend([kind] * len(of))
        values.append(value)
        bounds.append(np.array([low, high]).reshape(2, len(of)))

    most = model.control_limits
    add(LimitKind.CONTROL, dae.control_signals, control, -most, most)
    if model.joint_force is not None:
        most = links.effort_limits
        add(LimitKind.EFFORT, links.actuator_signals, model.joint_force, -most, most)
    nq, nv, half = links.q.numel(), links.v.numel(), len(loops.signals) // 2
    q, v = dae.state[:nq], dae.state[nq : nq + nv]
    add(LimitKind.POSITION, dae.state_signals[:nq], q, *links.position_limits)
    add(LimitKind.SPEED, dae.state_signals[nq : nq + nv], v, *links.velocity_limits)
    if half:
        (low, high), state = loops.limits, loops.state
        add(LimitKind.POSITION, loops.signals[:half], state[:half], low[:half], high[:half])
        add(LimitKind.SPEED, loops.signals[half:], state[half:], low[half:], high[half:])
    pushes = {
        signal.name
        for constraint in model.constraints
        for signal, is_one in zip(constraint.force_signals, constraint.is_unilateral, strict=True)
        if is_one
    }
    least = np.array([0.0 if name in pushes else -np.inf for name in names])
    add(LimitKind.FORCE, dae.force_signals, force, least, np.full(len(names), np.inf))
    for cone in cones:
        for name in (cone.normal, *cone.tangents):
            if name not in names:
                raise ModelError(unknown_name("constraint force", name, names))
        normal = names.index(cone.normal)
        tangents = ca.norm_2(force[[names.index(name) for name in cone.tangents]])
        signal = Signal(f"the friction cone of {cone.normal}", dae.force_signals[normal].unit)
        value = tangents - cone.limit * force[normal]
        add(LimitKind.CONE, [signal], value, np.array([-np.inf]), np.zeros(1))
    return SignalLimits(
        dae, signals, kinds, ca.vertcat(*values), np.hstack(bounds), (control, force)
    )


def limited_values(limits: SignalLimits, record: Record) -> FloatArray:
    """The values of the signals of `robot_limits` in a record of the robot, one row a time."""
    signals = (record["state"], record["control"], record["constraint_force"])
    parameters = limits.system.parameter_values
    rows = [limits.values(*row, parameters)[0].copy() for row in zip(*signals, strict=True)]
    return np.array(rows).reshape(len(rows), len(limits.signals))


def ranges_of(limits: SignalLimits, record: Record) -> tuple[SignalRange, ...]:
    """The range of each signal of `robot_limits` in a record of the robot."""
    return limits.ranges(record.time, limited_values(limits, record))
