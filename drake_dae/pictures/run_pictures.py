"""The pictures of a recorded run of a robot: its plots, and its animation."""

from pathlib import Path

from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.diagrams.record import Record
from drake_dae.files import complete
from drake_dae.pictures.animation import animate
from drake_dae.pictures.friction import slips
from drake_dae.pictures.moments import RunEvent, events_of, sorted_events
from drake_dae.pictures.plots import PATHS, PLOTS, save_plots
from drake_dae.pictures.run_motion import RunMotion, ShownLoop, contact_paths, follow
from drake_dae.running.limits import robot_limits
from drake_dae.running.phases import phase_spans

ANIMATION = "animation.html"


def save_run_plots(
    record: Record,
    loop: ShownLoop,
    context: Context,
    folder: Path,
    predicted: FloatArray,
    accuracy: float | None = None,
) -> None:
    """Writes the plots of a run with its predicted error into a folder.

    Raises:
        OSError: They cannot be written.
    """
    motion, events = _motion(record, loop, context)
    paths = contact_paths(motion)
    limits = loop.plant.robot("pictures").control_limits
    with complete(folder, *(name for name in PLOTS if paths or name != PATHS)) as place:
        save_plots(record, predicted, limits, place, paths, accuracy, events)


def save_animation(
    record: Record, loop: ShownLoop, context: Context, folder: Path, title: str
) -> None:
    """Writes the animation of a run into a folder.

    Raises:
        OSError: It cannot be written.
    """
    motion, events = _motion(record, loop, context)
    with complete(folder, ANIMATION) as place:
        page = animate(motion, loop.scene_graph, title, phase_spans(record), events)
        (place / ANIMATION).write_text(page, encoding="utf-8")


def _motion(record: Record, loop: ShownLoop, context: Context) -> tuple[RunMotion, list[RunEvent]]:
    motion = follow(loop, record, context)
    limits = robot_limits(loop.plant.robot("pictures"))
    return motion, sorted_events(record, [*events_of(record, limits), *slips(motion)])
