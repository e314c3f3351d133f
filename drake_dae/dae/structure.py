"""The structure of a system: relative degrees, index, N*, Assumptions (1)-(5) with margins."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TypeVar

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import Booleans, FloatArray, check_whole_number, show
from drake_dae.dae.assumptions import (
    Combination,
    Violation,
    ViolationKind,
    combinations_of,
    find_dependence,
    redundant_constraints,
)
from drake_dae.dae.derivatives import Derivatives, Elimination, eliminate
from drake_dae.dae.manifold import Manifold
from drake_dae.dae.margins import RankMargin, find_margin
from drake_dae.dae.redundancy import all_constraints_hold
from drake_dae.dae.relative_degrees import InputActions, constraint_chains, output_chains
from drake_dae.dae.samples import Family, Samples, draw
from drake_dae.dae.signals import DerivativeLayout, Signal
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import AssumptionError, InconsistentStateError, ModelError
from drake_dae.trace.factorization import Factorization, nearest_solution
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.numerics import equilibrated, equilibration, positive, smallest_singular_value

Kind = TypeVar("Kind", bound="ConstraintStructure")

PART = 0.1  # The least part of a constraint in a vanishing combination, relative to the largest.


@checked(ModelError)
@dataclass(frozen=True, eq=False, repr=False)
class ConstraintStructure:
    """The structure of the constraints of a system, by Assumptions (1)-(3)."""

    system: DaeSystem
    constraint_degrees: tuple[int, ...]  # r_1, ..., r_m
    manifold: Manifold  # N* (4)
    derivatives: Derivatives  # Along the motion on N*.
    elimination: Elimination  # (9)-(14)
    states: FloatArray  # The consistent states at which numbers were decided, (samples, n).
    scale: FloatArray  # The size of each state over them and their guesses, (n,).
    constraint_margin: RankMargin | None  # Of A(x) without friction, Assumption (2).

    def __repr__(self) -> str:
        degrees = f"r={self.constraint_degrees}, index={self.index}"
        return f"ConstraintStructure({self.system.name!r}, {degrees})"

    @property
    def index(self) -> int:
        """max r_i + 1, the index of the DAE; 0 without constraints."""
        return max(self.constraint_degrees) + 1 if self.constraint_degrees else 0

    def constraint_matrix(
        self, state: ArrayLike, parameters: ArrayLike | None = None
    ) -> FloatArray:
        """Returns A(x) at a state, shape (m, m): for one contact its mobility in 1/kg."""
        return self._matrix(
            self.system.state_vector(state), self.system.parameter_vector(parameters)
        )

    @cached_property
    def _matrix(self) -> Callable[[FloatArray, FloatArray], FloatArray]:
        return self.system.matrix("A(x)", self.elimination.constraint_matrix)

    def dependent_constraints(self, state: FloatArray, parameters: FloatArray) -> tuple[str, ...]:
        """Returns the names of the constraints that become dependent where A(x) is singular."""
        usual = [np.diag(self._matrix(x, parameters)) for x in self.states]
        unit = 1.0 / np.sqrt(positive(np.median(np.abs(usual), axis=0)))
        matrix = self._matrix(state, parameters) * unit * unit[:, None]
        if not np.isfinite(matrix).all():
            return ()
        part = np.abs(np.linalg.svd(matrix)[0][:, -1])
        signals = self.system.constraint_output_signals
        return tuple(signals[i].name for i in np.flatnonzero(part > PART * part.max()))

    def trace(self, name: str, value: ca.SX, needs_control: bool) -> TracedFunction:
        """Compiles an expression of state and `derivatives.control` on N*, or with control 0."""
        control = self.derivatives.control
        inputs = {"control": control}
        if not needs_control:
            value = ca.substitute(value, inputs.pop("control"), ca.SX.zeros(control.numel()))
        pivot = self.elimination.pivot
        outputs, regular = {"value": value}, "A(x) of Assumption (2)"
        return self.system.trace(name, outputs, inputs, pivot, regular)


@checked(ModelError)
@dataclass(frozen=True, eq=False, repr=False)
class Structure(ConstraintStructure):
    """The structure of one system by Assumptions (1)-(5): relative degrees, A(x), B(x), margins."""

    output_degrees: tuple[int, ...]  # mu_i; 0 where the control enters the output at once.
    output_chains: tuple[tuple[ca.SX, ...], ...]  # l*_i, ..., L_f*^(mu_i - 1) l*_i
    highest_derivatives: ca.SX  # z_i^(mu_i) in terms of the unknowns of `derivatives`, (p, 1).
    drift: ca.SX  # a(x) of (28), L_f*^mu_i l*_i, (p, 1).
    control_matrix: ca.SX  # B(x) of (16), (p, p); wider with a `control_metric`.
    chains_need_force: bool  # Whether the chains hold alpha (13), so that A(x) must be regular.
    round_off: Booleans  # The entries of B(x) that are only round-off at all sampled states.
    control_margin: RankMargin  # Of B(x), Assumption (5).

    def __repr__(self) -> str:
        degrees = f"r={self.constraint_degrees}, mu={self.output_degrees}"
        return f"Structure({self.system.name!r}, {degrees}, index={self.index})"

    @cached_property
    def layout(self) -> DerivativeLayout:
        """The layout of reference vectors and output chains."""
        return DerivativeLayout(self.output_degrees)

    @property
    def output_order(self) -> tuple[int, ...]:
        """The outputs in the paper's order (15): those with mu_i >= 1 first."""
        return (*map(int, self.layout.dynamic), *map(int, self.layout.direct))  # (15)

    @property
    def zero_dynamics_dimension(self) -> int:
        """The dimension of xi in (22), n - sum r_i - sum mu_i."""
        return self.manifold.dimension - self.layout.chain_size

    @property
    def chain(self) -> ca.SX:
        """The output chains in one column, in the order of `layout`, shape (sum mu_i, 1)."""
        return ca.vertcat(ca.SX(0, 1), *[e for chain in self.output_chains for e in chain])

    def control_for(self, commanded: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Returns u = B(x)^-1 (-a(x) + ubar) (28), and a scalar that is 0 where it is undetermined.

        If B(x) does not determine u, `DaeSystem.control_metric` chooses it.
        """
        chosen = self.system.control_metric is not None
        solution = None if chosen else self.derivatives.inverse(self.highest_derivatives, commanded)
        # L_h* of an output may vanish, but not by structure.
        control, pivot, *_ = solution or self.control_by_matrix(commanded)  # (28)
        if self.chains_need_force:
            pivot = ca.fmin(pivot, self.elimination.pivot)
        return control, pivot

    def control_by_matrix(self, commanded: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Returns the control of `control_for`, computed with B(x); A(x) must be regular."""
        needed, metric = commanded - self.drift, self.system.control_metric  # (28)
        if metric is not None:
            return nearest_solution(self.control_matrix, needed, metric, self.system.free_control)
        factors = Factorization(self.control_matrix)
        return factors.solve(needed), factors.pivot


@checked(ModelError)
def find_constraint_structure(
    system: DaeSystem, *, spread: ArrayLike | None = None, count: int = 12, seed: int = 0
) -> ConstraintStructure:
    """Finds r_1, ..., r_m and A(x), and checks Assumptions (1)-(3)."""
    structure, samples = _sound_constraints(system, spread, count, seed)
    # Rows of n* that are only round-off are no feedthrough.
    actions = InputActions(samples, structure.elimination)
    acts = np.asarray(actions.numbers(actions.feedthrough).any(axis=(0, 2)))
    return replace(structure, elimination=_with_feedthrough(structure.elimination, acts))


@checked(ModelError)
def find_structure(
    system: DaeSystem, *, spread: ArrayLike | None = None, count: int = 12, seed: int = 0
) -> Structure:
    """Finds relative degrees, A(x), B(x) and checks Assumptions (1)-(5).

    Whether an expression is zero is decided by its structure first, then by its numbers at
    consistent states drawn around `system.nominal_state`, with the default parameters and exogenous
    signals at rest. What is zero there must be zero for all other values of parameters, signals and
    their derivatives, see `Parameter.bounds`; otherwise the system is refused.

    Args:
        system: The system (1)-(3).
        spread: The standard deviation of the drawn states around the nominal one, a number for all
            or shape (n,); `DaeSystem.spread_around` it if None.
        count: The number of random states, at least 1.
        seed: The seed of the random numbers.

    Raises:
        AssumptionError: An assumption is violated; the exception has the state where.
        InconsistentStateError: There is no consistent state near the nominal one.
        ModelError: The outputs are not as many as the controls (or fewer, with a metric), a
            function is not finite at the nominal state, or the mass matrix or the metric is not
            symmetric and positive definite.
    """
    structure = examine_structure(system, spread=spread, count=count, seed=seed)
    if violation := control_violation(structure):
        raise violation.error()
    return structure


def examine_structure(
    system: DaeSystem, *, spread: ArrayLike | None = None, count: int = 12, seed: int = 0
) -> Structure:
    """Finds the structure as `find_structure`, also where B(x) is singular."""
    if why := why_no_law(system):
        raise ModelError(f"{system.name}: {why}. `DaePlant` simulates it without these")
    return examine_outputs(*_sound_constraints(system, spread, count, seed))


def structure_of(
    system: DaeSystem, structure: Kind | None, find: Callable[[DaeSystem], Kind]
) -> Kind:
    """Returns the given structure of a system, or what `find` finds."""
    if structure is None:
        return find(system)
    if structure.system is not system:
        raise ModelError(
            f"the structure is that of another system, '{structure.system.name}' and not "
            f"'{system.name}'. Omit it, or pass the structure of this system"
        )
    return structure


def why_no_law(system: DaeSystem) -> str:
    """Returns why a system has no law (28) by its numbers of inputs and outputs, else ""."""
    p, q = system.num_controls, system.num_outputs
    if p == 0:
        return "there is no control input, so no output can be controlled"
    if 0 < q == p or (0 < q < p and system.control_metric is not None):
        return ""
    least = ", or a `control_metric` in which it takes the least control" if 0 < q < p else ""
    return (
        f"there are {q} controlled outputs and {p} controls; the law (28) inverts B(x), so it "
        f"needs as many outputs as controls{least}"
    )


def _sound_constraints(
    system: DaeSystem, spread: ArrayLike | None, count: int, seed: int
) -> tuple[ConstraintStructure, Samples]:
    """The structure of the constraints, which fulfil Assumptions (1)-(3), and its samples."""
    check_system(system)
    check_whole_number(f"{system.name}: count", count, 1)
    check_whole_number(f"{system.name}: seed", seed, 0)
    structure, samples = examine_constraints(system, draw(system, spread, count, seed))
    if violation := constraint_violation(structure):
        raise violation.error()
    return structure, samples


def check_system(system: DaeSystem) -> None:
    """Checks the number of constraints and the mass matrix of a system."""
    _check_positive_definite(system, "mass_matrix", system.nominal_state[None])
    if system.num_constraints > system.num_states:
        names = tuple(signal.name for signal in system.constraint_output_signals)
        raise Violation(2, ViolationKind.COUNT, names).error()


def _check_positive_definite(system: DaeSystem, key: str, states: FloatArray) -> None:
    """Checks E of E x' = f + g v + h u, since LDL^T reads only one triangle of it, or W."""
    matrix = system.matrix(key, getattr(system, key))
    for state in states:
        value = matrix(state, system.parameter_values)
        length = np.sqrt(np.abs(np.diag(value)))
        if np.all(np.isfinite(value)) and np.all(length > 0.0):
            scaled = value / length / length[:, None]  # Independent of units.
            is_symmetric = np.allclose(scaled, scaled.T, rtol=0.0, atol=1e-9)
            if is_symmetric and np.linalg.eigvalsh(scaled)[0] > 1e-12:
                continue
        remedy = (
            "An equation in which no derivative stands is a constraint 0 = k(x); make an unknown z "
            "in it, which has no derivative, a state with z' = v, v a new constraint input"
        )
        if key == "control_metric":
            remedy = "Give each control a positive weight"
        raise ModelError(
            f"{system.name}: {key} is not symmetric and positive definite at x = {show(state)}. "
            f"{remedy}"
        )


def examine_constraints(
    system: DaeSystem, guesses: FloatArray
) -> tuple[ConstraintStructure, Samples]:
    """Finds r_1, ..., r_m and A(x) of a system that `check_system` accepts."""
    try:
        chains, samples = constraint_chains(system, guesses)
    except AssumptionError as error:
        if error.violation is not None:
            raise _as_redundant(system, error.violation).error() from None
        raise
    _check_positive_definite(system, "mass_matrix", samples.states)
    derivatives = Derivatives(system, ca.vertcat(ca.SX(0, 1), *[chain[-1] for chain in chains]))
    elimination = eliminate(derivatives)
    # Friction can change the sign of A(x); the Painleve paradox is tested along motions.
    matrix = system.frictional_contacts.without_friction(elimination.constraint_matrix)
    structure = ConstraintStructure(
        system,
        tuple(len(chain) for chain in chains),
        samples.manifold,
        derivatives,
        elimination,
        samples.states,
        samples.scale,
        find_margin(samples, matrix) if chains else None,
    )
    return structure, samples


def examine_outputs(constrained: ConstraintStructure, samples: Samples) -> Structure:
    """Finds mu_1, ..., mu_p and B(x) if A(x) is regular."""
    system, elimination = samples.system, constrained.elimination
    if system.control_metric is not None:
        _check_positive_definite(system, "control_metric", samples.states)
    outputs = output_chains(constrained.derivatives, elimination, samples)
    degrees = tuple(len(chain) for chain in outputs["output_chains"])
    attributes = {item.name: getattr(constrained, item.name) for item in fields(constrained)}
    # Rows of n* that are zero except for round-off are no feedthrough.
    attributes["elimination"] = _with_feedthrough(elimination, np.array(degrees) == 0)
    margin = find_margin(samples, outputs["control_matrix"], outputs["round_off"])
    return Structure(**attributes, output_degrees=degrees, control_margin=margin, **outputs)


def _with_feedthrough(elimination: Elimination, acts: Booleans) -> Elimination:
    """The elimination with some rows of n* alone."""
    rows = ca.diag(ca.SX(ca.sparsify(ca.DM(acts.astype(float)))))
    return replace(elimination, n_star=ca.sparsify(ca.mtimes(rows, elimination.n_star)))


def constraint_violation(structure: ConstraintStructure) -> Violation | None:
    """Returns the violation of Assumption (1) or (2) by a singular A(x); None if it is regular."""
    system, elimination = structure.system, structure.elimination
    margin, signals = structure.constraint_margin, system.constraint_output_signals
    if margin is None:
        return None
    matrix = system.frictional_contacts.without_friction(elimination.constraint_matrix)
    kinds = ((1, ViolationKind.CONSTRAINT_DEGREE), (2, ViolationKind.CONSTRAINT_RANK))
    violation = _singular(structure, matrix, margin, signals, structure.constraint_degrees, kinds)
    if violation is None or violation.cause is ViolationKind.BOUNDS:
        return violation
    if violation.cause is ViolationKind.CONSTRAINT_RANK:
        cause, combinations = find_dependence(
            structure.manifold, elimination, structure.states, margin.state
        )
        violation = replace(violation, cause=cause, combinations=combinations)
    return _as_redundant(system, violation)


def control_violation(structure: Structure) -> Violation | None:
    """Returns the violation of Assumption (4) or (5) by a singular B(x); None if it is regular."""
    margin, signals = structure.control_margin, structure.system.output_signals
    kinds = ((4, ViolationKind.OUTPUT_DEGREE), (5, ViolationKind.CONTROL_RANK))
    matrix, degrees = structure.control_matrix, structure.output_degrees
    violation = _singular(structure, matrix, margin, signals, degrees, kinds)
    if violation is not None and violation.cause is ViolationKind.CONTROL_RANK:
        rows = combinations_of([signal.name for signal in signals], margin.matrix)
        violation = replace(violation, combinations=rows)
    return violation


def _singular(
    structure: ConstraintStructure,
    matrix: ca.SX,
    margin: RankMargin,
    signals: Sequence[Signal],
    degrees: Sequence[int],
    kinds: Sequence[tuple[int, ViolationKind]],
) -> Violation | None:
    """The violation by a matrix, one kind if a row vanishes; also for other parameters."""
    system, states, violation = structure.system, structure.states, None
    if margin.is_singular and (row := margin.vanishing_row) is not None:
        violation = Violation(*kinds[0], (signals[row].name,), degrees[row], margin.state)
    elif margin.is_singular:
        names = tuple(signal.name for signal in signals)
        violation = Violation(*kinds[1], names, None, margin.state, margin.relative, margin.least)
    elif not (matrix.is_square() and any(p.bounds is not None for p in system.parameters)):
        return None
    value, family = system.matrix("rank", matrix), Family(structure.manifold, states)

    @np.errstate(all="ignore")
    def is_regular(state: FloatArray, parameters: FloatArray) -> bool:
        at = equilibrated(value(state, parameters))
        return smallest_singular_value(at) > system.least_margin  # Also not where it is nan.

    if violation is not None:
        if any(is_regular(state, system.parameter_values) for state in states):
            return violation
        return replace(violation, deciding=family.deciding(is_regular))
    usual = [np.abs(value(x, system.parameter_values)) for x in states]
    rows, columns = equilibration(np.mean(usual, axis=0))
    sign = np.linalg.slogdet(equilibrated(value(states[0], system.parameter_values)))[0]

    @np.errstate(all="ignore")
    def least(state: FloatArray, parameters: FloatArray) -> float:
        """The smallest singular value; minus one where the determinant has another sign."""
        scaled = value(state, parameters) / rows[:, None] / columns
        if not np.all(np.isfinite(scaled)):
            return np.inf
        other = np.linalg.slogdet(scaled)[0] * sign < 0.0
        return -1.0 if other else smallest_singular_value(scaled)

    lost = family.lost(least, system.least_margin)
    return Violation(kinds[1][0], ViolationKind.BOUNDS, (), deciding=lost) if lost else None


def _as_redundant(system: DaeSystem, violation: Violation) -> Violation:
    """The actual violation if redundant constraints led to a singular configuration."""
    possible = (ViolationKind.CONSTRAINT_DEGREE, ViolationKind.SINGULAR_CONFIGURATION)
    combinations: tuple[Combination, ...] = ()
    if violation.cause in possible:
        with suppress(InconsistentStateError):
            combinations = redundant_constraints(all_constraints_hold(system))
    # A gradient that vanishes wherever its constraint holds does not depend on others.
    if not combinations or not all(combination.others for combination in combinations):
        return violation
    names, kind = tuple(s.name for s in system.constraint_output_signals), ViolationKind.REDUNDANT
    return Violation(2, kind, names, combinations=combinations, deciding=violation.deciding)
