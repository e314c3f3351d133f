"""The decision whether a phase goes on, and how it has ended."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from drake_dae.arrays import FloatArray, show
from drake_dae.errors import SimulationError
from drake_dae.systems.task.contacts.open_contact import OpeningContact
from drake_dae.systems.task.phases import Moment, Outcome, Phase
from drake_dae.systems.task.progress import LET_GO, ReferenceSegment, TaskProgress
from drake_dae.systems.task.traced import EARLY, TracedTask


@dataclass(frozen=True, eq=False)
class PhaseDecision:
    """The numbers that decide whether a phase goes on.

    Attributes:
        moment: The measurements.
        guards: For each guard of the phase a number that is positive until it trips.
        margins: Numbers that are positive until a guard trips, the phase succeeds, the contact is
            lost, the phase is late, and the contact begins or ceases to be felt.
    """

    moment: Moment
    guards: FloatArray
    margins: FloatArray

    @classmethod
    def of(
        cls,
        traced: TracedTask,
        progress: TaskProgress,
        moment: Moment,
        time: float,
        held: FloatArray,
    ) -> Self:
        """The decision at one moment of a run.

        Args:
            traced: The functions of the task.
            progress: Its progress.
            moment: The measurements.
            time: The time, in s.
            held: The numbers of the task before the sample.
        """
        task, change, guards = traced.task, progress.segments[-1].change, np.zeros(0)
        excess, lost, end, late = moment.force - task.contact_force, np.inf, np.inf, np.inf
        phases, holds = task.plan.phases, True
        if change.place < len(phases):
            phase = phases[change.place]
            late, holds = float(phase.remaining(moment)), phase.holds_contact
            if not traced.tares(held):
                end = float(phase.success(moment, task.contact_force))
            guards = np.array([float(moment.margin(guard)) for guard in phase.guards])
        if holds and change.in_contact and not progress.is_felt:
            lost = task.patience - (time - progress.felt)
        felt = excess + LET_GO * task.contact_force if progress.is_felt else -excess
        nearest = np.min(guards, initial=np.inf)
        return cls(moment, guards, np.array([nearest, end, lost, late, felt]))

    @property
    def ends(self) -> bool:
        """Whether the phase is over."""
        return bool(np.any(self.margins[:-1] <= 2.0 * EARLY))

    @property
    def turns(self) -> bool:
        """Whether the contact begins or ceases to be felt."""
        return bool(self.margins[-1] <= 2.0 * EARLY)

    def outcome(self, phase: Phase, contact_force: float) -> tuple[Outcome, str]:
        """How a phase has ended, and why.

        Args:
            phase: The phase.
            contact_force: Forces below this, in N, count as zero.
        """
        ended = self.margins <= 2.0 * EARLY
        if ended[0]:
            guard = phase.guards[int(np.argmax(self.guards <= 2.0 * EARLY))]
            value = float(self.moment.value(guard))
            return "guard", f"{phase.name} is ended by {guard}, with {value:.4g}"
        if ended[1]:
            return "success", f"after {phase.awaits(contact_force)}"
        if ended[2]:
            return "lost", f"the contact of {phase.name} is lost"
        return "late", phase.lateness(self.moment, contact_force)

    def failure(self, reason: str, time: float, state: FloatArray) -> SimulationError:
        """The error of a task that ends by "fail".

        Args:
            reason: The reason.
            time: In s.
            state: x, shape (n,).
        """
        moment = self.moment
        return SimulationError(
            f"task: {reason}, at t = {time:.6g} s, with a force of {moment.force:.4g} "
            f"N at a distance of {moment.distance:.4g} m (by the law's model) that changes by "
            f"{moment.rate:.3g} m/s, state {show(state)}. Give the phase more time or another "
            "goal, look where the surface is, or choose what follows by on_failure",
            time,
            state.copy(),
        )


def moment_of(
    segment: ReferenceSegment,
    contact: OpeningContact,
    time: float,
    motion: tuple[float, float, FloatArray],
    forces: Sequence[float],
    signals: Mapping[str, float],
    controls: Mapping[str, float],
) -> Moment:
    """The measurements that decide when the phase of a segment ends.

    Args:
        segment: The current references.
        contact: The contact that opens and closes.
        time: The time, in s.
        motion: As of `TaskPlanner.motion`.
        forces: The measured forces of the contact.
        signals, controls: As of `Moment`.
    """
    (distance, rate, moved), change = motion, segment.change
    wanted = [contact.main] if change.in_contact else list(contact.places)
    return Moment(
        time=time - change.time,
        force=float(np.sum(forces)),
        distance=distance,
        rate=rate,
        wanted=float(np.mean(segment.reference(time)[segment.layout.lowest[wanted]])),
        away=distance - change.distance,
        travel=float(np.linalg.norm(moved - segment.origin)),
        signals=signals,
        controls=controls,
    )
