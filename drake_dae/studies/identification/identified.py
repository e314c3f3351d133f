"""The result of an identification, as values and as text."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, listed, unknown_name
from drake_dae.errors import ModelError
from drake_dae.studies.identification.unknowns import Unknown

NORMAL = 1.96
"""An interval of 95 % has so many deviations to each side."""

RESAMPLED = 400
"""So many times the bootstrap draws pieces of the records."""

SHARE = 0.1
"""An unknown with a larger part than this in a direction that is not determined is not either."""

WHITE = 3.0
"""Errors whose correlation with the next ones is above this, in deviations of that of white noise,
are not white."""

LARGER = 1.5
"""A deviation of the bootstrap that is larger by this factor is remarked."""

ALIKE = 1.25
"""What is left is called other than the stated noise where it differs by more than this factor."""

LARGE = 0.3
"""If so large a part of how much a measurement varies is left, and not white, the record does not
fit."""

CONVERGED = 0.1
"""A last step below this, in deviations, is small beside the intervals."""

STRONG = 0.95
"""Correlations of two unknowns above this are printed."""


@checked(ModelError)
@dataclass(frozen=True)
class Noise:
    """What is left of some measured columns.

    Attributes:
        unit: Its unit.
        deviation: Its deviation.
        stated: The deviation that the sensor is said to have; None if nobody said.
        correlation: The largest correlation of an error with the next one, by its absolute value.
        is_white: Whether that is what white noise has.
        is_least: Whether there is no noise, and what is left is that of computing.
        share: The deviation relative to how much the columns vary.
    """

    unit: str
    deviation: float
    stated: float | None
    correlation: float
    is_white: bool
    is_least: bool = False
    share: float = 0.0


@checked(ModelError)
@dataclass(frozen=True, eq=False)
class Identified:
    """Parameters with their uncertainty, from records.

    The information of the data about the parameters is F = sum T^T T, with the derivatives T of the
    errors over their noise along the motions that fit best; their covariance is F^-1 (Fisher). It
    holds for white noise of the deviation that the errors have. The bootstrap draws whole pieces of
    the records with repetition, so that it knows errors that are correlated within a piece.

    Attributes:
        unknowns: The parameters.
        values: Their values, shape (p,).
        start: The values at the beginning, shape (p,).
        covariance: F^-1, shape (p, p); nan for what is not determined.
        bootstrap: The deviations by the bootstrap, shape (p,).
        undetermined: The parameters of each combination that the data do not determine.
        noise: Name of a measured signal, with its unit if it has several -> what is left of it.
        errors: For each record the measured minus the computed columns, shape (k, c); nan where
            none is used.
        last_step: How far it has converged: in the last step no parameter moved by more of its
            deviations.
        left_out: How many steps between rows are not used, of how many: those in which a contact
            opens, closes or is struck, a control that is not held jumps as a phase of a task ends,
            or friction at rest needs far shorter steps than the rest of the record.
    """

    unknowns: tuple[Unknown, ...]
    values: FloatArray
    start: FloatArray
    covariance: FloatArray
    bootstrap: FloatArray
    undetermined: tuple[tuple[str, ...], ...]
    noise: Mapping[str, Noise]
    errors: Sequence[FloatArray] = field(repr=False)
    last_step: float = 0.0
    left_out: tuple[int, int] = (0, 0)

    def __post_init__(self) -> None:
        p = len(self.unknowns)
        sizes = {"values": (p,), "start": (p,), "covariance": (p, p), "bootstrap": (p,)}
        for name, shape in sizes.items():
            if np.shape(getattr(self, name)) != shape:
                raise ModelError(
                    f"{name} of {p} parameters must have shape {shape}, got "
                    f"{np.shape(getattr(self, name))}"
                )

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the parameters."""
        return tuple(unknown.name for unknown in self.unknowns)

    def __getitem__(self, name: str) -> float:
        """The value of a parameter.

        Raises:
            ModelError: It was not asked for.
        """
        if name not in self.names:
            raise ModelError(unknown_name("identified parameter", name, self.names))
        return float(self.values[self.names.index(name)])

    @property
    def deviations(self) -> FloatArray:
        """The standard deviations by the Fisher information, shape (p,)."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def intervals(self) -> FloatArray:
        """The intervals of 95 %, lowest and highest value, shape (p, 2)."""
        half = NORMAL * self.deviations
        return np.column_stack([self.values - half, self.values + half])

    @cached_property
    def correlations(self) -> FloatArray:
        """The correlations of the parameters, shape (p, p)."""
        return self.covariance / np.outer(self.deviations, self.deviations)

    def text(self) -> str:
        """The result as lines of text."""
        rows = [("parameter", "value", "95 % interval", "bootstrap", "before", "unit")]
        half = NORMAL * self.deviations
        for i, unknown in enumerate(self.unknowns):
            if np.isfinite(half[i]):
                shown = f"{self.values[i]:.{_digits(self.values[i], half[i])}g}"
                around = f"+- {half[i]:.2g}", f"+- {NORMAL * self.bootstrap[i]:.2g}"
            else:
                shown, around = "not determined", ("", "")
            rows.append((unknown.name, shown, *around, f"{self.start[i]:.6g}", unknown.unit))
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = [
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
            for row in rows
        ]
        return "\n".join([*lines, "", *self.remarks()])

    def remarks(self) -> list[str]:
        """What is to be known about the values."""
        found = [
            f"What is left of {name} is {noise.share:.2g} times as large as how much it varies: "
            "the record does not fit this robot. Look for a wrong sign, a wrong unit, a column of "
            "another joint, or something that the plant lacks."
            for name, noise in self.noise.items()
            if noise.share > LARGE and not noise.is_white
        ]
        if self.undetermined:
            names = listed((" with ".join(each) for each in self.undetermined), 20)[1:-1]
            found.append(
                f"Not determined by the records, and left as before: {names}. A motion or a force "
                "that depends on them is needed, or fewer free parameters."
            )
        found.append(
            f"Converged: the last step moved no parameter by more than {self.last_step:.2g} of its "
            "deviation."
            if self.last_step <= CONVERGED
            else f"Not quite converged: the last step was up to {self.last_step:.2g} deviations; "
            "intervals are wrong by as much."
        )
        count, total = self.left_out
        if count:
            found.append(
                f"Left out are {count} of {total} steps between rows, in which a contact opens, "
                "closes or is struck, a phase of a task ends, or friction at rest needs far "
                "shorter steps."
            )
        at_bound = [
            unknown.name
            for unknown, value in zip(self.unknowns, self.values.tolist(), strict=True)
            if unknown.lowest is not None and value <= unknown.lowest
        ]
        if at_bound:
            found.append(f"At the lower bound: {listed(at_bound)[1:-1]}.")
        strong = np.abs(np.triu(self.correlations, 1)) > STRONG
        found += [
            f"{self.names[i]} and {self.names[j]} are hard to tell apart: their correlation is "
            f"{self.correlations[i, j]:.3f}."
            for i, j in np.argwhere(strong)
        ]
        for name, noise in self.noise.items():
            stated = "" if noise.stated is None else f" ({noise.stated:.2g} is stated)"
            ratio = noise.deviation / noise.stated if noise.stated else 1.0
            if not (1.0 / ALIKE < ratio < ALIKE or noise.is_least):
                found.append(
                    f"What is left of {name} is {ratio:.2g} times the noise that is stated: "
                    + ("the model lacks something." if ratio > 1.0 else "the sensor is better.")
                )
            kind = f"{'' if noise.is_white else 'not '}white"
            kind += f" (correlation with the next one {noise.correlation:.2g})"
            if noise.is_least:
                kind = "what computing leaves: there is no noise"
            found.append(
                f"Left of {name}: {noise.deviation:.2g} {noise.unit}".rstrip()
                + f"{stated}, {kind}."
            )
        if any(not (noise.is_white or noise.is_least) for noise in self.noise.values()):
            found.append(
                "Where errors are not white the intervals are too short, by the bootstrap less so: "
                "the model lacks something (a free parameter, friction, a bias), the "
                "noise of a sensor passes a filter, or it rounds."
            )
        larger = [
            name
            for name, b, d in zip(self.names, self.bootstrap, self.deviations, strict=True)
            if b > LARGER * d
        ]
        if larger:
            found.append(f"By the bootstrap the intervals of {listed(larger)[1:-1]} are longer.")
        return found

    def to_dict(self) -> dict[str, Any]:
        """The result as plain values."""
        rows = zip(self.unknowns, self.values, self.intervals, self.bootstrap, strict=True)
        return {
            "parameters": {
                unknown.name: {
                    "value": float(value),
                    "interval": [*map(float, interval)] if np.isfinite(interval).all() else None,
                    "bootstrap_deviation": float(spread) if np.isfinite(spread) else None,
                    "unit": unknown.unit,
                }
                for unknown, value, interval, spread in rows
            },
            "undetermined": [list(names) for names in self.undetermined],
            "last_step_in_deviations": self.last_step,
            "steps_left_out": self.left_out[0],
            "noise": {name: vars(noise) for name, noise in self.noise.items()},
        }


def _digits(value: float, half: float) -> int:
    """How many digits of a value its interval determines, and one more."""
    if not value or not half:
        return 6
    return int(np.clip(np.ceil(np.log10(abs(value) / half)) + 2, 2, 12))


def known_covariance(
    information: FloatArray, determined: FloatArray, undetermined: FloatArray, sizes: FloatArray
) -> FloatArray:
    """The covariance of the unknowns, nan for those that are not determined, shape (p, p).

    Args:
        information: F, shape (p, p).
        determined: As of `Fitted`.
        undetermined: As of `Fitted`.
        sizes: The sizes of the unknowns.
    """
    basis = sizes[:, None] * determined
    found: FloatArray = basis @ np.linalg.inv(basis.T @ information @ basis) @ basis.T
    is_open = np.square(undetermined).sum(axis=1) > SHARE**2
    found[is_open] = found[:, is_open] = np.nan
    return found


def undetermined_names(
    undetermined: FloatArray, names: Sequence[str]
) -> tuple[tuple[str, ...], ...]:
    """The parameters of each direction that is not determined, by name."""
    return tuple(
        tuple(names[i] for i in np.flatnonzero(np.abs(column) > SHARE).tolist())
        for column in undetermined.T
    )


def resampled(information: FloatArray, determined: FloatArray, sizes: FloatArray) -> FloatArray:
    """The deviations of the unknowns by the bootstrap, shape (p,).

    Args:
        information: As of `Fitted`.
        determined: As of `Fitted`.
        sizes: The sizes of the unknowns.
    """
    p, random = len(sizes), np.random.default_rng(0)
    basis = sizes[:, None] * determined
    count = len(information)
    drawn = random.multinomial(count, np.full(count, 1.0 / count), RESAMPLED)
    sums = np.tensordot(drawn.astype(float), information, axes=1)
    left = np.einsum("ia,kij,jb->kab", basis, sums[:, :, :p], basis)
    right = np.einsum("ia,ki->ka", basis, sums[:, :, p])
    # A draw may leave out the only pieces that determine something.
    pairs = zip(left, right, strict=True)
    changes = np.array([np.linalg.lstsq(a, b, rcond=None)[0] for a, b in pairs])
    return np.std(changes @ basis.T, axis=0)
