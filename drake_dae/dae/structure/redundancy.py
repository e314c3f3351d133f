"""Which constraints are redundant, and a system without them."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.dae.manifold.manifold import Manifold
from drake_dae.dae.states.samples import Samples, draw
from drake_dae.dae.structure.dependence import Combination, redundant_constraints
from drake_dae.dae.system.system import DaeSystem
from drake_dae.errors import InconsistentStateError, ModelError
from drake_dae.trace.newton import DEPENDENT, ROUND_OFF
from drake_dae.trace.round_off import FLOOR, equilibrated, positive, rank_of, significant

SEARCH = 200
"""The largest number of steps to a state where all constraints hold; a dozen are enough."""

PREFERRED = 0.5
"""The next constraint to keep is the first whose independence of those already kept is at least
this fraction of the best."""


@checked(ModelError)
def drop_constraints(system: DaeSystem, names: Sequence[str] | None = None) -> DaeSystem:
    """Returns a system with the same motion in which redundant constraints are removed.

    A constraint goes with the constraint input of the same number. The motion is the same, since
    the inputs that remain act in all directions in which those that go did. The forces of the
    remaining constraints depend on this choice: the split among redundant constraints is not
    determined by (1)-(3), only the sum g(x) v is.

    Args:
        system: The system (1)-(3).
        names: The constraints to leave out; if None those whose gradients follow from those before
            them, at all consistent states drawn around the nominal one.

    Raises:
        InconsistentStateError: There is no consistent state near the nominal one.
        ModelError: No constraint has that name; or one that is left out is not redundant, its input
            acts in an independent direction, or an output is its force.
    """
    samples = consistent_samples(system)
    if names is None:
        names = [combination.name for combination in redundant_constraints(samples)]
    remaining = constraints_kept(system, names)
    if len(remaining) == system.num_constraints:
        return system
    gone = ", ".join(f"'{name}'" for name in names)
    if system.m[:, [i for i in range(system.num_constraints) if i not in remaining]].nnz():
        raise ModelError(
            f"{system.name}: an output is the force of {gone}, which is not determined where "
            "constraints are redundant; choose other outputs, or leave out other constraints"
        )
    check_same_motion(samples, remaining, gone)
    return with_constraints(system, remaining)


def find_redundant(system: DaeSystem) -> tuple[Combination, ...]:
    """Returns the constraints that depend on earlier ones at all states near the nominal state."""
    try:
        return redundant_constraints(consistent_samples(system))
    except InconsistentStateError:
        return ()


def consistent_samples(system: DaeSystem) -> Samples:
    """Returns random states around the nominal state at which all constraints k_i hold."""
    return Samples(_Redundant(system), draw(system, None, 12, 0))


class _Redundant(Manifold):
    """The states at which all constraints k_i hold, including redundant ones.

    Near these states the gradients of redundant constraints are nearly dependent, so that Newton
    steps become very long or lead to a singular configuration. Levenberg-Marquardt steps with a
    damping as large as the residual stay short and still converge quadratically (Yamashita and
    Fukushima 2001).
    """

    def __init__(self, system: DaeSystem) -> None:
        super().__init__(system, [[row] for row in ca.vertsplit(system.k)])

    def project(
        self,
        state: ArrayLike,
        parameters: ArrayLike | None = None,
    ) -> FloatArray:
        scale = self.system.scale
        z = self.system.state_vector(state) / scale
        gradients = self.gradients(scale * z, parameters) * scale
        length = np.linalg.norm(gradients, axis=1)
        largest = float(np.max(length, initial=0.0))
        length = positive(np.where(length > FLOOR * largest, length, largest))
        residual = self.residual(scale * z, parameters) / length
        damping = 1.0
        for _ in range(SEARCH):
            size = float(np.linalg.norm(residual))
            u, s, v = np.linalg.svd(gradients / length[:, None], full_matrices=False)
            step = (u.T @ residual) * s / positive(s * s + damping * size) @ v
            following = self.residual(scale * (z - step), parameters) / length
            if not np.linalg.norm(following) < size:
                if size <= ROUND_OFF * (1.0 + np.linalg.norm(z)):
                    return np.asarray(scale * z)
                damping *= 4.0
                continue
            z, residual, damping = z - step, following, 1.0
            gradients = self.gradients(scale * z, parameters) * scale
        raise InconsistentStateError(
            f"{self.system.name}: no state found near the given one at which all constraints hold",
            residual * length,
        )


def constraints_kept(system: DaeSystem, names: Sequence[str]) -> list[int]:
    """Returns the indices of the constraints whose names are not listed."""
    signals = [signal.name for signal in system.constraint_output_signals]
    for name in names:
        if name not in signals:
            raise ModelError(f"{system.name}: {unknown_name('constraint', name, signals)}")
    return [i for i, name in enumerate(signals) if name not in names]


def independent_constraints(samples: Samples) -> list[int]:
    """Selects constraints that are well independent of each other at all sampled states."""
    values = samples.values(gradient=ca.jacobian(samples.system.k, samples.system.state))
    scale = samples.system.scale
    remainders = [equilibrated(significant(gradient * scale)) for (gradient,) in values]
    most = min(rank_of(gradient * scale, DEPENDENT) for (gradient,) in values)
    remaining: list[int] = []
    while len(remaining) < most:
        independence = np.min([np.linalg.norm(matrix, axis=1) for matrix in remainders], axis=0)
        independence[remaining] = 0.0
        chosen = int(np.argmax(independence >= PREFERRED * independence.max()))
        remaining.append(chosen)
        for matrix in remainders:
            direction = matrix[chosen] / np.linalg.norm(matrix[chosen])
            matrix -= np.outer(matrix @ direction, direction)
    return sorted(remaining)


def with_constraints(system: DaeSystem, remaining: list[int]) -> DaeSystem:
    """Returns a system with only some of its constraints and their inputs."""
    signals = tuple(system.constraint_input_signals[i] for i in remaining)
    names = {signal.name for signal in signals}
    return replace(
        system,
        g=system.g[:, remaining],
        k=system.k[remaining],
        m=system.m[:, remaining],
        contacts=tuple(contact for contact in system.contacts if contact.force in names),
        constraint_input_signals=signals,
        constraint_output_signals=tuple(system.constraint_output_signals[i] for i in remaining),
        implicit=_fewer(system, remaining),
    )


def check_same_motion(samples: Samples, remaining: list[int], gone: str) -> None:
    """Checks that the motion does not change if some constraints are removed."""
    system = samples.system
    moving = ca.vertcat(ca.SX(0, 1), *[p.symbol for p in system.exogenous.moving])
    gradients = samples.values(
        gradient=ca.jacobian(system.k, system.state), moved=ca.jacobian(system.k, moving)
    )
    for (by_state, moved), fields in zip(gradients, samples.fields, strict=True):
        gradient = by_state * system.scale
        if _is_less(gradient, remaining):
            raise ModelError(
                f"{system.name}: {gone} cannot be left out: its gradients are not combinations of "
                "the gradients of the remaining constraints"
            )
        if _is_less(np.hstack([gradient, moved]), remaining):
            names = ", ".join(f"'{signal.name}'" for signal in system.exogenous.signals)
            raise ModelError(
                f"{system.name}: {gone} cannot be left out: where the exogenous signals {names} "
                "move, the constraints left out are no longer implied by the remaining ones"
            )
        if _is_less(fields["g"].T / system.scale, remaining):
            raise ModelError(
                f"{system.name}: {gone} cannot be left out: its columns of g are not combinations "
                "of the remaining columns"
            )


def _is_less(rows: FloatArray, remaining: list[int]) -> bool:
    """Whether some rows of a matrix have a smaller rank than all of them."""
    rows = significant(rows)
    return rank_of(rows[remaining], DEPENDENT) < rank_of(rows, DEPENDENT)


def _fewer(
    system: DaeSystem, remaining: list[int]
) -> Callable[[ca.SX, ca.SX], tuple[ca.SX, ca.SX]] | None:
    """The implicit form of a system, if it has one, for the remaining inputs and outputs."""
    whole = system.implicit
    if whole is None:
        return None

    def implicit(rate: ca.SX, constraint_input: ca.SX) -> tuple[ca.SX, ca.SX]:
        every = ca.SX(system.num_constraints, 1)
        every[remaining] = constraint_input
        rest, constraint_rate = whole(rate, every)
        return rest, constraint_rate[remaining]

    return implicit
