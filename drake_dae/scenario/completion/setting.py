"""The constraints and outputs of a scenario whose outputs or start are completed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Self

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.robots.constraints import Constraint
from drake_dae.robots.constraints.constraint_set import ConstraintSet
from drake_dae.robots.force_outputs import force_outputs, force_rows
from drake_dae.robots.links.links import Links
from drake_dae.robots.outputs import PositionOutput
from drake_dae.scenario.completion.candidates import Candidates
from drake_dae.scenario.completion.postures import Postures
from drake_dae.scenario.completion.referred import value_at
from drake_dae.scenario.forms.keys import at
from drake_dae.scenario.parts.written import make
from drake_dae.scenario.scenario import Scenario


@dataclass(frozen=True, eq=False)
class Setting:
    """The constraints and outputs of a scenario.

    Attributes:
        bound: The constraints.
        outputs: The outputs of positions.
        names: The names of their rows.
        forces: The names of the force outputs.
        S: The rows of the force outputs, shape (s, m).
        missing: The number of actuators minus that of outputs.
    """

    bound: ConstraintSet
    outputs: Sequence[PositionOutput]
    names: Sequence[str]
    forces: Sequence[str]
    S: ca.SX
    missing: int

    @classmethod
    def of(
        cls,
        scenario: Scenario,
        links: Links,
        constraints: Sequence[Constraint],
        of_plant: Sequence[Constraint],
    ) -> Self:
        """The constraints and outputs; for arguments see `complete`."""
        bound = ConstraintSet([*constraints, *of_plant])
        outputs = [make(form, constraints) for form in scenario.outputs]
        names = [signal.name for output in outputs for signal in output.signals(links)]
        steered = force_outputs(scenario.forces, bound)
        forces = [signal.name for output in steered for signal in output.signals(bound)]
        S = force_rows(steered, bound, links)
        actuators = len(links.actuator_signals) + len(bound.motors)
        missing = actuators - len(names) - int(S.shape[0])
        return cls(bound, outputs, names, forces, S, missing)

    def candidates(self, scenario: Scenario, links: Links) -> Candidates:
        """The rows that may be outputs."""
        return Candidates(scenario, links, self.outputs, self.bound)

    def postures(
        self,
        scenario: Scenario,
        links: Links,
        candidates: Candidates,
        moved: Mapping[str, FloatArray] = MappingProxyType({}),
    ) -> Postures:
        """The configurations of the robot, with some parameters moved."""
        rows, outward = candidates.expression, candidates.outward
        with at("plant.parameters or exogenous"):
            values = {**_parameters(scenario), **moved}
            return Postures(links, self.bound, rows, self.S, outward, values)


def _parameters(scenario: Scenario) -> dict[str, FloatArray]:
    """Parameter name -> value at the start, for the parameters that differ from their defaults."""
    begin = scenario.integrator.start_time
    values = {name: np.atleast_1d(value) for name, value in scenario.plant.parameters.items()}
    for name, references in scenario.exogenous.items():
        entries = [value_at(r, getattr(r, "size", 1), begin) for r in references]
        values[name] = np.concatenate([np.zeros(0), *entries])
    return values
