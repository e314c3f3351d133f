"""A run of a robot, replayed in Meshcat as one HTML page."""

from typing import Protocol

import numpy as np
from pydrake.geometry import Meshcat, Rgba
from pydrake.systems.framework import Context

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.errors import InconsistentStateError, ModelError
from drake_dae.robots.model import RobotModel
from drake_dae.simulation.constraint_forces import ConstraintLoads
from drake_dae.simulation.record import Record
from drake_dae.simulation.view import FRAME_RATE, View, draw_surroundings

_DESIRED, _ACTUAL = Rgba(0.1, 0.6, 0.2, 1.0), Rgba(0.1, 0.2, 0.8, 1.0)


class Viewed(Protocol):
    """A diagram that may have a view of a robot, as a `ClosedLoop`."""

    @property
    def view(self) -> View | None:
        """The blocks that draw, or None."""


@checked(ModelError)
def make_animation(loop: Viewed, record: Record, context: Context) -> str:
    """Replays a record of a robot in Meshcat, with the paths of the points where it is held.

    Args:
        loop: A loop of a `RobotPlant`, made with a meshcat.
        record: The record of a run of this loop.
        context: The context of its diagram, for the parameters; not changed.

    Returns:
        One HTML page that holds the scene and the animation.

    Raises:
        ModelError: There is no meshcat or no robot.
    """
    view = loop.view
    if not isinstance(view, View):
        raise ModelError("an animation needs a closed loop of a RobotPlant, made with a meshcat")
    meshcat, plant, model = view.meshcat, view.plant, view.plant.model
    parameters = plant.parameters(plant.GetMyContextFromRoot(context))
    loads = ConstraintLoads(model, parameters)

    times = frame_times(record.time[-1] - record.time[0])
    states = _interpolated(record, "state", times)
    forces = _interpolated(record, "constraint_force", times)
    desired = _interpolated(record, "desired_output", times)
    course = [loads(state, force) for state, force in zip(states, forces, strict=True)]
    view.forces.measure(course)

    # What stands still: what it touches, where it went, and where the reference wanted it.
    draw_surroundings(meshcat, model, loads, states[0], parameters)
    _draw_paths(meshcat, loads, np.array([load.points for load in course]), "actual")
    wanted = _desired_states(model, states, desired, parameters)
    if wanted:
        none = np.zeros(model.dae.num_constraints)
        points = np.array([loads(state, none).points for state in wanted])
        _draw_paths(meshcat, loads, points, "desired")

    # What moves: the links and the arrows, frame by frame.
    replay = context.Clone()
    replayed = plant.GetMyMutableContextFromRoot(replay)
    meshcat.StartRecording(frames_per_second=FRAME_RATE)
    for time, state, load in zip(times, states, course, strict=True):
        replay.SetTime(time)
        plant.set_state(replayed, state)
        if view.links is not None:
            view.links.ForcedPublish(view.links.GetMyContextFromRoot(replay))
        view.forces.draw(load, time)
    meshcat.StopRecording()
    meshcat.PublishRecording()
    return meshcat.StaticHtml()


def frame_times(duration: float, rate: float = FRAME_RATE) -> FloatArray:
    """The moments to show, in s after the start; the last one is the end or the next after it."""
    return np.arange(int(np.ceil(duration * rate - 1e-9)) + 1) / rate


def _interpolated(record: Record, name: str, times: FloatArray) -> FloatArray:
    """A signal at times after the start, shape (k, size): straight lines between the steps."""
    moments = record.time - record.time[0]
    rows = [np.interp(times, moments, column) for column in record[name].T]
    return np.array(rows).reshape(-1, len(times)).T


def _desired_states(
    model: RobotModel, states: FloatArray, desired: FloatArray, parameters: FloatArray
) -> list[FloatArray]:
    """Link states at rest with the desired outputs, as long as they are within reach."""
    nq, nv = model.links.q.numel(), model.links.v.numel()
    guess, found = states[0, :nq], []
    try:
        for row in desired[:, : len(model.position_signals)]:
            guess = model.configuration(row, guess, parameters)
            found.append(np.concatenate([guess, np.zeros(nv)]))
    except InconsistentStateError:
        pass  # The reference leaves what the robot can reach: its path ends there.
    return found


def _draw_paths(meshcat: Meshcat, loads: ConstraintLoads, points: FloatArray, kind: str) -> None:
    """A line through the points of each constraint, m, shape (frames, constraints, 3)."""
    color, width = {"actual": (_ACTUAL, 4.0), "desired": (_DESIRED, 2.0)}[kind]
    for number, constraint in enumerate(loads.constraints):
        line = np.asfortranarray(points[:, number].T)
        meshcat.SetLine(f"/paths/{constraint.name}/{kind}", line, width, color)
