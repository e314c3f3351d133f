"""The files of a run: record, summary, plots and animation."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from pydrake.systems.framework import Context

from drake_dae.commands.run.folder import ANIMATION, PART, RECORD, stage
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError, describe_os_error
from drake_dae.pictures.animation import animate
from drake_dae.pictures.moments import events_of, sorted_events
from drake_dae.pictures.plots import PATHS, PLOTS, save_plots
from drake_dae.pictures.scene.friction import slips
from drake_dae.pictures.scene.run_motion import contact_paths, follow
from drake_dae.scenario.parts.parts import Write
from drake_dae.simulation.limits import robot_limits
from drake_dae.simulation.records.phases import phase_spans
from drake_dae.simulation.records.record import Record, Recorded
from drake_dae.simulation.records.record_writer import RecordWriter
from drake_dae.simulation.summary import RunSummary


class RunFiles:
    """Writes the files of a run into its folder.

    An error of one file is kept in `problems`, and the other files are written nevertheless.

    Attributes:
        folder: The folder of the run.
        problems: The errors of files that could not be written, a sentence each.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self.problems: list[str] = []

    def write_record(
        self, record: Record, loop: ClosedLoop, writer: RecordWriter, context: Context
    ) -> None:
        """Writes the record with the predicted error, in place of the one written in the run."""
        predicted = loop.predicted_error(record), record.signals["tracking_error"].signals
        more = {**record.signals, "predicted_error": Recorded(*predicted)}
        with self.collected():
            try:
                with stage(self.folder, RECORD) as temporary:
                    whole = replace(record, signals=more, about=writer.about)
                    whole.save(temporary / RECORD)
            except OSError as error:
                with suppress(OSError):
                    writer.finish(context)  # If it fails, rows that were written before remain.
                with suppress(OSError, ModelError, IndexError):
                    end = Record.load(writer.path).time[-1]
                    reason = error.strerror or error
                    error.strerror = f"{reason}; {PART} has the record up to {end:.6g} s"
                raise
            writer.path.unlink(missing_ok=True)

    def write_summary(self, summary: RunSummary, *notes: str) -> None:
        """Writes the summary and some notes into summary.txt."""
        name = "summary.txt"
        with self.collected(), stage(self.folder, name) as temporary:
            text = "\n".join([summary.text, *notes, ""])
            (temporary / name).write_text(text, encoding="utf-8")

    def write_pictures(
        self, run: RunSummary, loop: ClosedLoop, context: Context, wanted: Write, title: str = ""
    ) -> None:
        """Writes the plots and the animation."""
        record = run.record
        if not (wanted.plots or wanted.animation):
            return
        model, motion = loop.plant.robot("pictures"), follow(loop, record, context)
        events = [*events_of(record, robot_limits(model)), *slips(motion)]
        events = sorted_events(record, events)
        if wanted.plots:
            paths = contact_paths(motion)
            plots = [name for name in PLOTS if paths or name != PATHS]
            with self.collected(), stage(self.folder, *plots) as temporary, _frozen():
                plotted = record, loop.predicted_error(record), model.control_limits
                save_plots(*plotted, temporary, paths, run.accuracy, events)
        if wanted.animation:
            with self.collected(), stage(self.folder, ANIMATION) as temporary:
                page = animate(motion, loop.scene_graph, title, phase_spans(record), events)
                (temporary / ANIMATION).write_text(page, encoding="utf-8")

    @contextmanager
    def collected(self) -> Iterator[None]:
        """Keeps an OSError of the block in `problems`."""
        try:
            yield
        except OSError as error:
            self.problems.append(describe_os_error(error))


@contextmanager
def _frozen() -> Iterator[None]:
    """Excludes the present objects from garbage collection in the block.

    A figure creates so many objects that their collection would take as long as drawing.
    """
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
