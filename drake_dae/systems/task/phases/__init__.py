"""The phases of a task, with their goals and their ends."""

from drake_dae.systems.task.phases.follow import Follow
from drake_dae.systems.task.phases.guarded import GuardedMove, Wait
from drake_dae.systems.task.phases.guards import PhaseGuard
from drake_dae.systems.task.phases.insert import Insert
from drake_dae.systems.task.phases.members import (
    Approach,
    Close,
    Dwell,
    Move,
    Press,
    Release,
    Retreat,
)
from drake_dae.systems.task.phases.phase import Moment, Outcome, Phase
from drake_dae.systems.task.phases.screw import Screw
from drake_dae.systems.task.phases.search import Search

__all__ = [
    "Approach",
    "Close",
    "Dwell",
    "Follow",
    "GuardedMove",
    "Insert",
    "Moment",
    "Move",
    "Outcome",
    "Phase",
    "PhaseGuard",
    "Press",
    "Release",
    "Retreat",
    "Screw",
    "Search",
    "Wait",
]
