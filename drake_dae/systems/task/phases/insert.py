"""The insertion of a tool into a hole with clearance."""

from dataclasses import dataclass, field

import casadi as ca

from drake_dae.arguments import checked
from drake_dae.arrays import positive
from drake_dae.errors import ModelError
from drake_dae.systems.task.phases.phase import Moment, Phase


@checked(ModelError)
@dataclass(frozen=True)
class Insert(Phase):
    """The tool moves into a hole at a constant speed, until it is deep enough.

    The law of the free robot acts, all other outputs come to rest, and the hole pushes them aside:
    a force F and a torque in the hole cause errors e of the outputs by

        e_i'' + a_i1 e_i' + a_i0 e_i = (P M^-1 J^T)_i F

    with the gains a of the free law, `task.gains` in a scenario. An output with the poles -p and -s
    is a spring of m p s and a damper of m (p + s) at the point of the tool, where m is the mass
    that it feels there. So the phase needs soft gains along and about the surface, and no observer
    of disturbances, which would cancel what the hole exerts. A slow and a fast pole along the
    surface let the hole move the tool without a force that remains, and damp it. On a robot whose
    inertia couples the outputs, a push along the hole also tilts the tool, until it jams: there
    `impedance_gains` give each output a stiffness by itself.

    The phase fails if the distance falls behind its reference by more than `lag`, as where the tool
    jams, or sits on the face beside the hole. The push along the hole is then at most m (p^2 lag +
    2 p speed), with both poles of the distance at -p.

    Attributes:
        depth: The depth of the tool below the surface of the model at which it ends, in m.
        speed: The speed, in m/s.
        lag: The largest lag of the distance behind its reference, in m.
        over: The duration of the transition from the previous references, in s.
        within: The largest duration of the phase, in s.
        if_late: The successor if it lags more or lasts longer; on_failure if left out.
    """

    depth: float
    speed: float = 0.01
    lag: float = 0.01
    within: float = field(default=60.0, kw_only=True)
    if_late: str | None = field(default=None, kw_only=True)
    begins_in_contact, ends_in_contact = False, False
    enters_holes = True

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("depth", "speed", "lag"):
            positive(f"Insert: {name}", getattr(self, name))

    @property
    def speed_of_approach(self) -> float:
        return self.speed

    def margin(self, now: Moment, contact_force: float) -> float:
        return self.depth + now.distance

    def remaining(self, now: Moment) -> float:
        remaining: float = ca.fmin(super().remaining(now), self.lag - (now.distance - now.wanted))
        return remaining

    def lateness(self, now: Moment, contact_force: float) -> str:
        if now.time >= self.within:
            return super().lateness(now, contact_force)
        return (
            f"{self.name} lags {now.distance - now.wanted:.3g} m behind its reference at a depth "
            f"of {-now.distance:.3g} m, with a force of {now.force:.3g} N"
        )

    def awaited(self, contact_force: float) -> str:
        return f"a depth of {self.depth:g} m"
