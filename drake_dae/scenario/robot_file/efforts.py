"""Effort limits in a robot's files that Drake does not read, or reads in another unit."""

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from drake_dae.robots.links.frames import joint_names
from drake_dae.scenario.robot_file.loops import actuators_of
from drake_dae.scenario.robot_file.readable.markup import parsed

Efforts = Mapping[tuple[str, str], float]
"""(model instance, joint) -> effort limit in N m or N; the instance is "" for a single file."""


def read_efforts(models: Mapping[str, Path]) -> Efforts:
    """Reads the effort limits of joints from URDF files.

    Args:
        models: Model instance, or "" for a single file -> the file.
    """
    efforts: dict[tuple[str, str], float] = {}
    for instance, file in models.items():
        root = parsed(file.read_bytes())
        for joint in root.iterfind("joint") if file.suffix == ".urdf" else ():
            limit = joint.find("limit")
            with suppress(ValueError):
                effort = float("" if limit is None else limit.get("effort", ""))
                if 0.0 < effort < np.inf:  # Many authors write 0 for an unknown limit.
                    efforts[instance, joint.get("name", "")] = effort
    return efforts


def limit_joints(plant: MultibodyPlant, models: Mapping[str, Path]) -> None:
    """Converts limits of the motors in MJCF files to effort limits of their joints.

    In MJCF the effort at a joint is the gear times the control of its motor. Drake reads the limit
    of this control as a limit of the effort.

    Args:
        plant: The robot, not finalized; changed.
        models: Model instance, or "" for a single file -> the file.
    """
    for actuator in actuators_of(plant):
        instance = plant.GetModelInstanceName(actuator.model_instance())
        file = models.get(instance, models.get("", Path()))
        limit, gear = actuator.effort_limit(), actuator.default_gear_ratio()
        if file.suffix == ".xml" and np.isfinite(limit) and gear != 0.0:
            actuator.set_effort_limit(abs(gear) * limit)


def limits_of(plant: MultibodyPlant, efforts: Efforts) -> dict[str, float]:
    """The effort limits by the names of the joints in a scenario."""
    limits: dict[str, float] = {}
    for name, joint in joint_names(plant).items():
        instance = plant.GetModelInstanceName(joint.model_instance())
        for key in ((instance, joint.name()), ("", joint.name())):
            if key in efforts:
                limits.setdefault(name, efforts[key])
    return limits
