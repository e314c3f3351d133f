"""The unknown parameters of an identification, by name."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self, TypeVar

import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.dae.system.signals import Parameter
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.studies.identification.channels import Channel, is_position

FORCE_BIAS, POSITION_BIAS = "force.bias", "position.bias"
"""The names of the biases of force sensor and encoders."""

FORCE_DELAY, POSITION_DELAY = "force.delay", "position.delay"
"""The names of the delays of force sensor and encoders in s, equal for all their entries."""

_ENTRY = re.compile(r"(.+)\[(\d+)\]")


class NamedNumber(Protocol):
    """A number with a name."""

    @property
    def name(self) -> str:
        """The name, with the index of the entry if the parameter has several."""


Number = TypeVar("Number", bound=NamedNumber)


@checked(ModelError)
@dataclass(frozen=True)
class Unknown:
    """An unknown number.

    Attributes:
        name: The name of the parameter, with the index of the entry if it has several.
        parameter: The name without the index.
        entry: The index.
        unit: The unit of the number.
        lowest: Its lower bound; None for none.
        strict: Whether it must stay above its bound, as a mass.
        place: Its index in numeric parameter 0 of the plant; -1 for a number of a sensor.
    """

    name: str
    parameter: str
    entry: int
    unit: str
    lowest: float | None = None
    place: int = -1
    strict: bool = False


@dataclass(frozen=True, eq=False)
class Unknowns:
    """All unknown numbers.

    Attributes:
        all: The numbers of the plant, followed by those of the sensors.
    """

    all: tuple[Unknown, ...]

    @classmethod
    def of(cls, loop: ClosedLoop, free: Sequence[str]) -> Self:
        """Finds the unknowns by the names of parameters.

        Args:
            loop: The loop.
            free: Names of the plant's parameters, "link1.mass"; entries, "wall.position[0]"; and
                FORCE_BIAS, POSITION_BIAS, FORCE_DELAY and POSITION_DELAY.

        Raises:
            ModelError: There is no such parameter or entry, it is named twice, or it is an
                exogenous signal.
        """
        if isinstance(free, str) or not free:
            raise ModelError(f"free must be a list of names of parameters, got {free!r}")
        available = dict[str, list[Unknown]]()
        for unknown in _all(loop):
            available.setdefault(unknown.parameter, []).append(unknown)
        chosen = [u for n in free for u in named_entries(n, available, "parameter to identify")]
        if doubles := {u.name for u in chosen if chosen.count(u) > 1}:
            raise ModelError(f"'{min(doubles)}' is named twice in free")
        exogenous = loop.plant.exogenous_places
        if moving := {u.name for u in chosen if u.place >= 0 and u.place in exogenous}:
            raise ModelError(
                f"'{min(moving)}' is an exogenous signal, which moves as its references say; only "
                "constants are identified"
            )
        return cls(tuple(sorted(chosen, key=lambda unknown: unknown.place < 0)))

    @property
    def places(self) -> list[int]:
        """The `place` of each unknown of the plant."""
        return [unknown.place for unknown in self.all if unknown.place >= 0]

    @property
    def num_sensed(self) -> int:
        """The number of unknowns of sensors."""
        return len(self.all) - len(self.places)

    def of_sensors(self, channels: Sequence[Channel]) -> tuple[np.ndarray, np.ndarray]:
        """The indices of each column's bias and delay among the unknowns of sensors; -1 for none.

        Raises:
            ModelError: No column measures the quantity of a bias or delay.
        """
        biases, delays = np.full(len(channels), -1), np.full(len(channels), -1)
        for number, unknown in enumerate(self.all[len(self.places) :]):
            is_force = unknown.parameter in (FORCE_BIAS, FORCE_DELAY)
            is_delay = unknown.parameter in (FORCE_DELAY, POSITION_DELAY)
            own = [
                column
                for column, channel in enumerate(channels)
                if (channel.port != "state") == is_force
                and (is_delay or channel.place == unknown.entry)
            ]
            if not own:
                raise ModelError(f"the records do not measure what '{unknown.name}' belongs to")
            (delays if is_delay else biases)[own] = number
        return biases, delays

    def start(self, nominal: FloatArray, channels: Sequence[Channel]) -> FloatArray:
        """The initial guess: the plant's parameter values, and the biases of the sensors."""
        biases, _ = self.of_sensors(channels)
        sensed = np.zeros(self.num_sensed)
        for channel, bias in zip(channels, biases.tolist(), strict=True):
            if bias >= 0:
                sensed[bias] = channel.bias
        return np.concatenate([nominal, sensed])


def named_entries(
    name: str, available: Mapping[str, Sequence[Number]], kind: str
) -> Sequence[Number]:
    """Returns all entries of a parameter, or the entry of a name such as "wall.position[0]".

    Args:
        name: The name.
        available: Name of a parameter -> its entries.
        kind: The kind of parameter, for messages.

    Raises:
        ModelError: There is no such parameter or entry.
    """
    if name in available:
        return available[name]
    match = _ENTRY.fullmatch(name)
    if match is None or match[1] not in available:
        raise ModelError(unknown_name(kind, name, available))
    parameter, entry = match.groups()
    entries = available[parameter]
    if len(entries) == 1:
        raise ModelError(f"'{parameter}' is one number: name it without [{entry}]")
    # By its name and not by its place: the biases of positions leave out velocities.
    chosen = [number for number in entries if number.name == name]
    if not chosen:
        raise ModelError(
            f"'{parameter}' has {len(entries)} entries, counted from 0, and no entry {entry}"
        )
    return chosen


def model_parameters(system: Any) -> Iterator[tuple[Parameter, int]]:
    """The named parameters of a plant or law, with the index of their first entries."""
    if (dae := getattr(system, "dae", None)) is not None:
        for parameter in dae.parameters:
            yield parameter, dae.parameter_slice(parameter.name).start
    for name, (signal, place) in getattr(system, "further_parameters", {}).items():
        positive = name in ("plant.stiffness", "plant.radius")
        yield Parameter(name, np.ones(1), signal.unit, positive, nonnegative=not positive), place


def _all(loop: ClosedLoop) -> list[Unknown]:
    """All numbers that can be identified."""
    numbers, plant = [], loop.plant
    for parameter, first in model_parameters(plant):
        lowest = 0.0 if parameter.positive or parameter.nonnegative else None
        for entry, name in enumerate(_names(parameter.name, parameter.value.size)):
            numbers.append(
                Unknown(
                    name,
                    parameter.name,
                    entry,
                    parameter.unit,
                    lowest,
                    first + entry,
                    parameter.positive,
                )
            )
    for name, signals in (
        (FORCE_BIAS, plant.dae.constraint_input_signals),
        (POSITION_BIAS, plant.dae.state_signals),
    ):
        entries = zip(_names(name, len(signals)), signals, strict=True)
        numbers += [
            Unknown(label, name, entry, signal.unit)
            for entry, (label, signal) in enumerate(entries)
            if name == FORCE_BIAS or is_position(signal)
        ]
    return numbers + [Unknown(name, name, 0, "s") for name in (FORCE_DELAY, POSITION_DELAY)]


def _names(name: str, count: int) -> list[str]:
    return [name] if count == 1 else [f"{name}[{entry}]" for entry in range(count)]
