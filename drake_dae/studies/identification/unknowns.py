"""The parameters that an identification is asked for, by name."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.studies.identification.channels import Channel

FORCE_BIAS, POSITION_BIAS = "force.bias", "position.bias"
"""What sensors add to forces and to positions."""

FORCE_DELAY, POSITION_DELAY = "force.delay", "position.delay"
"""By how much later forces and positions are measured, in s: the same for all of them."""

_ENTRY = re.compile(r"(.+)\[(\d+)\]")


@checked(ModelError)
@dataclass(frozen=True)
class Unknown:
    """A number that is asked for.

    Attributes:
        name: The name of the parameter, with its entry if it has several.
        parameter: The name without the entry.
        entry: The entry.
        unit: Its unit.
        lowest: Its lower bound; None for none.
        strict: Whether it must stay above its bound, as a mass.
        place: Its place in numeric parameter 0 of the plant; -1 for one of a sensor.
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
    """All numbers that are asked for, those of the plant first.

    Attributes:
        all: The numbers.
    """

    all: tuple[Unknown, ...]

    @classmethod
    def of(cls, loop: ClosedLoop, free: Sequence[str]) -> Self:
        """By the names of parameters.

        Args:
            loop: The loop.
            free: Names of the plant's parameters, "link1.mass"; entries, "wall.position[0]"; and
                FORCE_BIAS, POSITION_BIAS, FORCE_DELAY and POSITION_DELAY.

        Raises:
            ModelError: There is no such parameter or entry, it is named twice, or it moves.
        """
        if isinstance(free, str) or not free:
            raise ModelError(f"free must be a list of names of parameters, got {free!r}")
        known = {one.name: one for one in _all(loop)}
        names = dict[str, list[Unknown]]()
        for one in known.values():
            names.setdefault(one.parameter, []).append(one)
        found: list[Unknown] = []
        for name in free:
            entries = [known[name]] if name in known else names.get(name)
            if entries is None:
                match = _ENTRY.fullmatch(name)
                if match and match[1] in names:
                    raise ModelError(
                        f"'{match[1]}' has {len(names[match[1]])} entries, counted from 0, and "
                        f"no entry {match[2]}"
                    )
                raise ModelError(unknown_name("parameter to identify", name, names))
            found += entries
        doubles = {one.name for one in found if found.count(one) > 1}
        if doubles:
            raise ModelError(f"'{min(doubles)}' is named twice in free")
        plant = loop.plant
        moving = {
            one.name for one in found if one.place in plant.exogenous_places and one.place >= 0
        }
        if moving:
            raise ModelError(
                f"'{min(moving)}' is an exogenous signal, which moves as its references say; only "
                "constants are identified"
            )
        return cls(tuple(sorted(found, key=lambda one: one.place < 0)))

    @property
    def places(self) -> list[int]:
        """The places of those of the plant."""
        return [one.place for one in self.all if one.place >= 0]

    @property
    def num_sensed(self) -> int:
        """How many of them are of sensors; they come last."""
        return len(self.all) - len(self.places)

    def of_sensors(self, channels: Sequence[Channel]) -> tuple[np.ndarray, np.ndarray]:
        """For each measured column the bias and the delay that it has, counted from 0; -1 for none.

        Raises:
            ModelError: One is asked for of what is not measured.
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
        """The values to begin with: those of the plant, and the known biases."""
        biases, _ = self.of_sensors(channels)
        sensed = np.zeros(self.num_sensed)
        for channel, bias in zip(channels, biases.tolist(), strict=True):
            if bias >= 0:
                sensed[bias] = channel.bias
        return np.concatenate([nominal, sensed])


def _all(loop: ClosedLoop) -> list[Unknown]:
    """All numbers that can be asked for."""
    found, plant = [], loop.plant
    for parameter in plant.dae.parameters:
        first = plant.dae.parameter_slice(parameter.name).start
        lowest = 0.0 if parameter.positive or parameter.nonnegative else None
        found += [
            Unknown(
                name,
                parameter.name,
                entry,
                parameter.unit,
                lowest,
                first + entry,
                parameter.positive,
            )
            for entry, name in enumerate(_names(parameter.name, parameter.value.size))
        ]
    for name, (signal, place) in plant.further_parameters.items():
        positive = name in ("plant.stiffness", "plant.radius")
        found.append(Unknown(name, name, 0, signal.unit, 0.0, place, positive))
    for name, signals in (
        (FORCE_BIAS, plant.dae.constraint_input_signals),
        (POSITION_BIAS, plant.dae.state_signals),
    ):
        found += [
            Unknown(own, name, entry, signal.unit)
            for entry, (own, signal) in enumerate(
                zip(_names(name, len(signals)), signals, strict=True)
            )
            if name == FORCE_BIAS or "/s" not in signal.unit
        ]
    found += [Unknown(name, name, 0, "s") for name in (FORCE_DELAY, POSITION_DELAY)]
    return found


def _names(name: str, count: int) -> list[str]:
    return [name] if count == 1 else [f"{name}[{entry}]" for entry in range(count)]
