"""The phases of a task, with their goals and their ends."""

from drake_dae.systems.task.phases.condition import Condition
from drake_dae.systems.task.phases.members import Approach, Dwell, Move, Press, Release, Retreat
from drake_dae.systems.task.phases.phase import Moment, Outcome, Phase

__all__ = [
    "Approach",
    "Condition",
    "Dwell",
    "Moment",
    "Move",
    "Outcome",
    "Phase",
    "Press",
    "Release",
    "Retreat",
]
