"""The limits of a robot's drives, joints and contacts, along references and in runs."""

from collections.abc import Sequence

import casadi as ca
import numpy as np

from drake_dae.analysis.limits import SignalLimits, limits_along
from drake_dae.arrays import unknown_name
from drake_dae.dae.structure.structure import find_structure
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.zero_dynamics.zero_dynamics import ZeroDynamics
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.robots.constraints.friction import FrictionCone
from drake_dae.robots.model import RobotModel
from drake_dae.simulation.records.record import Record


def robot_limits(model: RobotModel, cones: Sequence[FrictionCone] = ()) -> SignalLimits:
    """Returns the limits of a robot: efforts of drives and joints, speeds, pushing forces, cones.

    Args:
        model: The robot.
        cones: Friction cones of contacts that must not slide.

    Raises:
        ModelError: A cone names a force that the robot does not have.
    """
    dae, links = model.dae, model.links
    control = ca.SX.sym("u", dae.num_controls)
    force = ca.SX.sym("force", len(dae.force_signals))
    names = [signal.name for signal in dae.force_signals]
    signals: list[Signal] = [*dae.control_signals]
    values, ranges = [control], [(-model.control_limits, model.control_limits)]
    if model.joint_force is not None:
        signals += links.actuator_signals
        values.append(model.joint_force)
        ranges.append((-links.effort_limits, links.effort_limits))
    nq, nv = links.q.numel(), links.v.numel()
    signals += links.velocity_signals
    values.append(dae.state[nq : nq + nv])
    ranges.append(links.velocity_limits)
    loops = model.loop_joints
    if loops.signals:
        half = len(loops.signals) // 2
        signals += loops.signals[half:]
        values.append(loops.state[half:])
        ranges.append((loops.limits[0][half:], loops.limits[1][half:]))
    for constraint in model.constraints:
        for signal, pushes in zip(constraint.force_signals, constraint.is_unilateral, strict=True):
            if pushes and signal.name in names:
                signals.append(signal)
                values.append(force[names.index(signal.name)])
                ranges.append((np.zeros(1), np.full(1, np.inf)))
    for cone in cones:
        for name in (cone.normal, *cone.tangents):
            if name not in names:
                raise ModelError(unknown_name("constraint force", name, names))
        tangents = ca.norm_2(force[[names.index(name) for name in cone.tangents]])
        normal = names.index(cone.normal)
        signals.append(
            Signal(f"the friction cone of {cone.normal}", dae.force_signals[normal].unit)
        )
        values.append(tangents - cone.limit * force[normal])
        ranges.append((np.full(1, -np.inf), np.zeros(1)))
    bounds = np.array([np.concatenate(side) for side in zip(*ranges, strict=True)])
    return SignalLimits(dae, signals, ca.vertcat(*values), bounds, (control, force))


MOST_TIMES = 2000
"""The most times of a record at which its references are examined."""


def limits_of_run(loop: ClosedLoop, record: Record, cones: Sequence[FrictionCone]) -> list[str]:
    """Returns a phrase on the limit that a run exceeds most; none if the limits are kept.

    Args:
        loop: The loop that ran.
        record: The record of the run.
        cones: Friction cones of contacts that must not slide.
    """
    if (model := loop.plant.model) is None:
        return []
    dae, limits = model.dae, robot_limits(model, cones)
    rows = zip(record["state"], record["control"], record["constraint_force"], strict=True)
    values = np.array([limits.values(*row, dae.parameter_values)[0].copy() for row in rows])
    worst = limits.worst(values, record.time, np.abs(values).max(axis=0, initial=0.0))
    if worst is None:
        return []
    if loop.generator is None or dae.exogenous.moving:
        return [f"most of all {worst}"]
    law, reference = loop.controller.law, loop.generator.reference
    structure = law.structure if law.system is dae else find_structure(dae)
    times = record.time[:: record.time.size // MOST_TIMES + 1]
    motion = ZeroDynamics(dae, structure=structure).motion(reference, times, record["state"][0])
    along = limits_along(structure, limits, reference, motion)
    remedy = "the references alone keep all limits" if along is None else along.remedy
    return [f"most of all {worst}; {remedy}"]
