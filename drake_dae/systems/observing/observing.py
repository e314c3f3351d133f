"""The rates and thresholds of an observer."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields

from drake_dae.arguments import checked
from drake_dae.arrays import positive
from drake_dae.errors import ModelError


@checked(ModelError)
@dataclass(frozen=True)
class Observing:
    """The rates of a `StateEstimator` in 1/s, and its thresholds for friction.

    Attributes:
        rate: k_o, the rate of disturbances along the free directions.
        force_rate: k_n, the rate of disturbances along the constrained directions, which change
            only constraint forces; None for k_o.
        state_rate: w, the rate at which the state is corrected by measured positions; None for the
            state as it is measured.
        friction_rate: k_f, the rate at which coefficients of friction are identified, unless other
            parameters are estimated, and friction with these.
        largest_friction: The upper bound of coefficients of friction.
        least_speed: The speed in m/s below which a contact may stick, so that its friction is not
            identified.
        ranges: Parameter name -> the largest deviation from its value, of estimated parameters that
            have no bounds.
        least_force: The force in N below which a contact counts as lost: its coefficient and
            integrals are not updated.
    """

    rate: float
    friction_rate: float = 3.0
    largest_friction: float = 1.0
    least_speed: float = 0.005
    least_force: float = 1.0
    force_rate: float | None = None
    state_rate: float | None = None
    ranges: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for each in fields(Observing):  # A form may have more.
            value = getattr(self, each.name)
            for number in value.values() if each.name == "ranges" else [value]:
                if number is not None:
                    positive(each.name, number)
