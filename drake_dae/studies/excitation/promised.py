"""What a run of a scenario would determine of its plant, before it is made on a robot."""

import json
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydrake.systems.framework import Context

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.diagrams.clearances import links_in_the_way
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import DrakeDaeError, ModelError
from drake_dae.scenario.rolled import roll_scenario
from drake_dae.scenario.scenario import Scenario, read_scenario, scenario_data
from drake_dae.scenario.start import start_scenario
from drake_dae.simulation.records.record import Record
from drake_dae.simulation.summary import Limits, shortfalls
from drake_dae.studies.identification.channels import Channel
from drake_dae.studies.identification.driven import DrivenPlant
from drake_dae.studies.identification.fit import ParameterFit
from drake_dae.studies.identification.identified import (
    NORMAL,
    known_covariance,
    undetermined_names,
)
from drake_dae.studies.identification.identify import pieces_of, stated_noise
from drake_dae.studies.identification.measured import measured_ports
from drake_dae.studies.identification.unknowns import Unknown, Unknowns
from drake_dae.studies.runs import Runner
from drake_dae.studies.structures import study_data

LEAST = 1e-24
"""The least information about a direction of the unknowns over their sizes: with less it counts as
this, so that designs without any information can be compared."""

Criterion = Literal["D", "A"]
"""What is to be small: the volume of the ellipsoid of relative errors, or their sum of squares."""

_FREE_OF_PLANT = ("description", "duration", "references", "tolerances", "write")
"""Keys of a scenario that change nothing in its plant and sensors."""


@checked(ModelError)
@dataclass(frozen=True, eq=False)
class Promised:
    """What a record would say of parameters.

    Attributes:
        unknowns: The parameters.
        values: Their values in the run, shape (p,).
        covariance: F^-1 of their Fisher information F, shape (p, p); nan for what is not
            determined.
        undetermined: The parameters of each combination that is not determined.
        strengths: The eigenvalues of S F S with the sizes S of the parameters, shape (p,).
    """

    unknowns: tuple[Unknown, ...]
    values: FloatArray
    covariance: FloatArray
    undetermined: tuple[tuple[str, ...], ...]
    strengths: FloatArray

    def __post_init__(self) -> None:
        p = len(self.unknowns)
        sizes = {"values": (p,), "covariance": (p, p), "strengths": (p,)}
        for name, shape in sizes.items():
            if np.shape(getattr(self, name)) != shape:
                raise ModelError(
                    f"{name} of {p} parameters must have shape {shape}, got "
                    f"{np.shape(getattr(self, name))}"
                )

    @property
    def deviations(self) -> FloatArray:
        """The standard deviations, nan for what is not determined, shape (p,)."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def halves(self) -> FloatArray:
        """Half the lengths of the intervals of 95 %, shape (p,)."""
        return NORMAL * self.deviations

    @property
    def d_size(self) -> float:
        """det(C)^(1 / 2p) of the covariance C of the parameters over their sizes.

        It is the geometric mean of the deviations along the axes of the ellipsoid.
        """
        return float(np.exp(-0.5 * np.mean(np.log(self.strengths))))

    @property
    def a_size(self) -> float:
        """(tr(C) / p)^(1/2): the root mean square of the deviations over the sizes."""
        return float(np.sqrt(np.mean(1.0 / self.strengths)))

    def size(self, criterion: Criterion) -> float:
        """The number that is to be small, by the name of a criterion."""
        return self.d_size if criterion == "D" else self.a_size


@dataclass(frozen=True, eq=False)
class ScenarioRun:
    """A run of a scenario with some values.

    Attributes:
        problems: Kind -> what is wrong with the run, in words; empty if it is good.
        promised: What it would determine; None if it does not come to its end, or is not good and
            nobody asked.
    """

    problems: Mapping[str, str]
    promised: Promised | None = None


class ScenarioRuns:
    """Runs of a scenario with other values at some keys, by rollout.

    Args:
        scenario: The scenario; its plant has the values that the parameters are expected to have.
        free: As of `identify`.
        noise: "position" or "force" -> its deviation, in place of what sensors state.
    """

    def __init__(self, scenario: Scenario, free: Sequence[str], noise: Mapping[str, float]) -> None:
        self._base, self._free, self._noise = scenario_data(scenario), free, noise
        self._runner = Runner(self._base, scenario.duration)
        self._key, self._known = "", dict[str, tuple[DrivenPlant, Unknowns]]()

    def check(self, changes: Mapping[str, Any]) -> None:
        """Reads the scenario with some values.

        Raises:
            ScenarioError: There is no such key, or it cannot have this value.
        """
        read_scenario(study_data(self._base, dict(changes), True))

    def run(self, changes: Mapping[str, Any], judge_all: bool = False) -> ScenarioRun:
        """Runs the scenario with some values.

        Args:
            changes: Dotted key -> value.
            judge_all: Whether the information of a run with problems is of interest.

        Raises:
            ModelError: With `judge_all` alone: a parameter is not one, or the noise of a
                measurement is not stated.
        """
        try:
            data = study_data(self._base, dict(changes), True)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # Each run would report the same.
                scenario, loop = read_scenario(data), self._runner.loop(data)
                context = start_scenario(scenario, loop)
                found = roll_scenario(scenario, loop, context)
        except DrakeDaeError as error:
            return ScenarioRun({"does not start": str(error)})
        if found.failure is not None:
            return ScenarioRun({"ends early": str(found.failure)})
        problems = _problems(loop, found.record, context)
        if problems and not judge_all:
            return ScenarioRun(problems)
        try:
            return ScenarioRun(problems, self._promised(data, loop, context, found.record))
        except (ModelError, np.linalg.LinAlgError) as error:
            if judge_all and isinstance(error, ModelError):
                raise
            return ScenarioRun({"has no finite information": str(error)})

    def _promised(
        self, data: Mapping[str, Any], loop: ClosedLoop, context: Context, record: Record
    ) -> Promised:
        driven, unknowns = self._driven(data, loop, context)
        pieces = pieces_of(record, driven, unknowns, "the run")
        channels = pieces.data.channels
        values = unknowns.start(driven.nominal, channels)
        sizes, p = np.where(values != 0.0, np.abs(values), 1.0), values.size
        noise = np.array([self._deviation(loop, channel) for channel in channels])
        fitted = ParameterFit(
            [pieces], values, sizes, np.full(p, -np.inf), np.zeros(p, bool)
        ).known([noise])
        information = fitted.information[:, :, :p].sum(axis=0)
        parts = fitted.determined, fitted.undetermined
        strengths = np.linalg.eigvalsh(sizes[:, None] * information * sizes)
        return Promised(
            unknowns.all,
            values,
            known_covariance(information, *parts, sizes),
            undetermined_names(fitted.undetermined, [one.name for one in unknowns.all]),
            np.maximum(strengths, LEAST),
        )

    def _driven(
        self, data: Mapping[str, Any], loop: ClosedLoop, context: Context
    ) -> tuple[DrivenPlant, Unknowns]:
        """The plant alone, which is traced again only where it is another one."""
        own = {key: value for key, value in data.items() if key not in _FREE_OF_PLANT}
        key = json.dumps(own, sort_keys=True)
        if key not in self._known:
            unknowns = Unknowns.of(loop, self._free)
            driven = DrivenPlant(loop, context, measured_ports(loop), unknowns.places)
            self._known = {key: (driven, unknowns)}
        return self._known[key]

    def _deviation(self, loop: ClosedLoop, channel: Channel) -> float:
        """The deviation of a measured column."""
        kind = "position" if channel.port == "state" else "force"
        found = self._noise.get(kind) or stated_noise(loop, channel)
        if not found:
            raise ModelError(
                f"the scenario states no noise of '{channel.name}', without which no interval can "
                f"be promised; state it, as noise {kind}=0.001, or give the scenario a sensor with "
                "noise"
            )
        return found


def _problems(loop: ClosedLoop, record: Record, context: Context) -> dict[str, str]:
    """What a run violates: limits of joints and drives, contacts, and the clearance of links."""
    found, limits = dict[str, str](), Limits.of(loop.plant.robot("an excitation"))
    if texts := shortfalls(record, limits):
        found["exceeds a limit"] = "; ".join(texts)
    forces = record.signals["constraint_force"]
    for signal, values in zip(forces.signals, forces.values.T, strict=True):
        touches = np.flatnonzero(values > 0.0)
        if limits.can_pull(signal):
            continue
        # The last row of a discrete plant may lack the force.
        if not touches.size or (values[touches[0] : -1] == 0.0).any():
            found["opens a contact"] = f"{signal.name} is zero"
    if ways := links_in_the_way(loop, record, context):
        found["has a link in the way"] = "; ".join(map(str, ways))
    return found
