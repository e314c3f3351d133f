"""What a closed loop has beside its plant, its controller and its references."""

from collections.abc import Sequence
from dataclasses import dataclass

from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.dae.references import Reference
from drake_dae.errors import WiringError
from drake_dae.systems.control.observer_rates import Observing
from drake_dae.systems.control.sampling import Sampling
from drake_dae.systems.sensing.encoders import Encoders
from drake_dae.systems.sensing.force_sensor import ForceSensor
from drake_dae.systems.sensing.tolerances import Tolerances


@checked(WiringError)
@dataclass(frozen=True, eq=False)
class LoopSettings:
    """What a closed loop has beside its plant, its controller and its references.

    Attributes:
        sensor: The sensor of the constraint force, for a law with measured force. Without one the
            force is connected as it is, where that closes no algebraic loop.
        encoders: How the state is measured that the law gets, when it reads; the signal
            "estimated_state" of the record tells it. None where it gets the state as it is.
        sampling: When the law reads and acts: a period and a delay, and its control is held
            between. The error is that of the theory up to one order of these times. None for a law
            that acts continuously, or, on a discrete plant, at each of its steps.
        control_limits: The largest |u| that the drives give, shape (p,), such as
            `model.control_limits`; the signal "excess" of the record tells what was cut off, and
            when. Integrals stand still meanwhile. None for drives without limits.
        observer: How a `DisturbanceObserver` observes what the law's model lacks, for a sampled law
            with measured force of a system that `with_disturbance` made. The signals "disturbance"
            and "friction" of the record are what it found, and integrals stand still while a
            contact is lost.
        exogenous: The exogenous signals of the plant, which its law knows too, as references that
            together cover all entries of w, in their order; without any nothing moves.
        plant_exogenous: Those of the plant, where its law knows others, or has none; None for the
            same.
        tolerances: How large errors may be, or a run ends with an exception that tells it.
        start_time: When a run begins, in s: the zero dynamics are judged at the references then.
    """

    sensor: ForceSensor | None = None
    encoders: Encoders | None = None
    sampling: Sampling | None = None
    control_limits: ArrayLike | None = None
    observer: Observing | None = None
    exogenous: Sequence[Reference] = ()
    plant_exogenous: Sequence[Reference] | None = None
    tolerances: Tolerances | None = None
    start_time: float = 0.0

    def period(self, step: float) -> float:
        """The time between samples of the law in s, on a plant with such a step; 0 for none."""
        return step if self.sampling is None else self.sampling.period
