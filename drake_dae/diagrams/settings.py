"""The settings of a closed loop besides plant, controller and references."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.errors import WiringError
from drake_dae.references import Reference
from drake_dae.systems.control.sampling import Sampling
from drake_dae.systems.observing.observing import Observing
from drake_dae.systems.sensing.encoders import Encoders
from drake_dae.systems.sensing.force_sensor import ForceSensor


@checked(WiringError)
@dataclass(frozen=True, eq=False)
class LoopSettings:
    """The settings of a closed loop besides plant, controller and references.

    Attributes:
        sensor: The sensor of the constraint force, for a law with measured force. Without one the
            force is connected directly, if that closes no algebraic loop.
        encoders: The measurement of the state for the law, at its samples; the record has it as
            "estimated_state". None for the exact state.
        sampling: The period and delay of the law, with a zero-order hold of its control. The error
            is predicted up to first order in these times. None for a continuous law, or on a
            discrete plant for a law that is evaluated at each step of the plant.
        control_limits: The largest |u| of the drives, shape (p,), such as `model.control_limits`;
            the record has "excess", the part beyond. Integrals are not updated meanwhile. None for
            no limits.
        observer: The settings of a `StateEstimator`, for a sampled law with measured force of
            a system that `with_disturbance` made. The record has its "disturbance" and "friction",
            and integrals are not updated while a contact is lost.
        exogenous: The references of all exogenous signals w of plant and law, in their order; w is
            constant if empty.
        plant_exogenous: The references of the plant's exogenous signals; None if they equal the
            law's.
        signals: Name -> reference of a signal for which a controller waits, such as phases of a
            task; the signal is set where the reference is above 1/2. For any other signal the loop
            has an input port signal_<name>.
        commanded: Whether a person changes references and exogenous signals during the run; see
            `CommandedReferences`.
        start_time: The start time of a run, in s: the stability of the zero dynamics is judged with
            the references at this time.
    """

    sensor: ForceSensor | None = None
    encoders: Encoders | None = None
    sampling: Sampling | None = None
    control_limits: ArrayLike | None = None
    observer: Observing | None = None
    exogenous: Sequence[Reference] = ()
    plant_exogenous: Sequence[Reference] | None = None
    signals: Mapping[str, Reference | float] = field(default_factory=dict)
    commanded: bool = False
    start_time: float = 0.0

    def period(self, step: float) -> float:
        """The time between samples of the law in s, on a plant with such a step; 0 for none."""
        return step if self.sampling is None else self.sampling.period
