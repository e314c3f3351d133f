"""`drake-dae simulate`: runs a scenario and writes its files into a folder."""

import argparse
import gc
import json
import os
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from itertools import count
from pathlib import Path
from textwrap import fill
from typing import Any, TextIO

from pydrake.systems.framework import Context

import drake_dae
from drake_dae.commands.play import show
from drake_dae.commands.run_folder import (
    ANIMATION,
    FILES,
    MARK,
    PART,
    RECORD,
    SCENARIO,
    new_folder,
    run_folder,
    stage,
)
from drake_dae.dae.timing.profile import TimeOptimalReference
from drake_dae.diagrams.clearances import links_in_the_way, nearness
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import DrakeDaeError, ModelError, ScenarioError, describe_os_error
from drake_dae.pictures.animation import animate
from drake_dae.pictures.moments import events_of, sorted_events
from drake_dae.pictures.plots import PATHS, PLOTS, save_plots
from drake_dae.pictures.profile import PROFILE, save_profile
from drake_dae.pictures.scene.friction import slips
from drake_dae.pictures.scene.run_motion import RunMotion, contact_paths, follow
from drake_dae.pictures.scene.view import start_meshcat
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.completion.completion import Completed
from drake_dae.scenario.files import load_scenario, save_scenario
from drake_dae.scenario.parts.time_optimal import TimeOptimal
from drake_dae.scenario.scenario import Scenario, scenario_data
from drake_dae.scenario.shipped import find_scenario
from drake_dae.scenario.start import start_scenario
from drake_dae.simulation.error_bound import bound_words, exceeds
from drake_dae.simulation.job import JobOutcome, JobVerdict, judge_job
from drake_dae.simulation.real_time import attainable_rate
from drake_dae.simulation.records.interruption import Interruption, end_at_once, ending_signals
from drake_dae.simulation.records.phases import phase_spans
from drake_dae.simulation.records.record import Record, RecordAfter, Recorded
from drake_dae.simulation.records.record_writer import RecordWriter
from drake_dae.simulation.remarks import (
    ball_remarks,
    departure_remarks,
    limit_remarks,
    reference_remarks,
    stop_remarks,
    surface_remarks,
    touch_remarks,
)
from drake_dae.simulation.simulate import RunStatistics, simulate
from drake_dae.simulation.summary import WIDTH, Limits, shortfalls, summary
from drake_dae.simulation.verdict import RunVerdict, TrackingResult, as_data, judge


def run_command(options: argparse.Namespace) -> int:
    """Runs the scenario that the options name; returns the exit code."""
    path = find_scenario(options.scenario)
    scenario = load_scenario(path, options.settings)
    if options.time_optimal and scenario.time_optimal is None:
        scenario = replace(scenario, time_optimal=TimeOptimal())
    if options.open and not scenario.write.animation:
        raise ScenarioError(
            ("write.animation", ("--open shows the animation, so write.animation must be true"))
        )
    if not options.json:
        return _simulate(options, path.stem, scenario)[0]
    with redirect_stdout(sys.stderr):
        code, results = _simulate(options, path.stem, scenario)
    print(json.dumps(results, indent=2))
    return code


def _simulate(
    options: argparse.Namespace, name: str, scenario: Scenario
) -> tuple[int, dict[str, Any]]:
    """Runs a scenario; returns the exit code, and the results for JSON."""
    if options.meshcat:
        scenario.integrator.target_realtime_rate = scenario.integrator.target_realtime_rate or 1.0
    meshcat = start_meshcat() if options.meshcat else None
    began, remark = time.perf_counter(), ""
    if options.rollout:
        from drake_dae.scenario.rolled import for_rollout

        scenario, remark = for_rollout(scenario)
    completed, loop = build_completed(scenario, meshcat)
    scenario, context = completed.scenario, start_scenario(completed.scenario, loop)
    simulate_by = _roll if options.rollout else _step
    print(f"{name}: built in {time.perf_counter() - began:.2f} s", flush=True)
    for note in (*completed.notes, *filter(None, [remark])):
        print(note, flush=True)
    folder = options.out or _unused(f"{name}-{datetime.now():%Y%m%d-%H%M%S}")
    with ending_signals(end_at_once), run_folder(folder) as moved_to:
        if moved_to is not None:
            print(f"the earlier run in {folder}/ is kept in {moved_to}/", flush=True)
        save_scenario(scenario, folder / SCENARIO, f"{MARK} {drake_dae.__version__}")
        if meshcat is not None:
            print(f"watch at {meshcat.web_url()}", flush=True)
        title = f"{name}: {scenario.description}" if scenario.description else name
        code, results = _run(loop, context, completed, folder, simulate_by, title)
    if options.open:
        show(folder)
    if code == 0 and options.check and results.get("missed"):
        code = 2
    return code, {"scenario": name, "folder": str(folder), **results}


def _unused(name: str) -> Path:
    """A new folder below runs/."""
    runs = Path("runs")
    runs.mkdir(exist_ok=True)
    return new_folder(runs / (name if i == 1 else f"{name}-{i}") for i in count(1))


@dataclass
class _CommandRun:
    """A run of the command: its loop and scenario, its folder, and its results."""

    loop: ClosedLoop
    context: Context
    scenario: Scenario
    folder: Path
    writer: RecordWriter
    title: str
    notes: tuple[str, ...] = ()
    statistics: RunStatistics | None = None
    failure: str = ""
    pictures: bool = True
    record: Record | None = None
    recorded: RecordAfter | None = None
    results: dict[str, Any] = field(default_factory=dict)

    @property
    def is_interrupted(self) -> bool:
        """Whether a signal ended the run early."""
        return self.statistics is not None and self.statistics.interrupted is not None


def _step(run: _CommandRun) -> RunStatistics:
    """Runs by Drake's Simulator."""
    _warn_of_rate(run)
    return simulate(
        run.loop.diagram,
        run.context,
        run.scenario.duration,
        run.scenario.integrator,
        progress=True,
        look=run.writer.update if run.scenario.write.record else None,
        may_diverge=run.scenario.may_diverge,
    )


def _warn_of_rate(run: _CommandRun) -> None:
    """Warns if this machine is too slow for a run in real time."""
    scenario, config = run.scenario, run.scenario.integrator
    target = config.target_realtime_rate
    if not target:
        return
    rate = attainable_rate(run.loop.diagram, run.context, scenario.duration, config)
    if rate is not None and rate < target:
        print(
            f"runs at about {rate:.2g} times real time here, not at {target:g}: the view is slow "
            "motion. Machine code (--compiled true, with a C compiler) and larger steps are faster",
            flush=True,
        )


def _roll(run: _CommandRun) -> RunStatistics:
    """Runs by `rollout`.

    Raises:
        SimulationError: The run cannot continue.
    """
    from drake_dae.scenario.rolled import roll_scenario

    began = time.perf_counter()

    def look(record: RecordAfter) -> bool:
        run.recorded = record
        if run.scenario.write.record:
            run.writer.update(run.context)
        return ending.signal is not None

    with ending_signals(ending := Interruption()):
        rollout = roll_scenario(run.scenario, run.loop, run.context, look=look)
    run.record, run.recorded = rollout.record, rollout.record.after
    run.context = rollout.context or run.context
    if rollout.failure is not None:
        raise rollout.failure
    times, wall = run.record.time, time.perf_counter() - began
    simulated = float(times[-1] - times[0]) if times.size else 0.0
    return RunStatistics(simulated, wall, rollout.steps, ending.signal)


def _run(
    loop: ClosedLoop,
    context: Context,
    completed: Completed,
    folder: Path,
    simulate_by: Callable[[_CommandRun], RunStatistics],
    title: str,
) -> tuple[int, dict[str, Any]]:
    """Runs, and writes the files, also if the run fails or is interrupted."""
    about = {"scenario": scenario_data(completed.scenario)}

    def recorded(context: Context, after: float | None) -> Record:
        return loop.record(context, after) if run.recorded is None else run.recorded(after)

    with RecordWriter(folder / PART, recorded, about) as writer:
        run = _CommandRun(loop, context, completed.scenario, folder, writer, title, completed.notes)
        try:
            run.statistics = simulate_by(run)
        except DrakeDaeError as error:
            run.failure = str(error)
            raise
        except KeyboardInterrupt:
            run.failure, run.pictures = "interrupted in the middle of a step", False
            raise
        finally:
            complete = _write(run)
    if run.statistics.interrupted:
        return 128 + run.statistics.interrupted, run.results
    return 0 if complete else 1, run.results


def _write(run: _CommandRun) -> bool:
    """Writes the files, prints the summary, and returns whether all files are complete."""
    loop, folder, write = run.loop, run.folder, run.scenario.write
    problems: list[str] = []
    # A signal from here on takes effect after the record is written and before the pictures.
    with ending_signals(ending := Interruption()):
        record = run.record or loop.record(run.context)
        if record.time.size == 0:
            return True
        predicted = loop.predicted_error(record)
        model = loop.plant.model
        limits = Limits() if model is None else Limits.of(model)
        config = run.scenario.integrator
        fixed = loop.plant.time_step or not config.use_error_control
        accuracy = None if fixed else config.accuracy
        reasons = _reasons(run.scenario, loop, record)
        behind = links_in_the_way(loop, record, run.context)
        near = nearness(loop, record, run.context)
        bound = None
        if loop.generator is not None:
            goal, state = loop.generator.reference, record["state"][0]
            bound = loop.controller.error_bound(goal, record.time, state)
        outcome = run.statistics, run.failure
        lines = [summary(record, predicted, limits, *outcome, accuracy, reasons, bound)]
        changes = loop.changes(run.context)
        stopped = stop_remarks(run.statistics, run.scenario.duration) if changes else []
        job = judge_job(
            record,
            predicted,
            {} if run.scenario.tolerances is None else run.scenario.tolerances.outputs,
            [*shortfalls(record, limits), *map(str, behind)],
            limits.pushing,
            changes,
            is_cut_short=bool(run.failure) or run.is_interrupted,
            notes=limit_remarks(record, limits),
        )
        verdict = judge(record, predicted, accuracy)
        bounded = None
        if (error_bound := run.scenario.error_bound) is not None:
            bounded = error_bound.check(record)
            lines += ["", *bound_words(bounded), ""]
        is_unexplained = verdict.tracking is TrackingResult.OFF and not reasons
        run.results = {
            "missed": job.outcome is JobOutcome.BAD or is_unexplained or exceeds(bounded),
            "error_bound": None if bounded is None else list(map(asdict, bounded)),
            "job": job.to_dict(),
            "phases": [asdict(change) for change in changes],
            **asdict(near),
            **_as_data(run, verdict, reasons),
        }
        scenario = run.scenario
        if model is not None:
            material = None if loop.plant.latches else scenario.plant.material
            lines += surface_remarks(model, record)
            lines += loop.plant.remarks
            lines += ball_remarks(None if material is None else material.radius)
        lines += map(str, (*near.distances, *near.speeds))
        lines += departure_remarks(record, limits.control)
        followed = {**scenario.references, **scenario.exogenous, "task": scenario.task}
        lines += reference_remarks(followed)
        if changes:
            lines += ["", *map(str, changes), *stopped, *touch_remarks(changes)]
        text = "\n".join(lines)
        if write.record:
            signals = record.signals["tracking_error"].signals
            more = {**record.signals, "predicted_error": Recorded(predicted, signals)}
            with _collected(problems):
                _write_record(replace(record, signals=more, about=run.writer.about), run)
        with _collected(problems), stage(folder, "summary.txt") as temporary:
            results = "\n".join([_filled(job), "", text, *run.notes, ""])
            (temporary / "summary.txt").write_text(results, encoding="utf-8")
    try:
        if ending.signal is not None:
            end_at_once(ending.signal)
        course: RunMotion | None = None
        if run.pictures and (write.plots or write.animation) and model is not None:
            course = follow(loop, record, run.context)
        events = events_of(record, limits)
        if course is not None:
            events = sorted_events(record, [*events, *slips(course)])
        if write.plots and run.pictures:
            paths = contact_paths(course) if course is not None else []
            plots = [name for name in PLOTS if paths or name != PATHS]
            with _collected(problems), stage(folder, *plots) as temporary, _frozen():
                save_plots(record, predicted, limits.control, temporary, paths, accuracy, events)
            for reference in loop.generator.references if loop.generator is not None else ():
                if isinstance(reference, TimeOptimalReference):
                    with _collected(problems), stage(folder, PROFILE) as temporary:
                        save_profile(reference.profile, temporary)
        if write.animation and course is not None:
            with _collected(problems), stage(folder, ANIMATION) as temporary:
                spans = phase_spans(record)
                page = animate(course, loop.scene_graph, run.title, spans, events)
                (temporary / ANIMATION).write_text(page, encoding="utf-8")
    finally:
        files = [name for name in (*FILES, PROFILE, PART) if (folder / name).exists()]
        run.results["files"] = files
        with _collected(problems):
            _print(
                f"{_colored(job)}\n\n{text}\nwritten to {folder}/: {', '.join(files)}", sys.stdout
            )
            if ANIMATION in files:
                _print(f"watch it: drake-dae play {shlex.quote(str(folder))}", sys.stdout)
        with suppress(OSError):
            _print("".join(f"error: {line}\n" for line in problems), sys.stderr)
    return not problems


def _filled(job: JobVerdict) -> str:
    return fill(str(job), WIDTH)


def _colored(job: JobVerdict) -> str:
    """A verdict for the screen: its first word green, red or yellow on a terminal."""
    text, word = _filled(job), job.outcome.value
    if not sys.stdout.isatty() or os.environ.get("NO_COLOR"):
        return text
    color = {JobOutcome.GOOD: 32, JobOutcome.BAD: 31, JobOutcome.UNDECIDED: 33}[job.outcome]
    return f"\x1b[1;{color}m{word}\x1b[0m{text.removeprefix(word)}"


def _as_data(run: _CommandRun, verdict: RunVerdict, reasons: Sequence[str]) -> dict[str, Any]:
    """The results of a run for JSON."""
    names = ("simulated_time", "steps", "wall_time")
    return {
        **as_data(verdict, reasons),
        "interrupted": run.is_interrupted,
        **{name: getattr(run.statistics, name, None) for name in names},
    }


def _reasons(scenario: Scenario, loop: ClosedLoop, record: Record) -> list[str]:
    """Reasons for deviations from the prediction for an ideal run."""
    reasons = {
        "the drives were saturated": "excess" in record and bool(record["excess"].any()),
        "parameters of the plant differ from those of the law (plant_parameters)": bool(
            scenario.plant_parameters
        ),
        "the plant carries payloads that the law does not know": bool(scenario.plant_payloads),
        "disturbance forces act on the plant, unknown to the law": bool(
            scenario.plant_disturbances
        ),
        "the contact is compliant": not loop.plant.is_ideal,
        "a contact was open": "mode" in record and not record["mode"].all(),
        "the force is measured by a sensor": scenario.force_feedback.is_measured,
        "the state is measured by encoders": scenario.encoders is not None,
        "the law is sampled": scenario.sampling is not None,
        "controls are late or lost on their way (sampling)": not (
            scenario.sampling is None or scenario.sampling.is_exact
        ),
        "the law is a cascade around springs": scenario.is_cascade,
    }
    return [reason for reason, holds in reasons.items() if holds]


def _write_record(record: Record, run: _CommandRun) -> None:
    writer = run.writer
    try:
        with stage(run.folder, RECORD) as temporary:
            record.save(temporary / RECORD)
    except OSError as error:
        with suppress(OSError):
            writer.finish(run.context)  # If it fails, rows that were written before remain.
        with suppress(OSError, ModelError, IndexError):
            end = Record.load(writer.path).time[-1]
            error.strerror = f"{error.strerror or error}; {PART} has the record up to {end:.6g} s"
        raise
    writer.path.unlink(missing_ok=True)


def _print(text: str, file: TextIO) -> None:
    """Prints and flushes; a closed output, as after SIGHUP, is not tried again on exit."""
    try:
        print(text, end="\n" if text and text[-1] != "\n" else "", file=file, flush=True)
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), file.fileno())
        raise


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


@contextmanager
def _collected(problems: list[str]) -> Iterator[None]:
    """Collects an error of a file, so that the other files and the summary are written."""
    try:
        yield
    except OSError as error:
        problems.append(describe_os_error(error))
