"""A robot's own limits as limits of a motion along a path."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.timing.motion_limits import FrictionCone, MotionLimits, Range
from drake_dae.errors import ModelError
from drake_dae.robots.model import RobotModel


@checked(ModelError)
def robot_motion_limits(
    model: RobotModel,
    *,
    efforts: float = 1.0,
    joint_speeds: float = 1.0,
    joint_accelerations: float = 1.0,
    forces: Mapping[str, Range] | None = None,
    cones: Sequence[FrictionCone] = (),
) -> MotionLimits:
    """Shares of the limits of a robot's drives and joints, and limits of its contact forces.

    Forces of contacts that can only push are 0 or more where they have no other limit.

    Args:
        model: The robot, with rigid joints.
        efforts: The share of the effort limits of the drives, at most 1.
        joint_speeds: The share of the joints' velocity limits, at most 1.
        joint_accelerations: The share of the joints' acceleration limits, at most 1; URDF has no
            such limits except as `drake:acceleration`.
        forces: Constraint force -> its least and its largest value, in N or N m.
        cones: Friction cones of contacts that must not slide.

    Raises:
        ModelError: A share is not in (0, 1].
    """
    shares = dict(
        efforts=efforts, joint_speeds=joint_speeds, joint_accelerations=joint_accelerations
    )
    for name, share in shares.items():
        if not 0.0 < share <= 1.0:
            raise ModelError(
                f"{name} is a share of the robot's own limits, above 0 and at most 1, got {share:g}"
            )
    links, plant = model.links, model.links.plant
    velocities = links.velocity_signals
    controls = zip(model.dae.control_signals, model.control_limits, strict=True)
    accelerations: dict[str, Range] = {}
    if plant is not None:
        low, high = plant.GetAccelerationLowerLimits(), plant.GetAccelerationUpperLimits()
        accelerations = _ranges(velocities, low, high, joint_accelerations)
    return MotionLimits(
        controls={
            signal.name: (-efforts * limit, efforts * limit)
            for signal, limit in controls
            if np.isfinite(limit)
        },
        states=_ranges(velocities, *links.velocity_limits, joint_speeds),
        rates=accelerations,
        forces={**dict.fromkeys(_pushing(model), (0.0, None)), **(forces or {})},
        cones=cones,
    )


def _ranges(
    signals: Sequence[Signal], low: FloatArray, high: FloatArray, share: float
) -> dict[str, Range]:
    """The share of the limits of signals that have any."""
    return {
        signal.name: (_share(share, least), _share(share, most))
        for signal, least, most in zip(signals, low, high, strict=True)
        if np.isfinite(least) or np.isfinite(most)
    }


def _share(share: float, limit: float) -> float | None:
    return share * float(limit) if np.isfinite(limit) else None


def _pushing(model: RobotModel) -> Iterable[str]:
    """The names of constraint forces that can only push."""
    known = {signal.name for signal in model.dae.constraint_input_signals}
    for constraint in model.constraints:
        for signal, pushes in zip(constraint.force_signals, constraint.is_unilateral, strict=True):
            if pushes and signal.name in known:
                yield signal.name
