"""The file of a sweep: an SQLite database with what the sweep is, and a row for each run."""

import json
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path

from drake_dae.arrays import brief
from drake_dae.errors import ModelError
from drake_dae.studies.runs import Outcome, RunResult

_TABLES = """
CREATE TABLE IF NOT EXISTS sweep (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS runs (
    run INTEGER PRIMARY KEY, outcome TEXT NOT NULL, reason TEXT NOT NULL,
    figures TEXT NOT NULL, exceeded TEXT NOT NULL
);
"""

# The outcomes of runs that are tried again, in SQL.
_AGAIN = f"({', '.join(repr(str(each)) for each in Outcome if not each.is_final)})"


class Journal:
    """An open file of a sweep. Several processes may have it open; none loses a row of another."""

    def __init__(self, database: sqlite3.Connection) -> None:
        self._database = database

    def add(self, results: Mapping[int, RunResult]) -> None:
        """Writes results; a result that is already there stays, unless it is not final."""
        rows = [
            (run, r.outcome, r.reason, json.dumps(dict(r.figures)), json.dumps(r.exceeded))
            for run, r in results.items()
        ]
        self._database.executemany(
            "INSERT INTO runs VALUES (?, ?, ?, ?, ?) ON CONFLICT (run) DO UPDATE SET "
            "outcome = excluded.outcome, reason = excluded.reason, figures = excluded.figures, "
            f"exceeded = excluded.exceeded WHERE outcome IN {_AGAIN}",
            rows,
        )
        self._database.commit()

    def is_done(self, run: int) -> bool:
        """Whether the run has a final result."""
        query = f"SELECT 1 FROM runs WHERE run = ? AND outcome NOT IN {_AGAIN}"
        return self._database.execute(query, [run]).fetchone() is not None

    def results(self) -> dict[int, RunResult]:
        """Number of a run -> its result."""
        return {
            run: RunResult(Outcome(outcome), reason, json.loads(figures), tuple(json.loads(left)))
            for run, outcome, reason, figures, left in self._database.execute("SELECT * FROM runs")
        }


@contextmanager
def open_journal(path: Path, head: Mapping[str, str]) -> Iterator[Journal]:
    """Creates the file of a sweep with missing folders, or opens it to continue.

    `head` says what the sweep is, name -> text; equal sweeps have equal ones.
    """
    unusable = f"cannot use {brief(str(path))} as the file of a sweep: "
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        database = sqlite3.connect(path, timeout=60.0)
    except (sqlite3.Error, OSError, ValueError) as error:  # ValueError: a null byte in the path.
        raise ModelError(f"{unusable}{error}") from None
    with closing(database):
        try:
            database.executescript(f"BEGIN IMMEDIATE; {_TABLES}")
            there = dict(database.execute("SELECT key, value FROM sweep"))
            if not there:
                database.executemany("INSERT INTO sweep VALUES (?, ?)", list(head.items()))
            database.commit()
            differing = [
                f"{key} = {brief(there.get(key))} there, {brief(head.get(key))} here"
                for key in {**there, **head}
                if there and there.get(key) != head.get(key)
            ]
            if differing:
                raise ModelError(
                    f"'{path}' belongs to another sweep: {'; '.join(differing[:6])}. Choose "
                    "another folder, or remove it"
                )
            yield Journal(database)
        except sqlite3.Error as error:
            raise ModelError(f"{unusable}{error}") from None
