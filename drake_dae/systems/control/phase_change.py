"""A change of phase in the record of a run."""

from dataclasses import dataclass


@dataclass(frozen=True)
class PhaseChange:
    """The start of a phase of a task.

    Attributes:
        time: The time, in s.
        phase: The name of the phase that begins, "Approach" for example; "done" if the task is
            done, "held" if it ends in another way.
        place: Its index in the task, from 0; the number of phases when done or held.
        in_contact: Whether the law for contact is active from then on.
        reason: The reason for the end of the previous phase.
        force: The measured force of the contact then, in N.
        distance: The distance by the law's model then, in m.
        distance_rate: Its derivative, in m/s.
        chosen: The key word that led here from the phase before: the name of a phase, "next",
            "approach", "hold", "leave" or "stop"; empty at the start.
        failed: Whether the phase before failed.
    """

    time: float
    phase: str
    place: int
    in_contact: bool
    reason: str
    force: float
    distance: float
    distance_rate: float
    chosen: str = ""
    failed: bool = False

    def __str__(self) -> str:
        return (
            f"{self.time:.6g} s: {self.phase}, {self.reason}; {self.force:.4g} N, "
            f"{self.distance:.4g} m, {self.distance_rate:.3g} m/s"
        )
