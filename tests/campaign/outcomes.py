"""How an attempt ended."""

import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drake_dae import Record
from drake_dae.errors import DrakeDaeError

CLASSES = ("result", "refused", "wrong number", "raw exception", "hang or crash")
RESULT, REFUSED, WRONG, RAW, HANG = CLASSES
BAD = (WRONG, RAW, HANG)
"""What must not be."""

RESIDUAL = 1e-6
"""The largest constraint residual of a run that is no wrong number, m or rad (per s, ...)."""

OFF = 1e-4
"""How far errors may be off the prediction, beside the largest output."""


@dataclass
class Outcome:
    """How an attempt ended: what it was, one of CLASSES, and the message."""

    what: str
    kind: str = RESULT
    text: str = ""

    def figures(self, record: Record, predicted: np.ndarray | None, is_ideal: bool = True) -> None:
        """Judges the numbers of a run; no prediction is compared with if it is None.

        Contact that gives way, which is not ideal, leaves a residual.
        """
        residual = float(np.max(np.abs(record["constraint_residual"]), initial=0.0))
        finite = all(np.all(np.isfinite(signal.values)) for signal in record.signals.values())
        off = 0.0
        if predicted is not None:
            # Outputs of one kind share a scale: the largest of any, as springs mix them.
            size = max(1.0, float(np.max(np.abs(record["controlled_output"]), initial=0.0)))
            off = float(np.max(np.abs(record["tracking_error"] - predicted)) / size)
        kept = residual <= RESIDUAL or not is_ideal
        if not (finite and kept and off <= OFF):
            self.kind = WRONG
            self.text = f"finite {finite}, residual {residual:.2g}, off {off:.2g}"


@contextmanager
def checked(what: str) -> Iterator[Outcome]:
    """An outcome that takes down how its block ends."""
    outcome = Outcome(what)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield outcome
    except DrakeDaeError as error:
        outcome.kind, outcome.text = REFUSED, f"{type(error).__name__}: {error}"
    except (Exception, SystemExit) as error:  # SystemExit: an assertion of Drake's.
        last = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{Path(last.filename).name}:{last.lineno}"
        outcome.kind, outcome.text = RAW, f"{type(error).__name__} at {where}: {error}"
