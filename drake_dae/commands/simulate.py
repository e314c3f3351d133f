"""`drake-dae simulate`: runs a scenario and writes its files into a folder."""

import argparse
import os
import shlex
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from itertools import count
from pathlib import Path
from typing import Any

from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context

import drake_dae
from drake_dae.commands.folder import FILES, PART, RECORD, SCENARIO, SUMMARY, show
from drake_dae.commands.parser import Parser, program, waiting
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.record import Record, RecordAfter, Recorded
from drake_dae.errors import DrakeDaeError, ScenarioError, describe_os_error
from drake_dae.files import check_folder, check_unwritten, complete
from drake_dae.pictures import ANIMATION
from drake_dae.pictures.animation import make_animation
from drake_dae.running.interruption import Interruption, end_at_once, ending_signals
from drake_dae.running.record_writer import RecordWriter
from drake_dae.running.simulate import RunStatistics, simulate
from drake_dae.running.summary import RunSummary
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.judging import judge_run
from drake_dae.scenario.scenario import Scenario, load_scenario, save_scenario, scenario_data
from drake_dae.scenario.shipped import DEFAULT_SCENARIO, find_scenario
from drake_dae.scenario.start import start_scenario
from drake_dae.scene.view import start_meshcat


def _options(parser: Parser) -> None:
    parser.scenario(DEFAULT_SCENARIO)
    parser.out("FOLDER", "folder for the results (default: runs/<scenario>-<time>)")
    parser.flag("--meshcat", "show the robot while it runs, in a browser")
    parser.flag("--open", "open the animation in a browser at the end")
    parser.flag("--rollout", "run the whole loop as one function, without Drake's Simulator")
    parser.flag("--check", "exit code 2 for a run that missed its task")
    parser.json("print the verdict and the files")


def _simulate(options: argparse.Namespace) -> tuple[int, dict[str, Any]]:
    """Runs a scenario and writes its record, a summary and an animation into a folder.

    The first line of the summary says whether the run is GOOD, BAD or UNDECIDED, and why. A rollout
    is faster for many runs (see sweep), not for one; its record has every fixed step, or 1000 rows
    under error control.
    """
    # The scenario, and whether its files may be written.
    path = find_scenario(options.scenario)
    scenario, remarks = load_scenario(path, options.settings), list[str]()
    if options.open and not scenario.write.animation:
        text = "--open shows the animation, so write.animation must be true"
        raise ScenarioError(("write.animation", text))
    if options.rollout and options.meshcat:
        raise ScenarioError(("--meshcat", "leave it out: --rollout shows nothing while it runs"))
    if options.out is not None:
        check_folder(options.out)
        check_unwritten((options.out / name for name in (*FILES, PART)), options.force)

    # The loop at its start.
    began = time.perf_counter()
    if options.rollout:
        from drake_dae.scenario.rolled import for_rollout

        scenario, *remarks = for_rollout(scenario)
    if options.meshcat:
        rate = scenario.integrator.target_realtime_rate
        scenario.integrator.target_realtime_rate = rate or 1.0
    meshcat = start_meshcat() if options.meshcat else None
    with waiting(f"building {path.stem}"):
        completed, loop = build_completed(scenario, meshcat)
        scenario, context = completed.scenario, start_scenario(completed.scenario, loop)
    notes = [*completed.notes, *filter(None, remarks)]
    took = f"{path.stem}: built in {time.perf_counter() - began:.2f} s"
    print(took, *notes, sep="\n", flush=True)

    # The run, in a folder of its own.
    folder = options.out or _new_folder(f"{path.stem}-{datetime.now():%Y%m%d-%H%M%S}")
    folder.mkdir(parents=True, exist_ok=True)
    for file in (*FILES, PART):
        (folder / file).unlink(missing_ok=True)
    first_line = f"# Scenario as run by drake-dae {drake_dae.__version__}"
    save_scenario(scenario, folder / SCENARIO, first_line)
    title = f"{path.stem}: {scenario.description}".removesuffix(": ")
    run = _Run(scenario, loop, context, folder, title, notes)
    with _watched(meshcat):
        code, results = run.made(options.rollout)
    if options.open:
        show(folder)
    if code == 0 and options.check and results.get("missed"):
        code = 2
    return code, {"scenario": path.stem, "folder": str(folder), **results}


def _new_folder(name: str) -> Path:
    """Makes a folder below runs/ that no other run has."""
    for i in count(1):
        folder = Path("runs", name if i == 1 else f"{name}-{i}")
        with suppress(FileExistsError):
            folder.mkdir(parents=True)
            break
    return folder


@contextmanager
def _watched(meshcat: Meshcat | None) -> Iterator[None]:
    """Waits on a terminal for somebody who looks, and at the end for Enter: then the view ends."""
    if meshcat is not None:
        print(f"watch at {meshcat.web_url()}", flush=True)
    is_asked = meshcat is not None and sys.stdin is not None and sys.stdin.isatty()
    while is_asked and meshcat is not None and not meshcat.GetNumActiveConnections():
        time.sleep(0.1)
    yield
    if is_asked:
        input("the view stays until you press Enter")


@dataclass
class _Run:
    """A run of the command, what it has recorded, and which files it could not write."""

    scenario: Scenario
    loop: ClosedLoop
    context: Context
    folder: Path
    title: str
    notes: list[str]
    statistics: RunStatistics | None = None
    recorded: RecordAfter | None = None
    problems: list[str] = field(default_factory=list)

    def made(self, by_rollout: bool) -> tuple[int, dict[str, Any]]:
        """Runs and writes the files, also if the run fails or is interrupted.

        Returns:
            The exit code, and the results.
        """
        failure, about = "", {"scenario": scenario_data(self.scenario)}
        with RecordWriter(self.folder / PART, self._record, about) as writer:
            try:
                (self._roll if by_rollout else self._step)(writer)
            except DrakeDaeError as error:
                failure = str(error)
                raise
            except KeyboardInterrupt:
                failure = "interrupted in the middle of a step"
                raise
            finally:
                results = self._write(writer, failure)
        if self.statistics is not None and self.statistics.interrupted:
            return 128 + self.statistics.interrupted, results
        return 1 if self.problems else 0, results

    def _record(self, context: Context, after: float | None = None) -> Record:
        found = self.recorded
        return self.loop.record(context, after) if found is None else found(after)

    def _step(self, writer: RecordWriter) -> None:
        """Runs by Drake's Simulator."""
        self.statistics = simulate(
            self.loop.diagram,
            self.context,
            self.scenario.duration,
            self.scenario.integrator,
            progress=True,
            look=writer.update if self.scenario.write.record else None,
            may_diverge=self.scenario.judgement.may_diverge,
        )

    def _roll(self, writer: RecordWriter) -> None:
        """Runs by `rollout`."""
        from drake_dae.scenario.rolled import roll_scenario

        began = time.perf_counter()

        def look(record: RecordAfter) -> bool:
            self.recorded = record
            if self.scenario.write.record:
                writer.update(self.context)
            return ending.signal is not None

        with ending_signals(ending := Interruption()), waiting("rolling out"):
            rollout = roll_scenario(self.scenario, self.loop, self.context, look=look)
        self.recorded = rollout.record.after
        if rollout.failure is not None:
            raise rollout.failure
        times, wall = rollout.record.time, time.perf_counter() - began
        simulated = float(times[-1] - times[0]) if times.size else 0.0
        self.statistics = RunStatistics(simulated, wall, rollout.steps, ending.signal)

    def _write(self, writer: RecordWriter, failure: str) -> dict[str, Any]:
        """Writes the files and prints the summary; returns the results."""
        # A signal from here on takes effect after the record is written and before the pictures.
        with ending_signals(ending := Interruption()):
            record, wanted = self._record(self.context), self.scenario.write
            if record.time.size == 0:
                return {}
            judged = self.scenario, self.loop, self.context, record, self.statistics, failure
            summary = judge_run(*judged)
            if wanted.record:
                self._attempt(self._write_record, record, writer)
            self._attempt(self._write_summary, "\n".join([summary.text, *self.notes, ""]))
        try:
            if ending.signal is not None:
                end_at_once(ending.signal)
            drawn = self.loop, record, self.context
            is_drawn = not failure.startswith("interrupted")
            with waiting("drawing"):
                if wanted.plots and is_drawn:
                    from drake_dae.pictures.plots import save_plots  # Matplotlib takes a second.

                    self._attempt(save_plots, *drawn, self.folder, summary.accuracy)
                if wanted.animation and is_drawn:
                    self._attempt(self._write_animation, *drawn)
        finally:
            written = [name for name in (*FILES, PART) if (self.folder / name).exists()]
            self._attempt(self._tell, summary, written)
            print("".join(f"error: {line}\n" for line in self.problems), end="", file=sys.stderr)
        return {**summary.data, "files": written}

    def _attempt(self, write: Callable[..., None], *arguments: Any) -> None:
        """Writes something; other files are written also if this one cannot be."""
        try:
            write(*arguments)
        except OSError as error:
            self.problems.append(describe_os_error(error))

    def _write_record(self, record: Record, writer: RecordWriter) -> None:
        """Writes the record with the predicted error, in place of the one written in the run."""
        predicted = self.loop.predicted_error(record), record.signals["tracking_error"].signals
        signals = {**record.signals, "predicted_error": Recorded(*predicted)}
        try:
            with complete(self.folder, RECORD) as place:
                replace(record, signals=signals, about=writer.about).save(place / RECORD)
        except OSError:
            with suppress(OSError):
                writer.finish(self.context)  # The rows that still fit.
            raise
        writer.path.unlink(missing_ok=True)

    def _write_animation(self, loop: ClosedLoop, record: Record, context: Context) -> None:
        with complete(self.folder, ANIMATION) as place:
            page = make_animation(loop, record, context, self.title)
            (place / ANIMATION).write_text(page, encoding="utf-8")

    def _write_summary(self, text: str) -> None:
        with complete(self.folder, SUMMARY) as place:
            (place / SUMMARY).write_text(text, encoding="utf-8")

    def _tell(self, summary: RunSummary, written: list[str]) -> None:
        """Prints the summary, with its first word green, red or yellow on a terminal."""
        text, word = summary.text, summary.judgement.outcome.name
        if sys.stdout.isatty() and not os.environ.get("NO_COLOR"):
            color = {"GOOD": 32, "BAD": 31, "UNDECIDED": 33}[word]
            text = f"\x1b[1;{color}m{word}\x1b[0m{text.removeprefix(word)}"
        print(f"{text}\nwritten to {self.folder}/: {', '.join(written)}", flush=True)
        if ANIMATION in written:
            named = shlex.quote(str(self.folder))
            plots = "" if self.scenario.write.plots else f"; plots: {program()} plot {named} --all"
            print(f"watch it: {program()} play {named}{plots}", flush=True)


COMMANDS = {"simulate": (_options, _simulate)}
