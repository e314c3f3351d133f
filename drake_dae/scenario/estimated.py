"""What an estimator on contact that gives way estimates where a scenario does not say it."""

from dataclasses import replace

import numpy as np

from drake_dae.robots import JointFriction, Plane, PointOnSurface, RobotModel, velocities_are_rates
from drake_dae.scenario.robot_file.robot import Payload
from drake_dae.scenario.scenario import Scenario

LEAST_MASS = 1e-6
"""The mass in kg of a load that nobody has stated; masses are positive."""

_LOAD, _TILT, _COULOMB, _VISCOUS = 0.2, 0.15, 0.1, 0.25
"""The largest load relative to the robot's mass, the largest tilt in rad, and the largest friction
of a joint in N m, and in N m per rad/s, relative to its largest effort."""

_PLACE = 0.01
"""The largest displacement of a plane in m."""

_CENTER = 0.2
"""The largest distance of a load from its frame's origin, in m."""

_EFFORT = 100.0
"""The largest effort in N m of drives without limits in the file."""


def estimates_all(scenario: Scenario, model: RobotModel) -> bool:
    """Whether an estimator of rigid joints may estimate what it can."""
    estimator, material = scenario.estimator, scenario.plant.material
    if estimator is None or estimator.parameters is not None or material is None:
        return False
    surfaces = [c.surface for c in scenario.constraints if isinstance(c, PointOnSurface)]
    is_plain = all(isinstance(surface, Plane) for surface in surfaces)  # On a sphere it got worse.
    is_rigid = not model.stages and velocities_are_rates(model.links)
    return is_plain and is_rigid and not scenario.exogenous


def with_friction_estimated(scenario: Scenario, model: RobotModel) -> Scenario:
    """The scenario of a law whose estimator knows the friction of contacts that have it."""
    assert scenario.estimator is not None
    names = [c.friction_parameter for c in model.constraints if c.friction_parameter]
    return replace(scenario, estimator=replace(scenario.estimator, parameters=names))


def with_all_estimated(scenario: Scenario, model: RobotModel) -> Scenario:
    """The scenario of a law whose estimator knows loads, places of planes, and friction.

    A load is at each frame in contact, a mass and its place; the friction is that of contacts, and
    Coulomb and viscous friction of all driven joints. Their bounds, from which their estimation
    starts, follow from masses and efforts of the robot's file.
    """
    assert scenario.estimator is not None
    robot, frictional = scenario.robot, list[str]()
    ranges: dict[str, float] = {}
    loads: dict[str, Payload] = {}
    known = {p.name for p in model.dae.parameters}
    masses = [p.value[0] for p in model.dae.parameters if p.name.endswith(".mass")]
    constraints = []
    for constraint in scenario.constraints:
        if isinstance(constraint, PointOnSurface):
            constraint = replace(constraint, friction=constraint.friction or 0.0)
            frictional.append(f"{constraint.name}.friction")
            if scenario.compliances is None:  # Surfaces of redundant constraints are not estimated.
                constraint = replace(constraint, rpy=constraint.rpy or (0.0, 0.0, 0.0))
                ranges[f"{constraint.name}.rpy"] = _TILT
                ranges[f"{constraint.name}.position"] = _PLACE
            if constraint.frame not in loads:
                name = constraint.frame.replace("::", "_") + "_load"
                loads[constraint.frame] = Payload(constraint.frame, LEAST_MASS, name=name)
                ranges[f"{name}.mass"] = _LOAD * sum(masses)
                ranges[f"{name}.center"] = _CENTER
        constraints.append(constraint)
    # An effort that the file does not limit is taken for the largest one that it does.
    names_of_joints = [signal.name for signal in model.links.position_signals]
    efforts = np.where(np.isfinite(model.control_limits), model.control_limits, 0.0)
    largest = float(np.max(efforts, initial=0.0)) or _EFFORT
    efforts = np.where(efforts > 0.0, efforts, largest)
    if efforts.size != len(names_of_joints):
        efforts = np.full(len(names_of_joints), largest)
    joints = [joint for joint in names_of_joints if f"{joint}.coulomb" not in known]
    for joint, effort in zip(names_of_joints, efforts.tolist(), strict=True):
        ranges[f"{joint}.coulomb"] = _COULOMB * effort
        ranges[f"{joint}.viscous"] = _VISCOUS * effort
    forces = [*robot.known_forces, *([JointFriction(joints)] if joints else [])]
    return replace(
        scenario,
        robot=replace(robot, payloads=[*robot.payloads, *loads.values()], known_forces=forces),
        constraints=constraints,
        estimator=replace(scenario.estimator, parameters=[*frictional, *ranges], ranges=ranges),
    )
