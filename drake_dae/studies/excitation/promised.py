"""Predicted uncertainty of identified parameters, before a run is made on a robot."""

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
    check_shapes,
    fisher_covariance,
    undetermined_names,
)
from drake_dae.studies.identification.identify import pieces_of, stated_noise
from drake_dae.studies.identification.measured import measured_ports
from drake_dae.studies.identification.unknowns import Unknown, Unknowns
from drake_dae.studies.runs import Runner
from drake_dae.studies.structures import study_data

LEAST = 1e-24
"""The lower bound of eigenvalues of the relative information, so that designs without information
in some direction can be compared."""

Criterion = Literal["D", "A"]
"""The minimized quantity: the volume of the ellipsoid of relative errors, or their sum of
squares."""

_FREE_OF_PLANT = ("description", "duration", "references", "tolerances", "write")
"""Keys of a scenario without effect on its plant and sensors."""


@checked(ModelError)
@dataclass(frozen=True, eq=False)
class Promised:
    """The predicted uncertainty of parameters that would be identified from a record.

    Attributes:
        unknowns: The parameters.
        values: Their values in the run, shape (p,).
        covariance: The inverse of their Fisher information F, shape (p, p); nan for undetermined
            parameters.
        undetermined: The parameters of each combination that is not determined.
        strengths: The eigenvalues of S F S with the diagonal matrix S of the parameters' sizes,
            shape (p,).
    """

    unknowns: tuple[Unknown, ...]
    values: FloatArray
    covariance: FloatArray
    undetermined: tuple[tuple[str, ...], ...]
    strengths: FloatArray

    def __post_init__(self) -> None:
        check_shapes(self, len(self.unknowns), values=1, covariance=2, strengths=1)

    @property
    def deviations(self) -> FloatArray:
        """The standard deviations, shape (p,); nan for undetermined parameters."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def halves(self) -> FloatArray:
        """Half the lengths of the intervals of 95 %, shape (p,)."""
        return NORMAL * self.deviations

    @property
    def d_size(self) -> float:
        """det(C)^(1 / 2p) with the covariance C of parameters / sizes.

        This is the geometric mean of the deviations along the axes of the ellipsoid.
        """
        return float(np.exp(-0.5 * np.mean(np.log(self.strengths))))

    @property
    def a_size(self) -> float:
        """(tr(C) / p)^(1/2), the root mean square of deviations / sizes."""
        return float(np.sqrt(np.mean(1.0 / self.strengths)))

    def size(self, criterion: Criterion) -> float:
        """The value of a criterion: `d_size` or `a_size`."""
        return self.d_size if criterion == "D" else self.a_size


@dataclass(frozen=True, eq=False)
class ScenarioRun:
    """The result of a run of a scenario.

    Attributes:
        problems: Kind of problem -> its description; empty for a run that keeps all limits.
        promised: The predicted uncertainty; None if the run fails, or if it has problems and
            `judge_all` is false.
    """

    problems: Mapping[str, str]
    promised: Promised | None = None


class ScenarioRuns:
    """Rollouts of a scenario with other values of some keys.

    Args:
        scenario: The scenario; its plant has the expected values of the parameters.
        free: The names of the parameters, as in `identify`.
        noise: "position" or "force" -> standard deviation, instead of the sensors' settings.
    """

    def __init__(self, scenario: Scenario, free: Sequence[str], noise: Mapping[str, float]) -> None:
        self._base, self._free, self._noise = scenario_data(scenario), free, noise
        self._runner = Runner(self._base, scenario.duration)
        self._plants = dict[str, tuple[DrivenPlant, Unknowns]]()

    def check(self, changes: Mapping[str, Any]) -> None:
        """Checks keys and values.

        Raises:
            ScenarioError: There is no such key, or it does not accept the value.
        """
        read_scenario(study_data(self._base, dict(changes), True))

    def run(self, changes: Mapping[str, Any], judge_all: bool = False) -> ScenarioRun:
        """Runs the scenario with changed values.

        Args:
            changes: Dotted key -> value.
            judge_all: Whether the information of a run with problems is computed, too.

        Raises:
            ModelError: `judge_all` is true, and a name is no parameter, or the noise of a
                measurement is unknown.
        """
        try:
            data = study_data(self._base, dict(changes), True)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # Each run would report the same.
                scenario, loop = read_scenario(data), self._runner.loop(data)
                context = start_scenario(scenario, loop)
                rollout = roll_scenario(scenario, loop, context)
        except DrakeDaeError as error:
            return ScenarioRun({"does not start": str(error)})
        if rollout.failure is not None:
            return ScenarioRun({"ends early": str(rollout.failure)})
        problems = _problems(loop, rollout.record, context)
        if problems and not judge_all:
            return ScenarioRun(problems)
        try:
            return ScenarioRun(problems, self._promised(data, loop, context, rollout.record))
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
        ).at_start([noise])
        information = fitted.information[:, :, :p].sum(axis=0)
        strengths = np.linalg.eigvalsh(sizes[:, None] * information * sizes)
        return Promised(
            unknowns.all,
            values,
            fisher_covariance(fitted, sizes),
            undetermined_names(fitted, unknowns.all),
            np.maximum(strengths, LEAST),
        )

    def _driven(
        self, data: Mapping[str, Any], loop: ClosedLoop, context: Context
    ) -> tuple[DrivenPlant, Unknowns]:
        """The plant and its unknowns; a plant with equal data is not traced again."""
        of_plant = {key: value for key, value in data.items() if key not in _FREE_OF_PLANT}
        key = json.dumps(of_plant, sort_keys=True)
        if key not in self._plants:
            unknowns = Unknowns.of(loop, self._free)
            driven = DrivenPlant(loop, context, measured_ports(loop), unknowns.places)
            self._plants = {key: (driven, unknowns)}
        return self._plants[key]

    def _deviation(self, loop: ClosedLoop, channel: Channel) -> float:
        """The standard deviation of a measured column."""
        kind = "position" if channel.port == "state" else "force"
        deviation = self._noise.get(kind) or stated_noise(loop, channel)
        if not deviation:
            raise ModelError(
                f"the scenario states no noise of '{channel.name}', without which no interval can "
                f"be promised; state it, as noise {kind}=0.001, or give the scenario a sensor with "
                "noise"
            )
        return deviation


def _problems(loop: ClosedLoop, record: Record, context: Context) -> dict[str, str]:
    """The violated limits, lost contacts and collisions of a run: kind -> description."""
    problems, limits = dict[str, str](), Limits.of(loop.plant.robot("an excitation"))
    if texts := shortfalls(record, limits):
        problems["exceeds a limit"] = "; ".join(texts)
    forces = record.signals["constraint_force"]
    for signal, values in zip(forces.signals, forces.values.T, strict=True):
        if limits.can_pull(signal):
            continue
        in_contact = np.flatnonzero(values > 0.0)
        # The last row of a discrete plant may lack the force.
        if not in_contact.size or (values[in_contact[0] : -1] == 0.0).any():
            problems["opens a contact"] = f"{signal.name} is zero"
    if ways := links_in_the_way(loop, record, context):
        problems["has a link in the way"] = "; ".join(map(str, ways))
    return problems
