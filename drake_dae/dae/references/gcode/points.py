"""Points of a path with speeds and without times, as CAM programs write them, as moves."""

from math import inf
from pathlib import Path

import numpy as np

from drake_dae.dae.references.csv_file import numbers_of, read_cells
from drake_dae.dae.references.gcode.program import MILLIMETRE, MINUTE, GCodeMove, GCodeProgram
from drake_dae.errors import ReferenceSignalError

SPEEDS = {"speed": MILLIMETRE, "feed": MILLIMETRE / MINUTE}
"""The names of the column of speeds -> their unit in m/s."""


def read_points(file: str) -> GCodeProgram:
    """Reads the straight moves between the points of a table.

    Its columns are x and y in mm, and optionally speed in mm/s or feed in mm/min of the move which
    ends at the point, infinite without such a column. A point that repeats is no move.

    Args:
        file: A CSV file with a row of names; comma, semicolon or tab between.

    Raises:
        ReferenceSignalError: It cannot be read, has other columns, or nothing moves.
    """
    header, cells = read_cells(Path(file))
    named = [name for name in SPEEDS if name in header]
    others = [name for name in header if name not in ("x", "y", *SPEEDS)]
    if "x" not in header or "y" not in header or len(named) > 1 or len(header) > len({*header}):
        raise ReferenceSignalError(
            f"'{file}': a path of points has the columns x and y in mm, and speed in mm/s or feed "
            f"in mm/min, got {', '.join(header) or 'none'}"
        )
    if others:
        raise ReferenceSignalError(
            f"'{file}': {', '.join(others)} would not be followed: a path of points lies in x and "
            "y, and the tool is held normal to the surface of its constraint; leave them out"
        )
    values = numbers_of(Path(file), header, cells, ["x", "y", *named])
    points = MILLIMETRE * values[:, :2]
    speeds = np.full(len(values), inf)
    if named:
        speeds = SPEEDS[named[0]] * values[:, 2]
        if not np.all(speeds[1:] > 0.0):
            row = int(np.argmin(speeds[1:] > 0.0)) + 1
            raise ReferenceSignalError(
                f"'{file}', row {row + 2}: {named[0]} must be positive, got {values[row, 2]:g}"
            )
    pairs = zip(points, points[1:], speeds[1:].tolist(), strict=False)
    moves = tuple(
        GCodeMove(start, end, speed) for start, end, speed in pairs if np.any(start != end)
    )
    if not moves:
        raise ReferenceSignalError(f"'{file}' moves nothing: all of its points are the same")
    return GCodeProgram(moves, ())
