"""How fast an observer observes, and what it believes."""

from dataclasses import dataclass

from drake_dae.arguments import checked
from drake_dae.arrays import positive
from drake_dae.errors import ModelError


@checked(ModelError)
@dataclass(frozen=True)
class Observing:
    """How fast a `DisturbanceObserver` observes, and when it believes what it sees of friction.

    Attributes:
        rate: k_o in 1/s, at which a disturbance is found that moves what the constraints leave.
        force_rate: k_n in 1/s, at which that part is found that the constraints answer, and which
            changes their forces alone; None for k_o.
        friction_rate: k_f in 1/s, at which coefficients of friction take their share of it.
        largest_friction: Above which no coefficient of friction goes.
        least_speed: The speed in m/s below which a contact may stick: then its friction is any.
        least_force: The force, in N, below which a contact is lost: its coefficient stands still,
            and so do integrals.

    Raises:
        ModelError: A number is not positive.
    """

    rate: float
    friction_rate: float = 3.0
    largest_friction: float = 1.0
    least_speed: float = 0.005
    least_force: float = 1.0
    force_rate: float | None = None

    def __post_init__(self) -> None:
        for name in ("rate", "friction_rate", "largest_friction", "least_speed", "least_force"):
            positive(name, getattr(self, name))
        if self.force_rate is not None:
            positive("force_rate", self.force_rate)
