"""The rates and thresholds of an observer."""

from dataclasses import dataclass, fields

from drake_dae.arguments import checked
from drake_dae.arrays import positive
from drake_dae.errors import ModelError


@checked(ModelError)
@dataclass(frozen=True)
class Observing:
    """The rates of a `StateEstimator` in 1/s, and its thresholds for friction.

    k_o is the `rate` of disturbances along the free directions, k_n the `force_rate` along the
    constrained ones, which change only constraint forces; None for k_o. With w, the `state_rate`,
    the state is corrected by measured positions; None for the state as it is measured. k_f, the
    `friction_rate`, is that of coefficients of friction, from 0 to `largest_friction`. Below
    `least_speed`, in m/s, a contact may stick, and below `least_force`, in N, it counts as lost.
    """

    rate: float
    friction_rate: float = 3.0
    largest_friction: float = 1.0
    least_speed: float = 0.005
    least_force: float = 1.0
    force_rate: float | None = None
    state_rate: float | None = None

    def __post_init__(self) -> None:
        for each in fields(Observing):  # A form may have more.
            if (value := getattr(self, each.name)) is not None:
                positive(each.name, value)
