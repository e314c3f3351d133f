"""What kind of system it is: relative degrees, index, Assumptions (1)-(5) with their margins."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arrays import Booleans, FloatArray, check_whole_number, show
from drake_dae.dae.derivatives import Motion
from drake_dae.dae.elimination import Elimination, affine, eliminate
from drake_dae.dae.manifold import Manifold
from drake_dae.dae.states.margins import Margin
from drake_dae.dae.states.region import Region
from drake_dae.dae.states.samples import Fields, Samples, spread_of, traced
from drake_dae.dae.system import DaeSystem, check_is_system
from drake_dae.errors import AssumptionError, ModelError
from drake_dae.trace.lie import lie_derivative, lie_derivative_along

MANY = 10
"""So many random states have no zero in common of a function that is not zero."""


@dataclass(frozen=True, eq=False, repr=False)
class Structure:
    """The structure that the paper assumes, found for one system.

    Attributes:
        system: The system.
        constraint_degrees: r_1, ..., r_m.
        output_degrees: mu_1, ..., mu_p in the order of the system's outputs; 0 where the control
            enters the output at once (the paper's outputs s + 1, ..., p).
        output_order: The outputs in the paper's order (15): those with mu_i >= 1 first.
        manifold: N* (4).
        motion: Time derivatives along the motion on N*.
        elimination: (9)-(14).
        output_chains: Per output l*_i, L_f* l*_i, ..., L_f*^(mu_i - 1) l*_i.
        highest_derivatives: z_i^(mu_i) in terms of the unknowns of `motion`, shape (p, 1).
        drift: a_1(x), a_2(x) of (28): L_f*^mu_i l*_i, shape (p, 1).
        control_matrix: B(x) of (16), rows in the order of the system's outputs, shape (p, p).
        chains_need_force: Whether the output chains hold alpha (13), and so need a regular A(x).
        round_off: Which entries of B(x) are zero but for round-off at all of many states, shape
            (p, p). A column of nothing else would be scaled up to the size of the others.
        states: The consistent states at which numbers were decided, shape (samples, n).
        constraint_margin: Margin of A(x), Assumption (2); None without constraints.
        control_margin: Margin of B(x), Assumption (5).
    """

    system: DaeSystem
    constraint_degrees: tuple[int, ...]
    output_degrees: tuple[int, ...]
    output_order: tuple[int, ...]
    manifold: Manifold
    motion: Motion
    elimination: Elimination
    output_chains: tuple[tuple[ca.SX, ...], ...]
    highest_derivatives: ca.SX
    drift: ca.SX
    control_matrix: ca.SX
    chains_need_force: bool
    round_off: Booleans
    states: FloatArray
    constraint_margin: Margin | None
    control_margin: Margin

    def __repr__(self) -> str:
        degrees = f"r={self.constraint_degrees}, mu={self.output_degrees}"
        return f"Structure({self.system.name!r}, {degrees}, index={self.index})"

    @property
    def index(self) -> int:
        """max r_i + 1, the index of the DAE; 0 without constraints."""
        return max(self.constraint_degrees) + 1 if self.constraint_degrees else 0

    @property
    def num_dynamic_outputs(self) -> int:
        """s of (15)."""
        return sum(degree > 0 for degree in self.output_degrees)

    @property
    def zero_dynamics_dimension(self) -> int:
        """dim xi of (22): n - sum r_i - sum mu_i."""
        return self.manifold.dimension - sum(self.output_degrees)


def find_structure(
    system: DaeSystem, *, spread: ArrayLike | None = None, count: int = 12, seed: int = 0
) -> Structure:
    """Finds relative degrees, A(x), B(x) and checks Assumptions (1)-(5).

    Whether an expression is zero is decided by its structure first, then by its numbers at
    consistent states drawn around `system.nominal_state`, with the default parameters.

    Args:
        system: (1)-(3).
        spread: Standard deviation of the drawn states around the nominal one, a number for all
            or shape (n,); see `default_spread` if None.
        count: How many states are drawn, at least 1.
        seed: Of the random numbers.

    Raises:
        AssumptionError: An assumption that is violated, with the state where.
        InconsistentStateError: No consistent state near the nominal one.
        ModelError: No control input, a function that is not finite at the nominal state, a mass
            matrix that is not symmetric and positive definite, or a count or spread without sense.
    """
    try:
        structure, violation = examine_structure(system, spread=spread, count=count, seed=seed)
        if violation:
            raise violation
    except AssumptionError as error:
        error.system = system
        raise
    return structure


def examine_structure(
    system: DaeSystem, *, spread: ArrayLike | None = None, count: int = 12, seed: int = 0
) -> tuple[Structure, AssumptionError | None]:
    """As `find_structure`, but complete also where B(x) is singular.

    Returns:
        The structure, and how B(x) violates Assumption (4) or (5); None if it does not.

    Raises:
        AssumptionError: A violation before there is a B(x): of Assumptions (1)-(3), or by an
            output that has no degree.
        InconsistentStateError, ModelError: As `find_structure`.
    """
    check_is_system(system, "find_structure")
    check_system(system)
    check_whole_number(f"{system.name}: count", count, 1)
    check_whole_number(f"{system.name}: seed", seed, 0)
    deviation = spread_of(system, spread)
    random = np.random.default_rng(seed)
    guesses = system.nominal_state + deviation * np.vstack(
        [np.zeros(system.num_states), random.standard_normal((count, system.num_states))]
    )
    constrained = examine_constraints(system, guesses)
    violation = constraint_violation(system, constrained.degrees, constrained.margin)
    if violation:
        raise violation
    structure = examine_outputs(constrained)
    degrees = structure.output_degrees
    return structure, control_violation(system, degrees, structure.control_margin)


def check_system(system: DaeSystem) -> None:
    """Refuses what there is nothing to examine of.

    Raises:
        AssumptionError: More constraints than states.
        ModelError: No control input, or a mass matrix that is not symmetric and positive definite.
    """
    if system.num_controls == 0:
        raise ModelError(f"{system.name}: no control inputs, so there is nothing to steer")
    _check_mass_matrix(system, system.nominal_state[None])
    if system.num_constraints > system.num_states:
        raise AssumptionError(
            f"m = {system.num_constraints} constraints on n = {system.num_states} states depend "
            "on each other; remove the redundant ones",
            2,
        )


@dataclass(frozen=True, eq=False)
class Constrained:
    """What the constraints alone decide, by Assumptions (1) and (3).

    Attributes:
        chains: Per constraint k_i, L_f k_i, ..., L_f^(r_i - 1) k_i.
        samples: The consistent states at which numbers are decided.
        motion: Time derivatives along the motion on N*.
        elimination: (9)-(14); not finite where A(x) is singular.
        margin: Of A(x); None without constraints.
    """

    chains: list[list[ca.SX]]
    samples: Samples
    motion: Motion
    elimination: Elimination
    margin: Margin | None

    @property
    def degrees(self) -> tuple[int, ...]:
        """r_1, ..., r_m."""
        return tuple(len(chain) for chain in self.chains)


def examine_constraints(
    system: DaeSystem, guesses: FloatArray, region: Region | None = None
) -> Constrained:
    """Finds r_1, ..., r_m and A(x) of a system that `check_system` takes.

    Args:
        system: (1)-(3).
        guesses: States near which consistent ones are looked for, shape (count, n).
        region: Where these must be.

    Raises:
        AssumptionError: (1), (3), or a constraint that no constraint input acts on. A singular A(x)
            is left to `constraint_violation`.
        InconsistentStateError, ModelError: As `find_structure`.
    """
    fields = Fields(system.explicit)
    chains = _constraint_chains(system.explicit, fields, guesses, region)
    samples = Samples(Manifold(system, chains), fields, guesses, region)
    _check_mass_matrix(system, samples.states)
    motion = Motion(system, ca.vertcat(ca.SX(0, 1), *[chain[-1] for chain in chains]))
    elimination = eliminate(motion)
    margin = samples.margin(elimination.constraint_matrix) if chains else None
    return Constrained(chains, samples, motion, elimination, margin)


def examine_outputs(constrained: Constrained) -> Structure:
    """Finds mu_1, ..., mu_p and B(x), where A(x) is regular.

    Raises:
        AssumptionError: (4), or an output that no control acts on. A singular B(x) is left to
            `control_violation`.
        ModelError: A function that is not finite.
    """
    samples, motion, elimination = constrained.samples, constrained.motion, constrained.elimination
    system = motion.system
    outputs = _output_chains(motion, elimination, samples)
    degrees = tuple(len(chain) for chain in outputs.chains)
    # Rows of n* that are zero but for round-off are no feedthrough.
    n_star = [
        ca.SX(1, system.num_controls) if degree else elimination.n_star[i, :]
        for i, degree in enumerate(degrees)
    ]
    return Structure(
        system=system,
        constraint_degrees=constrained.degrees,
        output_degrees=degrees,
        output_order=tuple(sorted(range(len(degrees)), key=lambda i: degrees[i] == 0)),
        manifold=samples.manifold,
        motion=motion,
        elimination=replace(elimination, n_star=ca.vertcat(*n_star)),
        output_chains=outputs.chains,
        highest_derivatives=outputs.highest_derivatives,
        drift=outputs.drift,
        control_matrix=outputs.control_matrix,
        chains_need_force=outputs.need_force,
        round_off=outputs.round_off,
        states=samples.states,
        constraint_margin=constrained.margin,
        control_margin=samples.margin(outputs.control_matrix, outputs.round_off),
    )


def constraint_violation(
    system: DaeSystem, degrees: Sequence[int], margin: Margin | None
) -> AssumptionError | None:
    """How a singular A(x) violates Assumption (1) or (2)."""
    signals = zip(system.constraint_output_signals, degrees, strict=True)
    return _rank_violation(
        margin,
        [("constraint inputs act", degree, f"constraint '{s.name}'") for s, degree in signals],
        (1, 2),
        "A(x) of (2) loses rank: the constraints are redundant or their forces cannot act "
        "independently. Remove a redundant constraint, or keep away from this state",
    )


def control_violation(
    system: DaeSystem, degrees: Sequence[int], margin: Margin
) -> AssumptionError | None:
    """How a singular B(x) violates Assumption (4) or (5)."""
    signals = zip(system.output_signals, degrees, strict=True)
    return _rank_violation(
        margin,
        [("control acts", degree, f"output '{s.name}'") for s, degree in signals],
        (4, 5),
        "B(x) of (16) is singular: the controlled outputs "
        f"{', '.join(s.name for s in system.output_signals)} cannot be steered independently. An "
        "output may repeat a constraint or another output; choose other outputs, keep away from "
        "this state, or see whether `dynamic_extension` finds integrators that help",
    )


def _rank_violation(
    margin: Margin | None,
    rows: Sequence[tuple[str, int, str]],
    assumptions: tuple[int, int],
    message: str,
) -> AssumptionError | None:
    """What a singular matrix violates.

    Args:
        margin: Of the matrix.
        rows: What acts on which derivative of what.
        assumptions: The number that is violated if a whole row vanishes, and if not.
        message: Of the second.
    """
    if margin is None or not margin.is_singular:
        return None
    if margin.vanishing_row is not None:
        acts, order, what = rows[margin.vanishing_row]
        return AssumptionError(
            f"the relative degree of {what} is not defined at x = {show(margin.state)}: the "
            f"{acts} on its derivative {order} around this state, but not there. Keep away from "
            "this state, or choose another function",
            assumptions[0],
            margin.state,
        )
    return AssumptionError(
        f"{message}. Smallest singular value {margin.relative:.1e} (rows and columns scaled) at "
        f"x = {show(margin.state)}",
        assumptions[1],
        margin.state,
    )


def _check_mass_matrix(system: DaeSystem, states: FloatArray) -> None:
    """Its factorization LDL^T reads one triangle, and would not notice.

    Raises:
        ModelError: It is not symmetric and positive definite at a state.
    """
    function = traced(system, mass=ca.densify(system.mass_matrix))
    for state in states:
        mass = function(state, system.parameter_values)[0].reshape(state.size, state.size)
        length = np.sqrt(np.abs(np.diag(mass)))
        if np.all(np.isfinite(mass)) and np.all(length > 0.0):
            scaled = mass / length / length[:, None]
            symmetric = np.allclose(scaled, scaled.T, rtol=0.0, atol=1e-9)
            if symmetric and np.linalg.eigvalsh(scaled)[0] > 1e-12:
                continue
        raise ModelError(
            f"{system.name}: mass_matrix is not symmetric and positive definite at x = "
            f"{show(state)}"
        )


def _constraint_chains(
    system: DaeSystem, fields: Fields, guesses: FloatArray, region: Region | None
) -> list[list[ca.SX]]:
    """k_i, L_f k_i, ..., L_f^(r_i - 1) k_i by Assumptions (1) and (3)."""
    x = system.state
    chains = [[system.k[i]] for i in range(system.num_constraints)]
    undecided = list(range(system.num_constraints))
    while undecided:
        last = ca.vertcat(*[chains[i][-1] for i in undecided])
        by_force = lie_derivative_along(last, system.g, x)
        by_control = lie_derivative_along(last, system.h, x)
        samples = Samples(Manifold(system, chains), fields, guesses, region)
        force_acts = _acts(samples.derivatives(by_force, last, samples.field("g")))
        control_acts = _acts(samples.derivatives(by_control, last, samples.field("h")))
        still, stuck = [], []
        for row, i in enumerate(undecided):
            name, order = system.constraint_output_signals[i].name, len(chains[i])
            if force_acts[row].all():
                continue
            if force_acts[row].any():
                state = samples.states[int(np.argmin(force_acts[row]))]
                raise AssumptionError(
                    f"the relative degree of constraint '{name}' is not defined at x = "
                    f"{show(state)}: the constraint inputs act on its derivative {order} in the "
                    "neighbourhood, but not there. Keep away from this state, or write the "
                    "constraint so that its gradient does not vanish",
                    1,
                    state,
                )
            if control_acts[row].any():
                state = samples.states[int(np.argmax(control_acts[row]))]
                raise AssumptionError(
                    f"the control acts on derivative {order} of constraint '{name}', before any "
                    f"constraint input does, at x = {show(state)}: the constraint then binds the "
                    "control instead of the state. Take that control out, or add an actuator "
                    "state in front of it",
                    3,
                    state,
                )
            still.append(i)
            if not _reaches(system.g, system.f, last[row], x) or (
                by_force[row, :].nnz() and samples.dependent(ca.vertcat(*chains[i]))
            ):
                stuck.append(i)
        if sum(len(chain) for chain in chains) + len(still) > system.num_states:
            stuck = still
        if stuck:
            names = ", ".join(f"'{system.constraint_output_signals[i].name}'" for i in stuck)
            raise AssumptionError(
                f"no constraint input ever acts on constraint {names}: no force reaches it, or "
                f"its derivatives repeat each other or fill the state (n = {system.num_states}). "
                "It is redundant, or no force keeps it",
                2,
            )
        for i in still:
            chains[i].append(lie_derivative(chains[i][-1], system.f, x))
        undecided = still
    return chains


class _Outputs(NamedTuple):
    """What becomes of the outputs; see `Structure`."""

    chains: tuple[tuple[ca.SX, ...], ...]
    drift: ca.SX
    control_matrix: ca.SX
    highest_derivatives: ca.SX
    need_force: bool
    round_off: Booleans


def _output_chains(motion: Motion, elimination: Elimination, samples: Samples) -> _Outputs:
    """By Assumption (4)."""
    system = motion.system
    x, f_star, h_star = system.state, elimination.f_star, elimination.h_star
    count = system.num_controls
    moving = system.l + ca.mtimes(system.m, motion.constraint_input)
    h_star_values, n_star_values = samples.eliminated(
        elimination.constraint_gradient, elimination.constraint_matrix
    )
    drift, control_matrix = ca.SX(count, 1), ca.SX(count, count)
    highest_derivatives = ca.SX(count, 1)
    round_off, need_force = np.zeros((count, count), dtype=bool), False
    chains: list[list[ca.SX]] = [[] for _ in range(count)]
    slopes = np.array([value for value, _ in n_star_values])
    following = elimination.l_star
    rows = elimination.n_star
    undecided = list(range(count))
    while undecided:
        acts, still = _acts(slopes), []
        for row, i in enumerate(undecided):
            if acts[row].all():
                drift[i] = following[row]
                control_matrix[i, :] = rows[row, :]
                round_off[i] = len(slopes) >= MANY and ~slopes[:, row, :].any(axis=0)
                highest_derivatives[i] = moving[row]
            elif acts[row].any():
                state = samples.states[int(np.argmin(acts[row]))]
                raise AssumptionError(
                    f"the relative degree of output '{system.output_signals[i].name}' is not "
                    f"defined at x = {show(state)}: the control acts on its derivative "
                    f"{len(chains[i])} in the neighbourhood, but not there. Choose another "
                    "output, or keep away from this state",
                    4,
                    state,
                )
            else:
                still.append(i)
                chains[i].append(following[row])
                need_force = need_force or motion.has_unknowns(moving[row])
        if not still:
            break
        last = ca.vertcat(*[chains[i][-1] for i in still])
        # Along x' = f* + h* u: the derivative is L_f* + L_h* u of the last one.
        moving = motion.derivative(moving[[undecided.index(i) for i in still]])
        following, rows = affine(motion.expand(moving), motion.control)
        slopes = samples.derivatives(rows, last, h_star_values)
        acts, stuck = _acts(slopes), []
        for row, i in enumerate(still):
            if acts[row].any():
                continue
            # By Theorem 2.1 these differentials are independent if the output has a degree; worth
            # a look where nothing acts although the structure says that it could.
            used = ca.vertcat(samples.manifold.residual_expression, *chains[i])
            if (
                used.numel() >= system.num_states
                or not _reaches(h_star, f_star, last[row], x)
                or (rows[row, :].nnz() and samples.dependent(used))
            ):
                stuck.append(i)
        if stuck:
            names = ", ".join(f"'{system.output_signals[i].name}'" for i in stuck)
            raise AssumptionError(
                f"the control never acts on output {names}: its derivatives repeat those of the "
                "constraints, or no control reaches it, so it has no relative degree and B(x) no "
                "row for it. Choose another output",
                5,
            )
        undecided = still
    return _Outputs(
        chains=tuple(tuple(chain) for chain in chains),
        drift=drift,
        control_matrix=control_matrix,
        highest_derivatives=highest_derivatives,
        need_force=need_force,
        round_off=round_off,
    )


def _acts(numbers: FloatArray) -> Booleans:
    """Which rows are not zero where: shape (a, samples), of numbers of shape (samples, a, k)."""
    return np.asarray(numbers.any(axis=2)).T


def _reaches(fields: ca.SX, drift: ca.SX, expression: ca.SX, state: ca.SX) -> bool:
    """Whether an input along the fields can influence an expression at all, by structure."""
    influence = _pattern(drift, state)
    needed = _pattern(expression, state)[0]
    for _ in range(state.numel()):
        needed = needed | influence[needed].any(axis=0)
    moved = _nonzeros(fields).any(axis=1)
    return bool((needed & moved).any())


def _pattern(expression: ca.SX, state: ca.SX) -> np.typing.NDArray[np.bool_]:
    """Which entries (rows) depend on which states (columns)."""
    return _nonzeros(ca.SX(ca.jacobian_sparsity(expression, state), 1))


def _nonzeros(matrix: ca.SX) -> np.typing.NDArray[np.bool_]:
    """Which entries are structurally nonzero."""
    result = np.zeros(matrix.shape, dtype=bool)
    rows, columns = matrix.sparsity().get_triplet()
    result[rows, columns] = True
    return result
