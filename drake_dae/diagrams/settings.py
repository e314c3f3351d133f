"""The settings of a closed loop besides plant, controller and references."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.dae.references import Reference
from drake_dae.dae.timing.motion_limits import MotionLimits
from drake_dae.errors import WiringError
from drake_dae.systems.control.command_filter import CommandLimits
from drake_dae.systems.control.sampling import Sampling
from drake_dae.systems.observing.observer_rates import Observing
from drake_dae.systems.sensing.encoders import Encoders
from drake_dae.systems.sensing.force_sensor import ForceSensor
from drake_dae.systems.sensing.tolerances import Tolerances


@checked(WiringError)
@dataclass(frozen=True, eq=False)
class LoopSettings:
    """The settings of a closed loop besides plant, controller and references.

    Attributes:
        sensor: The sensor of the constraint force, for a law with measured force. Without one the
            force is connected directly, if that closes no algebraic loop.
        encoders: The measurement of the state for the law, at its samples; the record has it as
            "estimated_state". None for the exact state.
        sampling: The period and delay of the law; its control is held between. The error is
            predicted up to first order in these times. None for a continuous law, or, on a discrete
            plant, one that acts at each of its steps.
        control_limits: The largest |u| of the drives, shape (p,), such as `model.control_limits`;
            the record has "excess", the part beyond. Integrals are not updated meanwhile. None for
            no limits.
        observer: The settings of a `DisturbanceObserver`, for a sampled law with measured force of
            a system that `with_disturbance` made. The record has its "disturbance" and "friction",
            and integrals are not updated while a contact is lost.
        exogenous: The exogenous signals of plant and law, as references for all entries of w in
            their order; constant if none are given.
        plant_exogenous: Those of the plant if they differ from the law's; None if they are equal.
        governed: The limits within which a `PathGovernor` slows the references; None for none. With
            `control_limits` as well, these and the limits of forces hold by `FeasibleControl`, and
            the record has its "departure".
        tolerances: The tolerated errors; a run that exceeds them ends with an exception.
        signals: Name -> reference of a signal for which a controller waits, as phases of a task do;
            it has come where it is above 1/2. One that is not given is an input port signal_<name>
            of the loop.
        commands: How fast references and exogenous signals follow what a person commands while the
            loop runs; see `CommandedReferences`. None for references that nobody changes.
        start_time: The start of a run, in s: the zero dynamics are judged at the references then.
    """

    sensor: ForceSensor | None = None
    encoders: Encoders | None = None
    sampling: Sampling | None = None
    control_limits: ArrayLike | None = None
    observer: Observing | None = None
    exogenous: Sequence[Reference] = ()
    plant_exogenous: Sequence[Reference] | None = None
    governed: MotionLimits | None = None
    tolerances: Tolerances | None = None
    signals: Mapping[str, Reference | float] = field(default_factory=dict)
    commands: CommandLimits | None = None
    start_time: float = 0.0

    def period(self, step: float) -> float:
        """The time between samples of the law in s, on a plant with such a step; 0 for none."""
        return step if self.sampling is None else self.sampling.period
