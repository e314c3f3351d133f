"""Vectors, rotations and linear systems of mpmath's numbers, as lists."""

from collections.abc import Sequence

from mpmath import mp, mpf

IDENTITY = [[mpf(int(i == j)) for j in range(3)] for i in range(3)]


def exact(numbers: Sequence[float]) -> list:
    """The decimals that the numbers print as: 0.3 is 3/10."""
    return [mpf(repr(float(number))) for number in numbers]


def add(*vectors: Sequence) -> list:
    """Their sum."""
    return [sum(parts[1:], parts[0]) for parts in zip(*vectors, strict=True)]


def sub(a: Sequence, b: Sequence) -> list:
    """a - b."""
    return [x - y for x, y in zip(a, b, strict=True)]


def scaled(factor: object, vector: Sequence) -> list:
    """factor vector."""
    return [factor * x for x in vector]


def dot(a: Sequence, b: Sequence) -> object:
    """a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Sequence, b: Sequence) -> list:
    """a x b."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def apply(matrix: Sequence, vector: Sequence) -> list:
    """matrix vector."""
    return [dot(row, vector) for row in matrix]


def transposed(matrix: Sequence) -> list:
    """The transpose; of a rotation, the body's axes in the world."""
    return [list(column) for column in zip(*matrix, strict=True)]


def matmul(a: Sequence, b: Sequence) -> list:
    """a b, both of shape (3, 3)."""
    columns = transposed(b)
    return [[dot(row, column) for column in columns] for row in a]


def turned(axis: Sequence, angle: object) -> list:
    """The rotation about a unit axis, by Rodrigues."""
    c, s = mp.cos(angle), mp.sin(angle)
    outer = [[(1 - c) * x * y for y in axis] for x in axis]
    x, y, z = scaled(s, axis)
    skew = [[c, -z, y], [z, c, -x], [-y, x, c]]
    return [add(first, second) for first, second in zip(outer, skew, strict=True)]


def rank_and_pivots(matrix: Sequence) -> tuple[int, list[int]]:
    """The rank of a matrix, and rows that are independent, by complete pivoting."""
    rest = [list(row) for row in matrix]
    rows, columns = list(range(len(rest))), list(range(len(rest[0]) if rest else 0))
    chosen = []
    largest = max((abs(x) for row in rest for x in row), default=mpf(0))
    while rows and columns:
        size, i, j = max((abs(rest[i][j]), i, j) for i in rows for j in columns)
        if size <= largest * mpf(10) ** (-mp.dps // 2):
            break
        chosen.append(i)
        rows.remove(i)
        columns.remove(j)
        for k in rows:
            share = rest[k][j] / rest[i][j]
            if share:
                rest[k] = [x - share * y for x, y in zip(rest[k], rest[i], strict=True)]
    return len(chosen), sorted(chosen)


def solve(matrix: Sequence, right: Sequence) -> list:
    """The solution of a square linear system, by elimination with partial pivoting."""
    lines = [[*row, value] for row, value in zip(matrix, right, strict=True)]
    size = len(lines)
    for k in range(size):
        pivot = max(range(k, size), key=lambda i: abs(lines[i][k]))
        lines[k], lines[pivot] = lines[pivot], lines[k]
        for i in range(k + 1, size):
            if lines[i][k]:
                share = lines[i][k] / lines[k][k]
                lines[i] = [x - share * y for x, y in zip(lines[i], lines[k], strict=True)]
    found = [mpf(0)] * size
    for k in reversed(range(size)):
        known = sum((lines[k][j] * found[j] for j in range(k + 1, size)), mpf(0))
        found[k] = (lines[k][size] - known) / lines[k][k]
    return found
