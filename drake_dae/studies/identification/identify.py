"""Parameters of a plant from records of it."""

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
    known_covariance,
    resampled,
    undetermined_names,
)
from drake_dae.studies.identification.measured import measured, measured_ports
from drake_dae.studies.identification.pieces import RecordPieces
from drake_dae.studies.identification.unknowns import Unknowns

ROUNDED = 10.0
"""What is left is called that of computing if it is less than so many times the least noise."""

BRIEF, LONG = 2000, 4000
"""Of a record with more rows than the latter, so many are used for a first estimate."""


@checked(ModelError)
def identify(
    loop: ClosedLoop,
    context: Context,
    records: Sequence[Record] | Mapping[str, Record],
    free: Sequence[str],
) -> Identified:
    """Parameters of the plant of a loop, with their uncertainty, from records of it.

    The plant alone is driven by the recorded controls; the law plays no part. Records are cut into
    short pieces, each from a state of its own, and the unknowns, all these states among them,
    minimize

        sum |measured - computed|^2 / noise^2

    under the condition that a piece begins where the one before ends, and on N*: multiple shooting
    with steps of Gauss-Newton and exact derivatives. The noise of each kind of measurement is that
    of what is left.

    Measured are the positions of the state, as the loop's encoders show them if it has any, and the
    constraint forces, of its sensor if it has one. Velocities are not: they are estimated.

    Args:
        loop: The closed loop. Its plant is continuous, or a discrete `CompliantPlant`. Steps in
            which an ideal contact opens, closes or is struck are left out, and pieces on both sides
            are not joined; "mode" of the records says when contacts are closed.
        context: A context of its diagram; parameters begin with its values, and all others have
            them.
        records: The records, by name or in a list: of this plant under any law, with the signals
            "control" and "state" (or the encoders'), and "constraint_force" or "measured_force".
        free: Names of the plant's parameters, such as "tool.mass", "wall.position[0]" or
            "plant.stiffness"; "force.bias" and "position.bias" are what sensors add, "force.delay"
            and "position.delay" by how much later they measure, in s.

    Raises:
        ModelError: There is no such parameter, a record does not fit the plant, the plant is of
            another kind, or no values are found.

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
    given = sizes, lowest, np.array([unknown.strict for unknown in unknowns.all])
    fitted = _fitted(pieces, start, given)
    return _identified(loop, unknowns, start, sizes, pieces, fitted)


def _fitted(
    pieces: Sequence[RecordPieces],
    start: FloatArray,
    given: tuple[FloatArray, FloatArray, np.ndarray],
) -> FitResult:
    """The fit, of long records from a first estimate by their first rows."""
    if all(each.data.times.size <= LONG for each in pieces):
        return ParameterFit(pieces, start, *given).run()
    first = ParameterFit([each.first(BRIEF) for each in pieces], start, *given).run(COUPLINGS[:-1])
    with suppress(ModelError):  # From nearby, pieces need not be loose at first.
        return ParameterFit(pieces, first.values, *given, first.noise).run(COUPLINGS[-1:])
    return ParameterFit(pieces, first.values, *given).run()


def pieces_of(record: Record, driven: DrivenPlant, unknowns: Unknowns, title: str) -> RecordPieces:
    """A record in pieces.

    Raises:
        ModelError: It does not fit the plant or the unknowns.
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
    return RecordPieces(driven, data, biases, unknowns.num_sensed, delays=delays)


def _check_differ(records: Mapping[str, Record]) -> None:
    """Refuses one run under two names, whose noise would be taken for that of two."""
    named = list(records.items())
    for i, (title, record) in enumerate(named):
        for before, other in named[:i]:
            pairs = [
                (record.time, other.time),
                *((r.values, other[n]) for n, r in record.signals.items() if n in other.signals),
            ]
            if all(np.array_equal(one, two) for one, two in pairs):
                raise ModelError(f"{before} and {title} are the same run; name it once")


def _check_even(times: FloatArray, title: str) -> None:
    """Refuses rows that are not equally far from each other, for delays."""
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


def _identified(
    loop: ClosedLoop,
    unknowns: Unknowns,
    start: FloatArray,
    sizes: FloatArray,
    pieces: Sequence[RecordPieces],
    fitted: FitResult,
) -> Identified:
    names, p = [unknown.name for unknown in unknowns.all], start.size
    parts = fitted.determined, fitted.undetermined
    covariance = known_covariance(fitted.information[:, :, :p].sum(axis=0), *parts, sizes)
    bootstrap = resampled(fitted.information, fitted.determined, sizes)
    bootstrap[np.isnan(np.diagonal(covariance))] = np.nan
    undetermined = undetermined_names(fitted.undetermined, names)
    noise = _noise(loop, pieces, fitted)
    return Identified(
        unknowns.all,
        fitted.values,
        start,
        covariance,
        bootstrap,
        undetermined,
        noise,
        fitted.errors,
        fitted.last_step,
        fitted.left_out,
    )


def _noise(loop: ClosedLoop, pieces: Sequence[RecordPieces], fitted: FitResult) -> dict[str, Noise]:
    """What is left of each group of measured columns, over all records."""
    groups = dict[tuple[str, str], list[FloatArray]]()
    one_of = dict[tuple[str, str], Channel]()
    spreads = dict[tuple[str, str], float]()
    for each, errors in zip(pieces, fitted.errors, strict=True):
        for channel, column, spread in zip(each.data.channels, errors.T, each.spread, strict=True):
            own = column[np.isfinite(column)]
            groups.setdefault(channel.group, []).append(own)
            one_of[channel.group] = channel
            spreads[channel.group] = max(float(spread), spreads.get(channel.group, 0.0))
    found, signals = {}, [signal for signal, _ in groups]
    for (signal, unit), columns in groups.items():
        correlations = [_correlation(column) for column in columns]
        largest = max(correlations, key=abs)
        deviation = float(np.sqrt(np.mean(np.square(np.concatenate(columns)))))
        limit = max(WHITE / np.sqrt(max(column.size, 1)) for column in columns)
        name = signal if signals.count(signal) == 1 else f"{signal} [{unit}]"
        stated = stated_noise(loop, one_of[signal, unit])
        share = deviation / spreads[signal, unit]
        is_white, is_least = bool(abs(largest) < limit), share < ROUNDED * SMALLEST
        found[name] = Noise(unit, deviation, stated, largest, is_white, is_least, share)
    return found


def _correlation(errors: FloatArray) -> float:
    """The correlation of errors with the next ones."""
    own = errors - errors.mean()
    power = float(own @ own)
    return float(own[1:] @ own[:-1]) / power if power else 0.0


def stated_noise(loop: ClosedLoop, channel: Channel) -> float | None:
    """The deviation that a sensor is said to have."""
    if channel.signal == "measured_force" and loop.sensor is not None:
        return float(loop.sensor.noise_deviation[channel.place])
    if channel.signal != "state" and channel.port == "state" and loop.encoders is not None:
        deviation = loop.encoders.sensor.encoders.position_deviation
        return float(np.max(deviation))
    return None
