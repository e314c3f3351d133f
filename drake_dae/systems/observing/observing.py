"""The rates and thresholds of an observer."""

from dataclasses import dataclass

from drake_dae.arguments import checked
from drake_dae.arrays import positive
from drake_dae.errors import ModelError


@checked(ModelError)
@dataclass(frozen=True)
class Observing:
    """The rates of a `StateEstimator`, and its thresholds for friction.

    Attributes:
        rate: k_o in 1/s, the rate of disturbances along the free directions.
        force_rate: k_n in 1/s, the rate of disturbances along the constrained directions, which
            change only constraint forces; None for k_o.
        state_rate: w in 1/s, the rate at which a `StateEstimator` corrects the state by measured
            positions; None for the state as it is measured.
        friction_rate: k_f in 1/s, the rate at which coefficients of friction are identified.
        largest_friction: The upper bound of coefficients of friction.
        least_speed: The speed in m/s below which a contact may stick, so that its friction is not
            identified.
        least_force: The force in N below which a contact counts as lost: its coefficient and
            integrals are not updated.

    Raises:
        ModelError: A number is not positive.
    """

    rate: float
    friction_rate: float = 3.0
    largest_friction: float = 1.0
    least_speed: float = 0.005
    least_force: float = 1.0
    force_rate: float | None = None
    state_rate: float | None = None

    def __post_init__(self) -> None:
        for name in ("rate", "friction_rate", "largest_friction", "least_speed", "least_force"):
            positive(name, getattr(self, name))
        for name in ("force_rate", "state_rate"):
            if getattr(self, name) is not None:
                positive(name, getattr(self, name))
