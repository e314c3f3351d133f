"""The key `time_optimal` of a scenario."""

from dataclasses import dataclass, field
from typing import Annotated

import pydantic

from drake_dae.dae.timing.motion_limits import FrictionCone
from drake_dae.errors import ModelError
from drake_dae.scenario.forms.forms import Form

ForceRange = Annotated[tuple[float | None, float | None], pydantic.Strict(False)]
"""A least and a largest force; null where there is none."""


@dataclass(frozen=True)
class TimeOptimal:
    """The references are paths, which are followed in the shortest time from rest to rest.

    The motion keeps the limits of drives, joints and contacts, and the `limits` of paths except
    their jerk. Joints must be rigid.

    Attributes:
        efforts: The fraction of the drives' effort limits that the motion may use; the rest is left
            for feedback.
        joint_speeds: The fraction of the joints' velocity limits that the motion may use. Half of
            the rest is left for feedback; with the other half a governor keeps the limits where the
            model's accelerations are not exact.
        joint_accelerations: The fraction of the joints' acceleration limits that the motion may
            use, if the robot's file has such limits.
        forces: Constraint force -> its least and its largest value in N or N m; null
            for none. Unilateral forces are 0 or more.
        cones: Friction cones of contacts that must not slide; the motion uses 99 % of them.
        largest_rate: The largest ratio of the motion's speed to that of the references. With 1 the
            motion is only slowed down. No limit if left out.
        until: The time of the references at which the path ends, in s. If left out it is
            `duration`, and the run lasts as long as the motion, with a governor 0.5 s longer.
        points: The number of intervals of the grid along the path.
        governor: Whether the motion is slowed down during the run where the robot, off its path,
            would exceed a limit.
    """

    efforts: float = 0.95
    joint_speeds: float = 0.95
    joint_accelerations: float = 0.95
    forces: dict[str, ForceRange] = field(default_factory=dict)
    cones: list[Annotated[FrictionCone, Form()]] = field(default_factory=list)
    largest_rate: float | None = None
    until: float | None = None
    points: int = 1000
    governor: bool = True

    def __post_init__(self) -> None:
        for name in ("efforts", "joint_speeds", "joint_accelerations"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise ModelError(
                    f"{name} is a share of the robot's own limits, above 0 and at most 1, got "
                    f"{getattr(self, name):g}"
                )
        if self.largest_rate is not None and not self.largest_rate > 0.0:
            raise ModelError(f"largest_rate must be positive, got {self.largest_rate:g}")
        if not 20 <= self.points <= 20_000:
            raise ModelError(f"points must be from 20 to 20000, got {self.points}")
