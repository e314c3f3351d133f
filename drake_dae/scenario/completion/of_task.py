"""Completion of a scenario with a task: references for its outputs, and a start off the surface."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.errors import ReferenceSignalError, ScenarioError
from drake_dae.references import Reference
from drake_dae.references.by_name import denoted
from drake_dae.robots.constraints import Constraint
from drake_dae.robots.links.links import Links
from drake_dae.scenario.completion.completion import Completed, complete, rounded, start_note
from drake_dae.scenario.completion.search import near_posture
from drake_dae.scenario.completion.setting import Setting
from drake_dae.scenario.parts.task import ScenarioTask
from drake_dae.scenario.scenario import Scenario

BEFORE = 0.02
"""The distance in m from its surface at which a task without start.positions begins."""


def complete_task(
    scenario: Scenario,
    links: Links,
    constraints: Sequence[Constraint],
    of_plant: Sequence[Constraint],
    guess: FloatArray,
) -> Completed:
    """Chooses the missing outputs of a scenario with a task, and its start.

    Outputs are chosen as for the references of its phases. The start has the first reference of
    each output; a task that begins without contact starts `BEFORE` its surface.

    Args:
        scenario, links, constraints, of_plant, guess: As of `complete`.

    Raises:
        ScenarioError: As of `complete`, or no start is found.
    """
    assert scenario.task is not None
    setting = Setting.of(scenario, links, constraints, of_plant)
    is_given = bool(scenario.start.positions)
    if setting.missing == 0 and is_given:
        return Completed(scenario)
    candidates = setting.candidates(scenario, links)
    at_guess = setting.postures(scenario, links, candidates).at(guess)
    distances = [signal.name for signal in setting.bound.residual_signals]
    without = _with_references(scenario, setting.names, at_guess.rows, distances)
    try:
        completed = complete(without, links, constraints, of_plant, guess)
    except ScenarioError as error:
        keys = [key.replace("references", "task.phases", 1) for key, _ in error.problems]
        pairs = zip(keys, (text for _, text in error.problems), strict=True)
        raise ScenarioError(*pairs) from None
    chosen = completed.scenario
    notes = [note for note in completed.notes if not note.startswith("start found")]
    result = replace(scenario, outputs=chosen.outputs)
    if is_given:
        return Completed(result, tuple(notes))
    names = [signal.name for signal in links.position_signals]
    q = np.array(
        [chosen.start.positions.get(name, x) for name, x in zip(names, guess, strict=True)]
    )
    if not scenario.task.phases[0].begins_in_contact:
        setting = Setting.of(chosen, links, constraints, of_plant)
        q = _off_surface(chosen, scenario.task, links, setting, q)
    positions = dict(zip(names, rounded(q).tolist(), strict=True))
    start = replace(scenario.start, positions=positions)
    return Completed(replace(result, start=start), (*notes, start_note(positions)))


def _with_references(
    scenario: Scenario, outputs: Sequence[str], values: FloatArray, distances: Sequence[str]
) -> Scenario:
    """The scenario with the references of its phases in place of its task.

    An output has the first reference that a phase gives it. One without any keeps its value.

    Args:
        scenario: A scenario with a task.
        outputs: The names of its position outputs.
        values: Their values at start.positions, or at the default configuration.
        distances: The names of the distances, which are outputs only while contacts are open.
    """
    assert scenario.task is not None
    references = dict[str, Any]()
    for phase in scenario.task.phases:
        goals: Mapping[str, Reference | float] = getattr(phase, "references", {})
        for key, reference in goals.items():
            parts = [part.strip() for part in key.split(",")]
            kept = ", ".join(part for part in parts if part not in distances)
            # The rows of a Reference cannot be taken apart here.
            if kept and (
                len(kept) == len(", ".join(parts)) or not isinstance(reference, Reference)
            ):
                references.setdefault(kept, reference)
    named = set[int]()
    for part in ",".join(references).split(","):
        with suppress(ReferenceSignalError):  # A force, or an output that is not yet chosen.
            named |= {*denoted(part.strip(), outputs, [2] * len(outputs))}
    rest = {name: float(values[i]) for i, name in enumerate(outputs) if i not in named}
    return replace(scenario, task=None, references={**references, **rest})


def _off_surface(
    scenario: Scenario, task: ScenarioTask, links: Links, setting: Setting, q: FloatArray
) -> FloatArray:
    """The configuration with the same outputs, `BEFORE` the surface of a task.

    Raises:
        ScenarioError: There is none.
    """
    bound, candidates = setting.bound, setting.candidates(scenario, links)
    touching = setting.postures(scenario, links, candidates).at(q)
    names = [task.contact] if isinstance(task.contact, str) else [*task.contact]
    values = {parameter.name: parameter.value for parameter in bound.parameters}
    values |= {name: np.atleast_1d(value) for name, value in scenario.plant.parameters.items()}
    contacts = [c.name for c in bound.constraints if c.touch(links) is not None]
    moved = {
        f"{name}.position": values[f"{name}.position"] + BEFORE * normal
        for name, normal in zip(contacts, touching.normals.reshape(-1, 3), strict=True)
        if f"{name}.position" in values and (name in names or names == [""])
    }
    postures = setting.postures(scenario, links, candidates, moved)
    rows = range(len(setting.names))
    off = near_posture(postures, rows, touching.rows[: len(rows)], q) if moved else None
    if off is None:
        text = f"needed: no start was found {BEFORE:g} m before the surface of the task"
        raise ScenarioError(("start.positions", text))
    return off.q
