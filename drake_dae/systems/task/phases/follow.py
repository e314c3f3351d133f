"""A move along an edge, in contact with its face and its side."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from math import isfinite

from drake_dae.arguments import checked
from drake_dae.arrays import positive
from drake_dae.dae.references import LineReference, PathLimits, Reference
from drake_dae.errors import ModelError
from drake_dae.systems.task.phases.phase import Moment, Phase


@checked(ModelError)
@dataclass(frozen=True)
class Follow(Phase):
    """The tool follows an edge over a length; the paths of its contact points give the edge's line.

    It needs a tip of two points, one on the face and one beside it against the side, as in
    `contact: [face, side]` of a task. Both forces stay as they were, and one output moves along the
    edge.

    Why two points: let F_1 > 0 press a single ball of radius r on the face and F_2 > 0 against the
    side of a convex edge. It touches the edge, and its center is at r (cos a n_1 + sin a n_2) from
    it, so the forces have the potential

        V(a) = r (F_1 cos a + F_2 sin a),

    whose only stationary point, tan a = F_2 / F_1, is a maximum: the ball rolls off. With one point
    on each plane, the rows n_i^T J_i v of J are independent, and the law attains both forces.

    The tool follows an edge that is off its place by the forces alone. At the speed v and an angle
    d the planes move below the points by v sin d across, so the law, which does not know d, has an
    error of the force; an integral of the forces, or an observer, removes it.

    The phase succeeds after its length. Beyond the end of the edge the contact is lost; where one
    of the points loses it alone, a guard of the `eccentricity` ends the phase.

    Attributes:
        along: The output along the edge by the law's model, in m: "tool.z" for example.
        length: The change of this output, in m; negative if it falls.
        speed: The largest speed, in m/s.
        acceleration: The largest acceleration, in m/s^2.
        over: The duration of the transition from the previous references, in s.
        within: The largest duration of the phase, in s.
        if_late: The successor if it lasts longer; on_failure if left out.
        if_lost: The successor if the contact is lost; on_failure if left out.
    """

    along: str
    length: float
    speed: float = 0.02
    acceleration: float = 0.5
    within: float = field(default=60.0, kw_only=True)
    if_late: str | None = field(default=None, kw_only=True)
    if_lost: str | None = field(default=None, kw_only=True)
    begins_in_contact, ends_in_contact, holds_contact = True, True, True
    is_relative, finds_line = True, True

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isfinite(self.length) or self.length == 0.0:
            raise ModelError(f"Follow: length must be finite and not 0, got {self.length}")
        for name in ("speed", "acceleration"):
            positive(f"Follow: {name}", getattr(self, name))

    @cached_property
    def path(self) -> LineReference:
        """The output relative to its start."""
        return LineReference([0.0], [self.length], PathLimits(self.speed, self.acceleration))

    @property
    def duration(self) -> float:
        """The duration of the whole way, in s."""
        return self.path.travel.duration + self.over

    def goals(self, contact_output: str) -> Mapping[str, Reference | float]:
        return {self.along: self.path}

    def needed(self, contact_force: float) -> Mapping[str, float]:
        return {"time": self.duration}

    def margin(self, now: Moment, contact_force: float) -> float:
        return self.duration - now.time

    def awaited(self, contact_force: float) -> str:
        return f"a length of {abs(self.length):g} m"
