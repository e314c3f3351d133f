"""A run of a robot, replayed in Meshcat as one HTML page."""

from typing import Protocol

import numpy as np
from pydrake.geometry import Meshcat, Rgba, SceneGraph
from pydrake.systems.framework import Context, System

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.errors import InconsistentStateError, ModelError
from drake_dae.robots.model import RobotModel
from drake_dae.simulation.constraint_forces import ConstraintLoads
from drake_dae.simulation.record import Record
from drake_dae.simulation.view import (
    FRAME_RATE,
    RobotBlock,
    draw_scene,
    draw_surroundings,
    start_meshcat,
    view_of_links,
)

_DESIRED, _ACTUAL = Rgba(0.1, 0.6, 0.2, 1.0), Rgba(0.1, 0.2, 0.8, 1.0)


class Loop(Protocol):
    """A diagram with a plant and its geometry, as a `ClosedLoop`."""

    @property
    def plant(self) -> System:
        """What was simulated."""

    @property
    def scene_graph(self) -> SceneGraph | None:
        """The geometry of a robot, or None."""


@checked(ModelError)
def make_animation(loop: Loop, record: Record, context: Context) -> str:
    """Replays a record of a robot in Meshcat, with the paths of the points where it is held.

    Args:
        loop: A loop of a `RobotPlant`.
        record: The record of a run of this loop.
        context: The context of its diagram, for the parameters; not changed.

    Returns:
        One HTML page that holds the scene and the animation.

    Raises:
        ModelError: There is no robot.
    """
    plant = loop.plant
    if not isinstance(plant, RobotBlock):
        raise ModelError("an animation needs a closed loop of a RobotPlant")
    # A server of its own, made only now: a run that nobody watches opens no port.
    meshcat, model = start_meshcat(), plant.model
    arrows = draw_scene(plant, meshcat)
    links = view_of_links(plant, loop.scene_graph, meshcat)
    parameters = plant.parameters(plant.GetMyContextFromRoot(context))
    loads = ConstraintLoads(model, parameters)

    times = frame_times(record.time[-1] - record.time[0])
    states = _interpolated(record, "state", times)
    forces = _interpolated(record, "constraint_force", times)
    desired = _interpolated(record, "desired_output", times)
    values = np.tile(parameters, (len(times), 1))
    if "exogenous" in record.signals:
        values[:, plant.exogenous_places] = _interpolated(record, "exogenous", times)
    course = [
        loads(state, force, own) for state, force, own in zip(states, forces, values, strict=True)
    ]
    arrows.measure(course)

    # What stands still: what it touches, where it went, and where the reference wanted it.
    draw_surroundings(meshcat, model, loads, states[0], parameters)
    _draw_paths(meshcat, loads, np.array([load.points for load in course]), "actual")
    wanted = _desired_states(model, states, desired, values)
    if wanted:
        none = np.zeros(len(model.dae.force_signals))
        points = np.array(
            [loads(x, none, own).points for x, own in zip(wanted, values, strict=False)]
        )
        _draw_paths(meshcat, loads, points, "desired")

    # What moves: the links and the arrows, frame by frame.
    replay = links.CreateDefaultContext() if links is not None else None
    meshcat.StartRecording(frames_per_second=FRAME_RATE)
    for time, state, load, own in zip(times, states, course, values, strict=True):
        if links is not None and replay is not None:
            replay.SetTime(time)
            link_state = links.get_input_port()
            link_state.FixValue(replay, state[: link_state.size()])
            links.ForcedPublish(replay)
        arrows.draw(load, time)
        arrows.place(own, time)
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
    model: RobotModel, states: FloatArray, desired: FloatArray, values: FloatArray
) -> list[FloatArray]:
    """Link states at rest with the desired outputs, as long as they are within reach.

    Args:
        model: The robot.
        states, desired, values: x, z and the parameters at each moment, one row each.
    """
    nq, nv = model.links.q.numel(), model.links.v.numel()
    guess, found = states[0, :nq], []
    try:
        wanted = desired[:, : len(model.position_signals)]
        for row, own in zip(wanted, values, strict=True):
            guess = model.configuration(row, guess, own)
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
