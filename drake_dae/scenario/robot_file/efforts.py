"""Effort limits of a robot's files that Drake does not read, or reads in another unit."""

from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from drake_dae.robots.links.frames import joint_names

Efforts = Mapping[tuple[str, str], float]
"""Model instance ("" where a file is read alone) and joint -> effort limit in N m or N."""


def read_efforts(models: Mapping[str, Path]) -> Efforts:
    """The effort limits of joints in URDF files; others have none.

    Args:
        models: Model instance, or "", -> file that Drake has read.
    """
    found: dict[tuple[str, str], float] = {}
    for instance, file in models.items():
        if file.suffix != ".urdf":
            continue
        try:
            root = ElementTree.fromstring(file.read_bytes())
        except ElementTree.ParseError:
            continue  # Drake accepts undeclared prefixes.
        for joint in root.iterfind("joint"):
            limit = joint.find("limit")
            try:
                effort = float("" if limit is None else limit.get("effort", ""))
            except ValueError:
                continue
            if 0.0 < effort < np.inf:  # Many authors write 0 for an unknown limit.
                found[instance, joint.get("name", "")] = effort
    return found


def limit_joints(plant: MultibodyPlant, models: Mapping[str, Path]) -> None:
    """Converts limits of the motors in MJCF files to effort limits of their joints.

    A motor of MJCF applies gear times its control to the joint. Drake reads the limit of that
    control, but its own control is the effort at the joint.

    Args:
        plant: The robot, not finalized; changed.
        models: Model instance, or "", -> file that Drake has read.
    """
    for index in plant.GetJointActuatorIndices():
        actuator = plant.get_joint_actuator(index)
        instance = plant.GetModelInstanceName(actuator.model_instance())
        file = models.get(instance, models.get("", Path()))
        limit, gear = actuator.effort_limit(), actuator.default_gear_ratio()
        if file.suffix == ".xml" and np.isfinite(limit) and gear != 0.0:
            actuator.set_effort_limit(abs(gear) * limit)


def limits_of(plant: MultibodyPlant, efforts: Efforts) -> dict[str, float]:
    """The effort limits by the names that joints have in a scenario."""
    limits: dict[str, float] = {}
    for name, joint in joint_names(plant).items():
        instance = plant.GetModelInstanceName(joint.model_instance())
        for key in ((instance, joint.name()), ("", joint.name())):
            if key in efforts:
                limits.setdefault(name, efforts[key])
    return limits
