"""What kind of system it is: relative degrees, index, Assumptions (1)-(5) with their margins."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import Booleans, FloatArray, check_whole_number
from drake_dae.dae.derivatives import Derivatives
from drake_dae.dae.elimination import Elimination
from drake_dae.dae.layout import Layout
from drake_dae.dae.manifold import Manifold
from drake_dae.dae.states.margins import Margin, find_margin
from drake_dae.dae.states.samples import draw
from drake_dae.dae.structure.assumptions import Cause, Violation, rank_violation
from drake_dae.dae.structure.constrained import (
    Constrained,
    check_system,
    constraint_violation,
    examine_constraints,
)
from drake_dae.dae.structure.relative_degrees import output_chains
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import ModelError
from drake_dae.trace.factorization import Factorization
from drake_dae.trace.functions import TracedFunction


@checked(ModelError)
@dataclass(frozen=True, eq=False, repr=False)
class Structure:
    """The structure that the paper assumes, found for one system.

    Attributes:
        system: The system.
        constraint_degrees: r_1, ..., r_m.
        output_degrees: mu_1, ..., mu_p in the order of the system's outputs; 0 where the control
            enters the output at once (the paper's outputs s + 1, ..., p).
        manifold: N* (4).
        derivatives: The time derivatives along the motion on N*.
        elimination: Equations (9)-(14) as expressions.
        output_chains: The chain l*_i, L_f* l*_i, ..., L_f*^(mu_i - 1) l*_i of each output.
        highest_derivatives: z_i^(mu_i) in terms of the unknowns of `derivatives`, shape (p, 1).
        drift: a(x) of (28), L_f*^mu_i l*_i in the order of the outputs, shape (p, 1).
        control_matrix: B(x) of (16), rows in the order of the system's outputs, shape (p, p).
        chains_need_force: Whether the output chains hold alpha (13), and so need a regular A(x).
        round_off: Which entries of B(x) are zero but for round-off at all of many states, shape
            (p, p). A column of nothing else would be scaled up to the size of the others.
        states: The consistent states at which numbers were decided, shape (samples, n).
        constraint_margin: The margin of A(x), Assumption (2); None without constraints.
        control_margin: The margin of B(x), Assumption (5).
    """

    system: DaeSystem
    constraint_degrees: tuple[int, ...]
    output_degrees: tuple[int, ...]
    manifold: Manifold
    derivatives: Derivatives
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
    def layout(self) -> Layout:
        """How references and output chains are stacked."""
        return Layout(self.output_degrees)

    @property
    def output_order(self) -> tuple[int, ...]:
        """The outputs in the paper's order (15): those with mu_i >= 1 first."""
        return (*map(int, self.layout.dynamic), *map(int, self.layout.direct))

    @property
    def index(self) -> int:
        """max r_i + 1, the index of the DAE; 0 without constraints."""
        return max(self.constraint_degrees) + 1 if self.constraint_degrees else 0

    @property
    def num_dynamic_outputs(self) -> int:
        """s of (15), the number of outputs with mu_i >= 1."""
        return len(self.layout.dynamic)

    @property
    def zero_dynamics_dimension(self) -> int:
        """The dimension of xi in (22), n - sum r_i - sum mu_i."""
        return self.manifold.dimension - self.layout.chain_size

    @property
    def chain(self) -> ca.SX:
        """The output chains below each other, as `layout` stacks them, shape (sum mu_i, 1)."""
        return ca.vertcat(ca.SX(0, 1), *[e for chain in self.output_chains for e in chain])

    def control_for(self, wanted: ca.SX) -> tuple[ca.SX, ca.SX]:
        """u = B(x)^-1 (-a(x) + wanted), for which z_i^(mu_i) = wanted_i on N*.

        Args:
            wanted: ubar of (28), shape (p, 1).

        Returns:
            u, shape (p, 1), and a scalar that is 0 exactly where it is not determined.
        """
        found = self.derivatives.inverse(self.highest_derivatives, wanted)
        if found is None:  # L_h* of an output vanishes, but not by structure.
            factors = Factorization(self.control_matrix)
            found = factors.solve(wanted - self.drift), factors.pivot
        control, pivot = found
        if self.chains_need_force:
            pivot = ca.fmin(pivot, self.elimination.pivot)
        return control, pivot

    def trace(self, name: str, value: ca.SX, needs_control: bool) -> TracedFunction:
        """An expression on N* as a function of state, control and parameters.

        Args:
            name: What it is, for messages.
            value: An expression of the state and of the control `derivatives.control`.
            needs_control: Whether the function takes the control; without one it is put to 0.

        Returns:
            A function with the output "value", and with A(x) as the matrix that must be regular.
        """
        control = self.derivatives.control
        inputs = {"control": control}
        if not needs_control:
            value = ca.substitute(value, inputs.pop("control"), ca.SX.zeros(control.numel()))
        pivot = self.elimination.pivot
        return self.system.trace(name, {"value": value}, inputs, pivot, "A(x) of Assumption (2)")


@checked(ModelError)
def find_structure(
    system: DaeSystem, *, spread: ArrayLike | None = None, count: int = 12, seed: int = 0
) -> Structure:
    """Finds relative degrees, A(x), B(x) and checks Assumptions (1)-(5).

    Whether an expression is zero is decided by its structure first, then by its numbers at
    consistent states drawn around `system.nominal_state`, with the default parameters.

    Args:
        system: The system (1)-(3).
        spread: The standard deviation of the drawn states around the nominal one, a number for all
            or shape (n,); `DaeSystem.nominal_spread` if None.
        count: How many states are drawn, at least 1.
        seed: The seed of the random numbers.

    Raises:
        AssumptionError: An assumption is violated; the exception has the state where.
        InconsistentStateError: There is no consistent state near the nominal one.
        ModelError: There is no control input, a function is not finite at the nominal state, the
            mass matrix is not symmetric and positive definite, or count or spread make no sense.
    """
    structure, violation = examine_structure(system, spread=spread, count=count, seed=seed)
    if violation:
        raise violation.error()
    return structure


def structure_of(owner: str, system: DaeSystem, structure: Structure | None) -> Structure:
    """The structure of a system, as given, or found where it is not known yet.

    Args:
        owner: Who needs it, for messages.
        system: The system (1)-(3).
        structure: The structure, or None to find it.

    Raises:
        AssumptionError, InconsistentStateError: There is no structure; see `find_structure`.
        ModelError: This is no system, or the structure is that of another one.
    """
    if structure is None:
        return find_structure(system)
    if not isinstance(structure, Structure):
        raise ModelError(
            f"{owner}: structure must be what find_structure returns, got "
            f"{type(structure).__name__}"
        )
    if structure.system is not system:
        raise ModelError(
            f"{owner}: the structure is that of another system, '{structure.system.name}' and not "
            f"'{system.name}'; leave it out, or pass find_structure of this one"
        )
    return structure


def examine_structure(
    system: DaeSystem, *, spread: ArrayLike | None = None, count: int = 12, seed: int = 0
) -> tuple[Structure, Violation | None]:
    """Finds the structure as `find_structure` does, but also where B(x) is singular.

    Returns:
        The structure, and how B(x) violates Assumption (4) or (5); None if it does not.

    Raises:
        AssumptionError: There is no B(x), since one of Assumptions (1)-(3) is violated or an
            output has no degree.
        InconsistentStateError, ModelError: There is no structure to find; see `find_structure`.
    """
    check_system(system)
    check_whole_number(f"{system.name}: count", count, 1)
    check_whole_number(f"{system.name}: seed", seed, 0)
    constrained = examine_constraints(system, draw(system, spread, count, seed))
    violation = constraint_violation(constrained)
    if violation:
        raise violation.error()
    structure = examine_outputs(constrained)
    degrees, margin = structure.output_degrees, structure.control_margin
    return structure, control_violation(system, degrees, margin)


def examine_outputs(constrained: Constrained) -> Structure:
    """Finds mu_1, ..., mu_p and B(x), where A(x) is regular.

    Raises:
        AssumptionError: Assumption (4) is violated, or no control acts on an output. A singular
            B(x) is left to `control_violation`.
        ModelError: A function is not finite.
    """
    samples, elimination = constrained.samples, constrained.elimination
    outputs = output_chains(constrained.derivatives, elimination, samples)
    degrees = tuple(len(chain) for chain in outputs.chains)
    # Rows of n* that are zero but for round-off are no feedthrough.
    n_star = [
        ca.SX(1, samples.system.num_controls) if degree else elimination.n_star[i, :]
        for i, degree in enumerate(degrees)
    ]
    return Structure(
        system=samples.system,
        constraint_degrees=constrained.degrees,
        output_degrees=degrees,
        manifold=samples.manifold,
        derivatives=constrained.derivatives,
        elimination=replace(elimination, n_star=ca.vertcat(*n_star)),
        output_chains=outputs.chains,
        highest_derivatives=outputs.highest_derivatives,
        drift=outputs.drift,
        control_matrix=outputs.control_matrix,
        chains_need_force=outputs.need_force,
        round_off=outputs.round_off,
        states=samples.states,
        constraint_margin=constrained.margin,
        control_margin=find_margin(samples, outputs.control_matrix, outputs.round_off),
    )


def control_violation(
    system: DaeSystem, degrees: Sequence[int], margin: Margin
) -> Violation | None:
    """How a singular B(x) violates Assumption (4) or (5); None if it is regular."""
    causes = ((4, Cause.OUTPUT_DEGREE), (5, Cause.CONTROL_RANK))
    return rank_violation(margin, system.output_signals, degrees, *causes)
