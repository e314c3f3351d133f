"""The structure of a system: relative degrees, index, Assumptions (1)-(5) with margins."""

from dataclasses import dataclass, fields, replace

import casadi as ca
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import Booleans, show
from drake_dae.dae.signals import DerivativeLayout
from drake_dae.dae.states.margins import RankMargin, find_margin
from drake_dae.dae.states.samples import Samples
from drake_dae.dae.structure.assumptions import Violation, ViolationKind, rank_violation
from drake_dae.dae.structure.constrained import (
    ConstraintStructure,
    checked_structure,
    constraint_violation,
    examine_constraints,
    guesses,
    is_positive_definite,
    with_numbers,
)
from drake_dae.dae.structure.dependence import combinations_of
from drake_dae.dae.structure.relative_degrees import output_chains
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import ModelError
from drake_dae.trace.factorization import Factorization, nearest_solution


@checked(ModelError)
@dataclass(frozen=True, eq=False, repr=False)
class Structure(ConstraintStructure):
    """The structure of one system by Assumptions (1)-(5): relative degrees, A(x), B(x), margins.

    Attributes:
        output_degrees: mu_1, ..., mu_p in the order of the system's outputs; 0 where the control
            enters the output at once (the paper's outputs s + 1, ..., p).
        output_chains: The chain l*_i, L_f* l*_i, ..., L_f*^(mu_i - 1) l*_i of each output.
        highest_derivatives: z_i^(mu_i) in terms of the unknowns of `derivatives`, shape (p, 1).
        drift: a(x) of (28), L_f*^mu_i l*_i in the order of the outputs, shape (p, 1).
        control_matrix: B(x) of (16), rows in the order of the system's outputs, shape (p, p); of a
            system with a `control_metric` it has more columns than rows.
        chains_need_force: Whether the output chains hold alpha (13), and so need a regular A(x).
        round_off: The entries of B(x) that are only round-off at all sampled states, in its shape.
            A column of such entries would otherwise be scaled up to the size of the others.
        control_margin: The margin of B(x), Assumption (5).
    """

    output_degrees: tuple[int, ...]
    output_chains: tuple[tuple[ca.SX, ...], ...]
    highest_derivatives: ca.SX
    drift: ca.SX
    control_matrix: ca.SX
    chains_need_force: bool
    round_off: Booleans
    control_margin: RankMargin

    def __repr__(self) -> str:
        degrees = f"r={self.constraint_degrees}, mu={self.output_degrees}"
        return f"Structure({self.system.name!r}, {degrees}, index={self.index})"

    @property
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

    def motion_for(self, commanded: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX] | None:
        """Returns x' and v under the control of `control_for`, solved together with the control.

        No forward dynamics is needed: with rigid joints it is kinematics, and M(q) is not factored.

        Returns x', v, and a scalar that is 0 exactly where one of them is not determined; None if
        the control is not found in this way, or if friction may leave the motion undetermined.
        """
        if self.system.control_metric is not None or self.system.frictional_contacts:
            return None
        motion = self.derivatives
        shown = ca.vertcat(motion.rate, motion.constraint_input)
        solution = motion.inverse(self.highest_derivatives, commanded, shown)
        if solution is None:
            return None
        size = self.system.num_states
        return solution[2][:size, :], solution[2][size:, :], solution[1]

    def control_for(self, commanded: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Returns u = B(x)^-1 (-a(x) + ubar), for which z_i^(mu_i) = ubar_i on N*.

        If B(x) does not determine u, `DaeSystem.control_metric` chooses it. Also returns a scalar
        that is 0 exactly where u is not determined.
        """
        solution: tuple[ca.SX, ...] | None = None
        if self.system.control_metric is None:
            solution = self.derivatives.inverse(self.highest_derivatives, commanded)  # (28)
        if solution is None:  # L_h* of an output vanishes, but not by structure.
            solution = self.control_by_matrix(commanded)
        control, pivot, *_ = solution
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
def find_structure(
    system: DaeSystem, *, spread: ArrayLike | None = None, count: int = 12, seed: int = 0
) -> Structure:
    """Finds relative degrees, A(x), B(x) and checks Assumptions (1)-(5).

    Whether an expression is zero is decided by its structure first, then by its numbers at
    consistent states drawn around `system.nominal_state`, with the default parameters and exogenous
    signals at rest. An expression that is zero there must be zero for all other values of
    parameters, signals and their derivatives, see `Parameter.bounds`; otherwise the degree would
    change with them, and the system is refused.

    Args:
        system: The system (1)-(3).
        spread: The standard deviation of the drawn states around the nominal one, a number for all
            or shape (n,); `DaeSystem.spread_around` it if None.
        count: The number of random states, at least 1.
        seed: The seed of the random numbers.

    Raises:
        AssumptionError: An assumption is violated; the exception has the state where.
        InconsistentStateError: There is no consistent state near the nominal one.
        ModelError: The outputs are not as many as the controls (or fewer, with a metric), or there
            are none, a function is not finite at the nominal state, the mass matrix or the metric
            is not symmetric and positive definite, or count or spread make no sense.
    """
    structure, violation = examine_structure(system, spread=spread, count=count, seed=seed)
    if violation:
        raise violation.error()
    return structure


def structure_of(owner: str, system: DaeSystem, structure: Structure | None) -> Structure:
    """Returns the given structure of a system, or the result of `find_structure`."""
    if structure is None:
        return find_structure(system)
    return checked_structure(owner, system, structure, Structure, "find_structure")


def examine_structure(
    system: DaeSystem, *, spread: ArrayLike | None = None, count: int = 12, seed: int = 0
) -> tuple[Structure, Violation | None]:
    """Finds the structure as `find_structure`, but also returns it where B(x) is singular."""
    if why := why_no_law(system):
        raise ModelError(f"{system.name}: {why}. `DaePlant` simulates it without these")
    constrained, samples = examine_constraints(system, guesses(system, spread, count, seed))
    violation = constraint_violation(constrained)
    if violation:
        raise violation.error()
    structure = examine_outputs(constrained, samples)
    return structure, control_violation(structure)


def why_no_law(system: DaeSystem) -> str:
    """Returns why a system has no law (28) by its numbers of inputs and outputs, else ""."""
    p, q = system.num_controls, system.num_outputs
    if p == 0:
        return "there is no control input, so no output can be controlled"
    if q == 0 or p < q:
        return (
            f"there are {q} controlled outputs and {p} controls; the law (28) inverts B(x), so it "
            "needs as many outputs as controls"
        )
    if p > q and system.control_metric is None:
        return (
            f"there are {q} controlled outputs and {p} controls; the law (28) inverts B(x), so it "
            "needs as many outputs as controls, or a `control_metric` in which it takes the least "
            "control"
        )
    return ""


def examine_outputs(constrained: ConstraintStructure, samples: Samples) -> Structure:
    """Finds mu_1, ..., mu_p and B(x) if A(x) is regular."""
    if (metric := samples.system.control_metric) is not None:
        for state, (value,) in zip(samples.states, samples.values(metric=metric), strict=True):
            if not is_positive_definite(value):
                raise ModelError(
                    f"{samples.system.name}: control_metric is not symmetric and positive definite "
                    f"at x = {show(state)}; give each control a positive weight"
                )
    elimination = constrained.elimination
    outputs = output_chains(constrained.derivatives, elimination, samples)
    degrees = tuple(len(chain) for chain in outputs.chains)
    # Rows of n* that are zero except for round-off are no feedthrough.
    n_star = [
        ca.SX(1, samples.system.num_controls) if degree else elimination.n_star[i, :]
        for i, degree in enumerate(degrees)
    ]
    attributes = {item.name: getattr(constrained, item.name) for item in fields(constrained)}
    attributes["elimination"] = replace(elimination, n_star=ca.vertcat(*n_star))
    return Structure(
        **attributes,
        output_degrees=degrees,
        output_chains=outputs.chains,
        highest_derivatives=outputs.highest_derivatives,
        drift=outputs.drift,
        control_matrix=outputs.control_matrix,
        chains_need_force=outputs.need_force,
        round_off=outputs.round_off,
        control_margin=find_margin(samples, outputs.control_matrix, outputs.round_off),
    )


def control_violation(structure: Structure) -> Violation | None:
    """Returns the violation of Assumption (4) or (5) by a singular B(x); None if it is regular."""
    causes = ((4, ViolationKind.OUTPUT_DEGREE), (5, ViolationKind.CONTROL_RANK))
    margin, degrees = structure.control_margin, structure.output_degrees
    signals = structure.system.output_signals
    violation = rank_violation(margin, signals, degrees, *causes)
    if violation is not None and violation.cause is ViolationKind.CONTROL_RANK:
        assert margin is not None
        rows = combinations_of([signal.name for signal in signals], [margin.matrix])
        violation = replace(violation, combinations=tuple(rows))
    matrix = structure.control_matrix
    return with_numbers(violation, 5, structure.manifold, structure.states, matrix)
