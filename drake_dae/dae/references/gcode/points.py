"""Points of a path with speeds and without times, as CAM programs write them, as moves."""

from collections.abc import Sequence
from math import inf
from pathlib import Path

import numpy as np

from drake_dae.dae.references.csv_file import numbers_of, read_cells
from drake_dae.dae.references.gcode.program import MILLIMETRE, MINUTE, GCodeMove, GCodeProgram
from drake_dae.errors import ReferenceSignalError

SPEEDS = {"speed": MILLIMETRE, "feed": MILLIMETRE / MINUTE}
"""The names of the column of speeds -> their unit in m/s."""


def read_points(file: str, further: Sequence[str] = ()) -> GCodeProgram:
    """Reads the straight moves between the points of a table.

    Its columns are x and y in mm, and optionally speed in mm/s or feed in mm/min of the move which
    ends at the point, infinite without such a column. A repeated point is not a move.

    Args:
        file: A CSV file with a row of names; comma, semicolon or tab between.
        further: The names of further columns that are read.

    Raises:
        ReferenceSignalError: The file cannot be read, has other columns, nothing moves, or a
            further column changes while x and y stay.
    """
    header, cells = read_cells(Path(file))
    named = [name for name in SPEEDS if name in header]
    others = [name for name in header if name not in ("x", "y", *SPEEDS, *further)]
    if "x" not in header or "y" not in header or len(named) > 1 or len(header) > len({*header}):
        raise ReferenceSignalError(
            f"'{file}': a path of points has the columns x and y in mm, and speed in mm/s or feed "
            f"in mm/min, got {', '.join(header) or 'none'}"
        )
    if others:
        raise ReferenceSignalError(
            f"'{file}': {', '.join(others)} would not be followed. Name the columns that further "
            "outputs follow, such as the components of the tool's axis, under `columns`; leave out "
            "the others"
        )
    if missing := [name for name in further if name not in header]:
        raise ReferenceSignalError(
            f"'{file}' has no column {', '.join(missing)}, but {', '.join(header)}"
        )
    values = numbers_of(Path(file), header, cells, ["x", "y", *named, *further])
    points = MILLIMETRE * values[:, :2]
    speeds = np.full(len(values), inf)
    if named:
        speeds = SPEEDS[named[0]] * values[:, 2]
        if not np.all(speeds[1:] > 0.0):
            row = int(np.argmin(speeds[1:] > 0.0)) + 1
            raise ReferenceSignalError(
                f"'{file}', row {row + 2}: {named[0]} must be positive, got {values[row, 2]:g}"
            )
    is_move = np.any(points[1:] != points[:-1], axis=1)
    more = values[:, 2 + len(named) :]
    turns = ~is_move & np.any(more[1:] != more[:-1], axis=1)
    if turns.any():
        raise ReferenceSignalError(
            f"'{file}', row {int(np.argmax(turns)) + 3}: {', '.join(further)} change while x and y "
            "stay; columns are followed along the path"
        )
    if not is_move.any():
        raise ReferenceSignalError(f"'{file}' moves nothing: all of its points are the same")
    ends = np.flatnonzero(is_move) + 1
    moves = tuple(GCodeMove(points[i - 1], points[i], float(speeds[i])) for i in ends)
    return GCodeProgram(moves, (), more[np.r_[0, ends]])
