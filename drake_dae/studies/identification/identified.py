"""The result of an identification, as values and as text."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from drake_dae.analysis.tables import Table
from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, listed, unknown_name
from drake_dae.errors import ModelError
from drake_dae.studies.identification.fit import FitResult
from drake_dae.studies.identification.unknowns import Unknown

NORMAL = 1.96
"""Half the length of an interval of 95 %, in deviations."""

RESAMPLED = 400
"""The number of draws of the bootstrap."""

SHARE = 0.1
"""An unknown with a larger component than this in an undetermined direction is undetermined."""

WHITE = 3.0
"""Errors are white if their autocorrelation at lag 1 is below this, in deviations of the
autocorrelation of white noise."""

LARGER = 1.5
"""A deviation of the bootstrap that is larger than the Fisher one by this factor is reported."""

ALIKE = 1.25
"""Errors that differ from the stated noise by more than this factor are reported."""

LARGE = 0.3
"""A record does not fit if its errors, relative to the spread of the measurement, exceed this and
are not white."""

CONVERGED = 0.1
"""A fit has converged if its last step is below this, in deviations."""

STRONG = 0.95
"""Correlations of two parameters above this are reported."""


@checked(ModelError)
@dataclass(frozen=True)
class Noise:
    """The errors, measured minus computed, of a group of measured columns.

    Attributes:
        unit: The unit of the columns.
        deviation: The root mean square of the errors.
        stated: The standard deviation in the settings of the sensor; None if there is none.
        correlation: The autocorrelation at lag 1 with the largest absolute value.
        is_white: Whether `correlation` agrees with white noise.
        is_least: Whether the errors are only numerical, without any noise.
        share: `deviation` relative to the spread of the columns.
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
    """Identified parameters with their uncertainty.

    The Fisher information is F = sum T^T T, with the derivatives T of the weighted errors by the
    parameters at the best fit; the covariance is F^-1. It is valid for white noise with the
    deviation of the errors. The bootstrap draws whole pieces of the records with replacement, so it
    includes the effect of errors that are correlated within a piece.

    Attributes:
        unknowns: The parameters.
        values: Their values, shape (p,).
        start: Their initial guess, shape (p,).
        covariance: F^-1, shape (p, p); nan for undetermined parameters.
        bootstrap: The standard deviations by the bootstrap, shape (p,).
        undetermined: The parameters of each combination that the data do not determine.
        noise: Name of a measured signal, with its unit if it has several -> its errors.
        errors: Measured minus computed columns of each record, shape (k, c); nan where a value is
            not used.
        last_step: The length of the last step; each parameter moved by at most this many
            deviations.
        left_out: The number of steps between rows that are not used, and the number of all. Steps
            are left out in which a contact opens, closes or has an impact, a control without a hold
            jumps at the end of a phase of a task, or static friction needs far shorter steps than
            the rest of the record.
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
        check_shapes(self, len(self.unknowns), values=1, start=1, covariance=2, bootstrap=1)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the parameters."""
        return tuple(unknown.name for unknown in self.unknowns)

    def __getitem__(self, name: str) -> float:
        """The value of a parameter.

        Raises:
            ModelError: No parameter of this name was identified.
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
        """The intervals of 95 %, [lowest, highest] value, shape (p, 2)."""
        half = NORMAL * self.deviations
        return np.column_stack([self.values - half, self.values + half])

    @cached_property
    def correlations(self) -> FloatArray:
        """The correlations of the parameters, shape (p, p)."""
        return self.covariance / np.outer(self.deviations, self.deviations)

    def text(self) -> str:
        """The result as lines of text."""
        head = ("parameter", "value", "95 % interval", "bootstrap", "before", "unit")
        rows, half = list[Sequence[str]](), NORMAL * self.deviations
        for i, unknown in enumerate(self.unknowns):
            if np.isfinite(half[i]):
                shown = f"{self.values[i]:.{_digits(self.values[i], half[i])}g}"
                around = f"+- {half[i]:.2g}", f"+- {NORMAL * self.bootstrap[i]:.2g}"
            else:
                shown, around = "not determined", ("", "")
            rows.append((unknown.name, shown, *around, f"{self.start[i]:.6g}", unknown.unit))
        return "\n".join([*Table(head, rows, left=len(head)).lines(), "", *self.remarks()])

    def remarks(self) -> list[str]:
        """Sentences on convergence, fit, noise and undetermined parameters."""
        remarks = [
            f"The errors of {name} are {noise.share:.2g} times its spread: the record does not fit "
            "this robot. Look for a wrong sign, a wrong unit, a column of another joint, or "
            "something that the plant lacks."
            for name, noise in self.noise.items()
            if noise.share > LARGE and not noise.is_white
        ]
        if self.undetermined:
            names = listed((" with ".join(each) for each in self.undetermined), 20)[1:-1]
            remarks.append(
                f"Not determined by the records, and left as before: {names}. A motion or a force "
                "that depends on them is needed, or fewer free parameters."
            )
        remarks.append(
            f"Converged: the last step moved no parameter by more than {self.last_step:.2g} of its "
            "deviation."
            if self.last_step <= CONVERGED
            else f"Not quite converged: the last step was up to {self.last_step:.2g} deviations; "
            "intervals are wrong by as much."
        )
        count, total = self.left_out
        if count:
            remarks.append(
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
            remarks.append(f"At the lower bound: {listed(at_bound)[1:-1]}.")
        strong = np.abs(np.triu(self.correlations, 1)) > STRONG
        remarks += [
            f"{self.names[i]} and {self.names[j]} are hard to tell apart: their correlation is "
            f"{self.correlations[i, j]:.3f}."
            for i, j in np.argwhere(strong)
        ]
        for name, noise in self.noise.items():
            stated = "" if noise.stated is None else f" ({noise.stated:.2g} is stated)"
            ratio = noise.deviation / noise.stated if noise.stated else 1.0
            if not (1.0 / ALIKE < ratio < ALIKE or noise.is_least):
                remarks.append(
                    f"The errors of {name} are {ratio:.2g} times the stated noise: "
                    + ("the model lacks something." if ratio > 1.0 else "the sensor is better.")
                )
            kind = f"{'' if noise.is_white else 'not '}white"
            kind += f" (autocorrelation {noise.correlation:.2g})"
            if noise.is_least:
                kind = "only numerical, without noise"
            remarks.append(
                f"Errors of {name}: {noise.deviation:.2g} {noise.unit}".rstrip()
                + f"{stated}, {kind}."
            )
        if any(not (noise.is_white or noise.is_least) for noise in self.noise.values()):
            remarks.append(
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
            remarks.append(f"By the bootstrap the intervals of {listed(larger)[1:-1]} are longer.")
        return remarks

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
    """The number of digits of a value that its interval determines, plus one."""
    if not value or not half:
        return 6
    return int(np.clip(np.ceil(np.log10(abs(value) / half)) + 2, 2, 12))


def check_shapes(result: Any, p: int, **dimensions: int) -> None:
    """Checks that attributes of a result for p parameters have the shape (p,) or (p, p).

    Raises:
        ModelError: An attribute has another shape.
    """
    for name, dimension in dimensions.items():
        shape, actual = (p,) * dimension, np.shape(getattr(result, name))
        if actual != shape:
            raise ModelError(f"{name} of {p} parameters must have shape {shape}, got {actual}")


def fisher_covariance(fitted: FitResult, sizes: FloatArray) -> FloatArray:
    """The covariance of the unknowns, shape (p, p); nan for undetermined ones.

    Args:
        fitted: The fit.
        sizes: The sizes of the unknowns, shape (p,).
    """
    information = fitted.information[:, :, : len(sizes)].sum(axis=0)
    basis = sizes[:, None] * fitted.determined
    covariance: FloatArray = basis @ np.linalg.inv(basis.T @ information @ basis) @ basis.T
    is_open = np.square(fitted.undetermined).sum(axis=1) > SHARE**2
    covariance[is_open] = covariance[:, is_open] = np.nan
    return covariance


def undetermined_names(
    fitted: FitResult, unknowns: Sequence[Unknown]
) -> tuple[tuple[str, ...], ...]:
    """The names of the parameters in each undetermined direction."""
    return tuple(
        tuple(unknowns[i].name for i in np.flatnonzero(np.abs(column) > SHARE).tolist())
        for column in fitted.undetermined.T
    )


def bootstrap_deviations(fitted: FitResult, sizes: FloatArray) -> FloatArray:
    """The standard deviations of the unknowns by the bootstrap, shape (p,).

    Args:
        fitted: The fit.
        sizes: The sizes of the unknowns, shape (p,).
    """
    p, random = len(sizes), np.random.default_rng(0)
    basis = sizes[:, None] * fitted.determined
    count = len(fitted.information)
    drawn = random.multinomial(count, np.full(count, 1.0 / count), RESAMPLED)
    sums = np.tensordot(drawn.astype(float), fitted.information, axes=1)
    left = np.einsum("ia,kij,jb->kab", basis, sums[:, :, :p], basis)
    right = np.einsum("ia,ki->ka", basis, sums[:, :, p])
    # A draw may leave out the only pieces that determine something.
    pairs = zip(left, right, strict=True)
    changes = np.array([np.linalg.lstsq(a, b, rcond=None)[0] for a, b in pairs])
    return np.std(changes @ basis.T, axis=0)
