"""The touches of a task, before it runs."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import pi

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.robots.constraints import Constraint
from drake_dae.robots.model import RobotModel
from drake_dae.scenario.advice.touch import reaction_time, touch_peak
from drake_dae.scenario.scenario import Scenario
from drake_dae.simulation.records.record import Record
from drake_dae.systems.control.phase_change import PhaseChange
from drake_dae.systems.task.controller import TaskController


@dataclass(frozen=True)
class TaskTouch:
    """A touch of a task.

    Attributes:
        phase: The phase that touches.
        time: In s.
        speed: The speed towards the surface, in m/s.
        mass: The mass at the tool along the normal, 1 / A, in kg.
        impulse: The impulse that stops it, speed / A, in N s.
        peak: The largest expected force on the scenario's plant, in N; None for ideal contact.
    """

    phase: str
    time: float
    speed: float
    mass: float
    impulse: float
    peak: float | None = None

    def __str__(self) -> str:
        text = (
            f"{self.phase} touches at {self.time:.4g} s with {self.speed:.3g} m/s; the mass at the "
            f"tool is {self.mass:.3g} kg: "
        )
        if self.peak is None:
            return f"{text}an impulse of {self.impulse:.3g} N s"
        return f"{text}at most {self.peak:.3g} N are expected"


def period_of(scenario: Scenario) -> float:
    """The time in s between the samples of a scenario's law; 0 for none."""
    material, sampling = scenario.plant.material, scenario.sampling
    if sampling is not None:
        return sampling.period
    return 0.0 if material is None else material.time_step


def touches_of(
    record: Record,
    changes: Sequence[PhaseChange],
    controller: TaskController,
    scenario: Scenario,
    model: RobotModel,
) -> tuple[list[TaskTouch], list[str]]:
    """The touches, and the guards of the force that they may trip."""
    touches, problems, material = list[TaskTouch](), list[str](), scenario.plant.material
    task, forces = controller.task, list(controller.contact.forces)
    for before, after in () if task.plan.latches else pairwise(changes):  # Latches close at rest.
        if not after.in_contact > before.in_contact or before.place >= task.plan.last:
            continue
        phase = task.plan.phases[before.place]
        met = [event.time for event in record.events if before.time < event.time <= after.time]
        # The last row before the impact, after which the rate is zero.
        last = max(int(np.searchsorted(record.time, [*met, after.time][0])) - 1, 0)
        speed = max(float(np.max(-record["distance"][last, len(forces) :])), 0.0)
        matrix = controller.law.structure.constraint_matrix(record["state"][last])
        mobility = float(np.min(np.diag(matrix)[forces]))
        touch = TaskTouch(
            before.phase, float(record.time[last]), speed, 1.0 / mobility, speed / mobility
        )
        if material is not None:
            felt = phase.felt(task.contact_force)
            stiffness = material.stiffness_on(model, felt)
            late = reaction_time(scenario.sampling, material.time_step)
            peak = touch_peak(felt, speed, stiffness, mobility, late)
            touch = replace(touch, peak=peak)
            lasts = pi / (stiffness * mobility) ** 0.5
            near = [phase, *task.plan.phases[after.place : task.plan.last][:1]]
            problems += [
                f"{before.phase} may touch with {peak:.3g} N, and a guard of {guarded.name} ends "
                f"it at {guard.most:g} N: touch more slowly, or give the guard more samples"
                for guarded in near
                for guard in guarded.guards
                if guard.of == "force" and guard.most < peak
                if (guard.samples - 1) * period_of(scenario) < lasts
            ]
        touches.append(touch)
    return touches, problems


def normals_at(
    scenario: Scenario, model: RobotModel, contact: Constraint, state: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The normal of a contact in a state, and that with the scenario's `plant_parameters`."""
    dae, touch = model.dae, contact.touch(model.links)
    assert touch is not None
    function = dae.trace("normal", {"normal": touch.normal})
    values = dae.parameter_values, plant_values(scenario, model, contact)
    first, second = (function(state, own)[0].ravel() for own in values)
    return first, second


def plant_values(scenario: Scenario, model: RobotModel, contact: Constraint) -> FloatArray:
    """The parameters of the model, with those of a contact from `plant_parameters`."""
    values = model.dae.parameter_values.copy()
    for name in {own.name for own in contact.parameters} & scenario.plant_parameters.keys():
        values[model.dae.parameter_slice(name)] = scenario.plant_parameters[name]
    return values


def angle_between(first: FloatArray, second: FloatArray) -> float:
    """The angle between two unit vectors, in rad."""
    return float(np.arctan2(np.linalg.norm(np.cross(first, second)), first @ second))
