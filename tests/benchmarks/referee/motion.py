"""The reference after a motion: the fewest coordinates, integrated to more than 30 digits.

The midpoint rule of Gragg with 2, 4, ..., 2 K substeps is extrapolated to substeps of zero in
powers of their squares (Bulirsch and Stoer), which gives order 2 K. Steps are chosen so that the
two last columns differ by less than `TOLERANCE`; the run with another K tells the error.
"""

from collections.abc import Callable, Sequence

from mpmath import mpf

from referee.derive import State, closed, state
from referee.description import Mechanism

COLUMNS = 15
TOLERANCE = mpf(10) ** -35

Rate = Callable[[Sequence], list]


def after(mechanism: Mechanism, duration: object, columns: int = COLUMNS) -> State:
    """The state after a while.

    The positions of the joints that are not free follow from their rates T v_free; they stay closed
    to the accuracy of the integrator, and to round-off in the end.
    """
    size, first = mechanism.size, state(mechanism)

    def rate(y: Sequence) -> list:
        found = state(mechanism, y[:size], y[size:])
        return found.v + [found.acceleration[i] for i in mechanism.free]

    start = first.q + [first.v[i] for i in mechanism.free]
    y = integrated(rate, start, mpf(repr(duration)), columns)
    return state(mechanism, closed(mechanism, y[:size]), y[size:])


def integrated(rate: Rate, start: Sequence, duration: object, columns: int) -> list:
    """The solution of y' = rate(y) after a while."""
    y, done, step = list(start), mpf(0), duration / 8
    while done < duration:
        step = min(step, duration - done)
        found, error = extrapolated(rate, y, step, columns)
        size = max(1, *(abs(value) for value in found))
        ratio = error / (size * TOLERANCE)
        if ratio <= 1:
            y, done = found, done + step
        factor = mpf("0.9") * ratio ** (mpf(-1) / (2 * columns - 1)) if ratio else mpf(2)
        step *= min(mpf(2), max(mpf("0.2"), factor))
    return y


def extrapolated(rate: Rate, y: Sequence, step: object, columns: int) -> tuple[list, object]:
    """One step, and the difference of its last two columns."""
    first = rate(y)
    table: list[list] = []
    for j in range(columns):
        row = [midpoint(rate, y, first, step, 2 * (j + 1))]
        for m in range(1, j + 1):
            weight = 1 / ((mpf(j + 1) / (j + 1 - m)) ** 2 - 1)
            row.append(
                [a + (a - b) * weight for a, b in zip(row[m - 1], table[-1][m - 1], strict=True)]
            )
        table.append(row)
    last = table[-1]
    error = max(abs(a - b) for a, b in zip(last[-1], last[-2], strict=True))
    return last[-1], error


def midpoint(rate: Rate, y: Sequence, first: Sequence, step: object, count: int) -> list:
    """Gragg's modified midpoint rule."""
    h = step / count
    before, now = list(y), [a + h * b for a, b in zip(y, first, strict=True)]
    for _ in range(count - 1):
        before, now = now, [a + 2 * h * b for a, b in zip(before, rate(now), strict=True)]
    end = rate(now)
    return [(a + b + h * c) / 2 for a, b, c in zip(before, now, end, strict=True)]
