"""Identification of the parameters of a plant from its records."""

from collections.abc import Mapping, Sequence
from contextlib import suppress

import numpy as np
from pydrake.systems.framework import Context

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.simulation.records.record import Record
from drake_dae.studies.identification.channels import SAME, Channel
from drake_dae.studies.identification.driven import DrivenPlant
from drake_dae.studies.identification.fit import COUPLINGS, SMALLEST, FitResult, ParameterFit
from drake_dae.studies.identification.identified import (
    WHITE,
    Identified,
    Noise,
    bootstrap_deviations,
    fisher_covariance,
    undetermined_names,
)
from drake_dae.studies.identification.measured import measured, measured_ports
from drake_dae.studies.identification.pieces import RecordPieces
from drake_dae.studies.identification.unknowns import Unknowns

ROUNDED = 10.0
"""Errors below this multiple of the least noise are only numerical."""

BRIEF, LONG = 2000, 4000
"""If a record has more than `LONG` rows, a first estimate uses the first `BRIEF` ones."""


@checked(ModelError)
def identify(
    loop: ClosedLoop,
    context: Context,
    records: Sequence[Record] | Mapping[str, Record],
    free: Sequence[str],
) -> Identified:
    """Identifies parameters of the plant of a loop, with their uncertainty, from its records.

    The recorded controls drive the plant; the law is not used. Records are cut into short pieces.
    The parameters and the initial states of all pieces minimize

        sum |measured - computed|^2 / noise^2

    such that each piece starts at the final state of the piece before it, and on N*. The method is
    multiple shooting with Gauss-Newton steps and exact derivatives. The noise of each kind of
    measurement is estimated from its errors.

    The measurements are positions, from the encoders if the loop has any, and constraint forces,
    from the force sensor if the loop has one. Velocities are not used as measurements.

    Args:
        loop: The closed loop. Its plant is continuous, or a discrete `CompliantPlant`. Steps in
            which an ideal contact opens, closes or has an impact are left out, and the pieces
            before and after them are not joined; the records need the signal "mode" for this.
        context: A context of its diagram, with the values of all other parameters and the initial
            guess of the free ones.
        records: The records of this plant under any law, by name or in a list, with the signals
            "control" and "state" (or the encoders'), and "constraint_force" or "measured_force".
        free: Names of the plant's parameters, such as "tool.mass", "wall.position[0]" or
            "plant.stiffness"; "force.bias" and "position.bias" for the biases of the sensors;
            "force.delay" and "position.delay" for their delays in s.

    Raises:
        ModelError: There is no such parameter, a record does not fit the plant, the plant is of
            another kind, or the fit does not converge.

    Source: Bock, Randwertproblemmethoden zur Parameteridentifizierung, 1987 (multiple shooting);
    Bierman, Factorization Methods for Discrete Sequential Estimation, 1977.
    """
    unknowns = Unknowns.of(loop, free)
    named = records if isinstance(records, Mapping) else _numbered(records)
    if not named:
        raise ModelError("there is no record to identify parameters from")
    _check_differ(named)
    driven = DrivenPlant(loop, context, measured_ports(loop), unknowns.places)
    pieces = [pieces_of(record, driven, unknowns, title) for title, record in named.items()]
    start = unknowns.start(driven.nominal, pieces[0].data.channels)
    sizes = np.where(start != 0.0, np.abs(start), 1.0)
    lowest = np.array([-np.inf if u.lowest is None else u.lowest for u in unknowns.all])
    limits = sizes, lowest, np.array([unknown.strict for unknown in unknowns.all])
    fitted = _fitted(pieces, start, limits)
    covariance, bootstrap = fisher_covariance(fitted, sizes), bootstrap_deviations(fitted, sizes)
    bootstrap[np.isnan(np.diagonal(covariance))] = np.nan
    return Identified(
        unknowns.all,
        fitted.values,
        start,
        covariance,
        bootstrap,
        undetermined_names(fitted, unknowns.all),
        _noise(loop, pieces, fitted),
        fitted.errors,
        fitted.last_step,
        fitted.left_out,
    )


def _fitted(
    pieces: Sequence[RecordPieces],
    start: FloatArray,
    limits: tuple[FloatArray, FloatArray, np.ndarray],
) -> FitResult:
    """Fits the records; long records first with some of their rows, for a better initial guess."""
    if all(record.data.times.size <= LONG for record in pieces):
        return ParameterFit(pieces, start, *limits).run()
    shortened = [record.first(BRIEF) for record in pieces]
    first = ParameterFit(shortened, start, *limits).run(COUPLINGS[:-1])
    with suppress(ModelError):  # A good initial guess needs no loose coupling.
        return ParameterFit(pieces, first.values, *limits, first.noise).run(COUPLINGS[-1:])
    return ParameterFit(pieces, first.values, *limits).run()


def pieces_of(record: Record, driven: DrivenPlant, unknowns: Unknowns, title: str) -> RecordPieces:
    """Cuts a record into pieces.

    Raises:
        ModelError: The record does not fit the plant or the unknowns.
    """
    data = measured(record, driven, title)
    biases, delays = unknowns.of_sensors(data.channels)
    if (delays >= 0).any():
        _check_even(data.times, title)
        if data.cut.any():
            raise ModelError(
                f"contacts of {title} open or close, or phases of its task end, and a delay is not "
                "found across these; leave the delay out, or take a record between two of them"
            )
    return RecordPieces(driven, data, biases, delays, unknowns.num_sensed)


def _check_differ(records: Mapping[str, Record]) -> None:
    """Checks that no run is given twice; its noise would count as independent noise."""
    named = list(records.items())
    for i, (title, record) in enumerate(named):
        for before, other in named[:i]:
            pairs = [
                (record.time, other.time),
                *((r.values, other[n]) for n, r in record.signals.items() if n in other.signals),
            ]
            if all(np.array_equal(a, b) for a, b in pairs):
                raise ModelError(f"{before} and {title} are the same run; name it once")


def _check_even(times: FloatArray, title: str) -> None:
    """Checks that rows are equally spaced, as delays need."""
    steps = np.diff(times)
    if np.ptp(steps[:-1]) > SAME * np.median(steps):
        raise ModelError(
            f"a delay is found from rows at equal steps, and {title} has steps of "
            f"{steps.min():.4g} to {steps.max():.4g} s; record it with fixed steps or at samples"
        )


def _numbered(records: Sequence[Record]) -> dict[str, Record]:
    if len(records) == 1:
        return {"the record": records[0]}
    return {f"record {number}": record for number, record in enumerate(records, 1)}


def _noise(loop: ClosedLoop, pieces: Sequence[RecordPieces], fitted: FitResult) -> dict[str, Noise]:
    """The errors of each group of measured columns, over all records."""
    groups = dict[tuple[str, str], list[tuple[Channel, FloatArray, float]]]()
    for record, errors in zip(pieces, fitted.errors, strict=True):
        measured_columns = zip(record.data.channels, errors.T, record.spread, strict=True)
        for channel, column, spread in measured_columns:
            finite = column[np.isfinite(column)]
            groups.setdefault(channel.group, []).append((channel, finite, float(spread)))
    noise, signals = {}, [signal for signal, _ in groups]
    for (signal, unit), group in groups.items():
        channels, columns, spreads = zip(*group, strict=True)
        largest = max(map(_correlation, columns), key=abs)
        deviation = float(np.sqrt(np.mean(np.square(np.concatenate(columns)))))
        limit = max(WHITE / np.sqrt(max(column.size, 1)) for column in columns)
        name = signal if signals.count(signal) == 1 else f"{signal} [{unit}]"
        stated, share = stated_noise(loop, channels[-1]), deviation / max(spreads)
        is_white, is_least = bool(abs(largest) < limit), share < ROUNDED * SMALLEST
        noise[name] = Noise(unit, deviation, stated, largest, is_white, is_least, share)
    return noise


def _correlation(errors: FloatArray) -> float:
    """The autocorrelation of errors at lag 1."""
    centered = errors - errors.mean()
    power = float(centered @ centered)
    return float(centered[1:] @ centered[:-1]) / power if power else 0.0


def stated_noise(loop: ClosedLoop, channel: Channel) -> float | None:
    """The standard deviation in a sensor's settings; None if the loop has no such sensor."""
    if channel.signal == "measured_force" and loop.sensor is not None:
        return float(loop.sensor.noise_deviation[channel.place])
    if channel.signal != "state" and channel.port == "state" and loop.encoders is not None:
        return float(np.max(loop.encoders.sensor.encoders.position_deviation))
    return None
