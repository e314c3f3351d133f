"""The structure of the constraints alone: Assumptions (1)-(3), N*, and (9)-(14)."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, check_whole_number, show
from drake_dae.dae.derivatives import Derivatives
from drake_dae.dae.elimination import Elimination, eliminate
from drake_dae.dae.manifold.manifold import Manifold
from drake_dae.dae.states.family import Family
from drake_dae.dae.states.margins import RankMargin, find_margin
from drake_dae.dae.states.region import Region
from drake_dae.dae.states.samples import Samples, draw
from drake_dae.dae.structure.assumptions import Violation, ViolationKind, rank_violation
from drake_dae.dae.structure.dependence import find_dependence, redundant_constraints
from drake_dae.dae.structure.redundancy import all_constraints_hold
from drake_dae.dae.structure.relative_degrees import InputActions, constraint_chains
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import AssumptionError, InconsistentStateError, ModelError
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.round_off import equilibrated, equilibration, positive, smallest_singular_value

Kind = TypeVar("Kind", bound="ConstraintStructure")

PART = 0.1
"""The least part of a constraint in a vanishing combination, relative to the largest."""


@checked(ModelError)
@dataclass(frozen=True, eq=False, repr=False)
class ConstraintStructure:
    """The structure of the constraints of a system, by Assumptions (1)-(3).

    It is enough for simulation. Controls and controlled outputs are not needed.

    Attributes:
        system: The system.
        constraint_degrees: r_1, ..., r_m.
        manifold: N* (4).
        derivatives: The time derivatives along the motion on N*.
        elimination: Equations (9)-(14) as expressions; not finite where A(x) is singular.
        states: The consistent states at which numbers were decided, shape (samples, n).
        scale: The size of each state over them and the guesses from which they were found, shape
            (n,).
        constraint_margin: The margin of A(x), Assumption (2), without friction; None without
            constraints.
    """

    system: DaeSystem
    constraint_degrees: tuple[int, ...]
    manifold: Manifold
    derivatives: Derivatives
    elimination: Elimination
    states: FloatArray
    scale: FloatArray
    constraint_margin: RankMargin | None

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
        matrix = self.elimination.constraint_matrix
        function = self.system.trace("A(x)", {"value": matrix}, often=False)
        return lambda x, p: function(x, p)[0].reshape(matrix.shape)

    def dependent_constraints(self, state: FloatArray, parameters: FloatArray) -> tuple[str, ...]:
        """Returns the names of the constraints that become dependent where A(x) is singular.

        They are the parts of n with n^T A(x) = 0, in units of the usual lengths of the gradients.
        """
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
def find_constraint_structure(
    system: DaeSystem, *, spread: ArrayLike | None = None, count: int = 12, seed: int = 0
) -> ConstraintStructure:
    """Finds r_1, ..., r_m and A(x), and checks Assumptions (1)-(3).

    Args:
        system: The system (1)-(3). It may have no controls or outputs, and a singular B(x).
        spread, count, seed: How states are drawn, as for `find_structure`.

    Raises:
        AssumptionError: One of Assumptions (1)-(3) is violated; the exception has the state where.
        InconsistentStateError: There is no consistent state near the nominal one.
        ModelError: A function is not finite at the nominal state, the mass matrix is not symmetric
            and positive definite, or count or spread make no sense.
    """
    structure, samples = examine_constraints(system, guesses(system, spread, count, seed))
    violation = constraint_violation(structure)
    if violation:
        raise violation.error()
    # Rows of n* that are only round-off are no feedthrough.
    actions = InputActions(samples, structure.elimination)
    acts = actions.numbers(actions.feedthrough).any(axis=(0, 2))
    rows = ca.diag(ca.SX(ca.sparsify(ca.DM(acts.astype(float)))))
    feedthrough = ca.sparsify(ca.mtimes(rows, structure.elimination.n_star))
    return replace(structure, elimination=replace(structure.elimination, n_star=feedthrough))


def constraint_structure_of(
    owner: str, system: DaeSystem, structure: ConstraintStructure | None
) -> ConstraintStructure:
    """Returns the constraint structure of a system: the argument, or a new one if None."""
    if structure is None:
        return find_constraint_structure(system)
    makers = "find_structure or find_constraint_structure"
    return checked_structure(owner, system, structure, ConstraintStructure, makers)


def checked_structure(
    owner: str, system: DaeSystem, structure: Kind, kind: type[Kind], made_by: str
) -> Kind:
    """Checks that a structure belongs to a system, and returns it."""
    if not isinstance(structure, kind):
        raise ModelError(
            f"{owner}: structure must be what {made_by} returns, got {type(structure).__name__}"
        )
    if structure.system is not system:
        raise ModelError(
            f"{owner}: the structure is that of another system, '{structure.system.name}' and not "
            f"'{system.name}'. Omit it, or pass the structure of this system"
        )
    return structure


def guesses(system: DaeSystem, spread: ArrayLike | None, count: int, seed: int) -> FloatArray:
    """Returns initial guesses of consistent states, shape (count + 1, n)."""
    check_system(system)
    check_whole_number(f"{system.name}: count", count, 1)
    check_whole_number(f"{system.name}: seed", seed, 0)
    return draw(system, spread, count, seed)


def examine_constraints(
    system: DaeSystem, guesses: FloatArray, region: Region | None = None
) -> tuple[ConstraintStructure, Samples]:
    """Finds r_1, ..., r_m and A(x) of a system that `check_system` accepts."""
    try:
        chains, samples = constraint_chains(system, guesses, region)
    except AssumptionError as error:
        if error.violation is not None:
            raise _as_redundant(system, error.violation).error() from None
        raise
    check_mass_matrix(system, samples.states)
    derivatives = Derivatives(system, ca.vertcat(ca.SX(0, 1), *[chain[-1] for chain in chains]))
    elimination = eliminate(derivatives)
    # Friction can change the sign of A(x); the Painleve paradox is tested along motions.
    matrix = system.frictional_contacts.without_friction(elimination.constraint_matrix)
    structure = ConstraintStructure(
        system=system,
        constraint_degrees=tuple(len(chain) for chain in chains),
        manifold=samples.manifold,
        derivatives=derivatives,
        elimination=elimination,
        states=samples.states,
        scale=samples.scale,
        constraint_margin=find_margin(samples, matrix) if chains else None,
    )
    return structure, samples


def check_system(system: DaeSystem) -> None:
    """Checks the number of constraints and the mass matrix of a system."""
    check_mass_matrix(system, system.nominal_state[None])
    if system.num_constraints > system.num_states:
        names = tuple(signal.name for signal in system.constraint_output_signals)
        raise Violation(2, ViolationKind.COUNT, names).error()


def check_mass_matrix(system: DaeSystem, states: FloatArray) -> None:
    """Checks E of E x' = f + g v + h u, since LDL^T reads only one triangle of it."""
    function = system.trace("mass matrix", {"mass": ca.densify(system.mass_matrix)}, often=False)
    for state in states:
        mass = function(state, system.parameter_values)[0].reshape(state.size, state.size)
        if is_positive_definite(mass):
            continue
        raise ModelError(
            f"{system.name}: mass_matrix is not symmetric and positive definite at x = "
            f"{show(state)}. An equation in which no derivative stands is a constraint 0 = k(x) "
            "with a constraint input; where it holds an unknown z that has no derivative, lift it: "
            "make z a state with z' = v, v a new constraint input, and keep the equation as "
            "constraint"
        )


def is_positive_definite(matrix: FloatArray) -> bool:
    """Whether a matrix is symmetric and positive definite, independent of units."""
    length = np.sqrt(np.abs(np.diag(matrix)))
    if not (np.all(np.isfinite(matrix)) and np.all(length > 0.0)):
        return False
    scaled = matrix / length / length[:, None]
    is_symmetric = np.allclose(scaled, scaled.T, rtol=0.0, atol=1e-9)
    return bool(is_symmetric and np.linalg.eigvalsh(scaled)[0] > 1e-12)


def constraint_violation(structure: ConstraintStructure) -> Violation | None:
    """Returns the violation of Assumption (1) or (2) by a singular A(x); None if it is regular."""
    causes = ((1, ViolationKind.CONSTRAINT_DEGREE), (2, ViolationKind.CONSTRAINT_RANK))
    signals, margin = structure.system.constraint_output_signals, structure.constraint_margin
    violation = rank_violation(margin, signals, structure.constraint_degrees, *causes)
    if margin is None:
        return None
    system, elimination = structure.system, structure.elimination
    matrix = system.frictional_contacts.without_friction(elimination.constraint_matrix)
    violation = with_numbers(violation, 2, structure.manifold, structure.states, matrix)
    if violation is None or violation.cause is ViolationKind.BOUNDS:
        return violation
    if violation.cause is not ViolationKind.CONSTRAINT_RANK:
        return _as_redundant(system, violation)
    combinations, everywhere, in_gradients = find_dependence(
        structure.manifold, elimination, structure.states, margin.state
    )
    cause = {  # By whether it is singular everywhere, and by its gradients.
        (True, True): ViolationKind.REDUNDANT,
        (False, True): ViolationKind.SINGULAR_CONFIGURATION,
        (True, False): ViolationKind.HIDDEN_DEGREE,
        (False, False): ViolationKind.CONSTRAINT_RANK,
    }[everywhere, in_gradients]
    violation = replace(violation, cause=cause, combinations=combinations)
    return _as_redundant(system, violation)


def with_numbers(
    violation: Violation | None,
    assumption: int,
    manifold: Manifold,
    states: FloatArray,
    matrix: ca.SX,
) -> Violation | None:
    """Returns the violation by a matrix, also for other parameters than the defaults."""
    system = manifold.system
    bounded = any(p.bounds is not None for p in system.parameters)
    if violation is None and not (bounded and matrix.is_square()):
        return None
    function = system.trace("rank", {"matrix": ca.densify(matrix)}, often=False)

    @np.errstate(all="ignore")  # A matrix that is not finite is not regular.
    def determinant(state: FloatArray, parameters: FloatArray) -> float:
        """1 or -1 as its sign, and 0 where the matrix is singular."""
        value = function(state, parameters)[0].reshape(matrix.shape)
        if not np.all(np.isfinite(value)):
            return 0.0
        scaled = equilibrated(value)
        if smallest_singular_value(scaled) <= system.least_margin:
            return 0.0
        return float(np.linalg.slogdet(scaled)[0]) if matrix.is_square() else 1.0

    family = Family(manifold, states)
    if violation is None:
        usual = [
            np.abs(function(x, system.parameter_values)[0]).reshape(matrix.shape) for x in states
        ]
        rows, columns = equilibration(np.mean(usual, axis=0))
        sign = determinant(states[0], system.parameter_values)

        @np.errstate(all="ignore")
        def margin(state: FloatArray, parameters: FloatArray) -> float:
            """The smallest singular value; minus one where the determinant has another sign."""
            value = function(state, parameters)[0].reshape(matrix.shape) / rows[:, None] / columns
            if not np.all(np.isfinite(value)):
                return np.inf
            if np.linalg.slogdet(value)[0] * sign < 0.0:
                return -1.0
            return smallest_singular_value(value)

        lost = family.lost(margin, system.least_margin)
        return Violation(assumption, ViolationKind.BOUNDS, (), deciding=lost) if lost else None
    if any(determinant(state, system.parameter_values) for state in states):
        return violation
    return replace(violation, deciding=family.deciding(lambda x, p: determinant(x, p) != 0.0))


def _as_redundant(system: DaeSystem, violation: Violation) -> Violation:
    """Returns the actual violation if redundant constraints led to a singular configuration.

    Off N* they are overdetermined, and only singular configurations satisfy them.
    """
    possible = (ViolationKind.CONSTRAINT_DEGREE, ViolationKind.SINGULAR_CONFIGURATION)
    if violation.cause not in possible:
        return violation
    try:
        combinations = redundant_constraints(all_constraints_hold(system))
    except InconsistentStateError:
        return violation
    # A gradient that vanishes wherever its constraint holds does not depend on others.
    if not combinations or not all(combination.others for combination in combinations):
        return violation
    names = tuple(signal.name for signal in system.constraint_output_signals)
    return replace(
        violation,
        assumption=2,
        cause=ViolationKind.REDUNDANT,
        names=names,
        combinations=combinations,
        order=None,
        state=None,
        singular_value=None,
    )
