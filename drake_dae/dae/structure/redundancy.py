"""A system without its redundant constraints."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.dae.manifold import Manifold
from drake_dae.dae.states.samples import Samples, draw
from drake_dae.dae.structure.dependence import redundant_constraints
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import ModelError
from drake_dae.trace.newton import DEPENDENT
from drake_dae.trace.round_off import equilibration


@checked(ModelError)
def drop_constraints(system: DaeSystem, names: Sequence[str] | None = None) -> DaeSystem:
    """The same motion with fewer constraints: those that follow from others are left out.

    A constraint goes with the constraint input of the same number. The motion is the same, since
    the inputs that remain act in all directions in which those that go did. What the forces of the
    remaining constraints are is a choice: the split among redundant ones is not determined by
    (1)-(3), and another choice has other forces with the same sum g(x) v.

    Args:
        system: The system (1)-(3).
        names: The constraints to leave out; if None those whose gradients follow from those before
            them, at all consistent states drawn around the nominal one.

    Raises:
        InconsistentStateError: There is no consistent state near the nominal one.
        ModelError: No constraint has that name; or one that goes does not follow from those that
            stay, its input acts in a direction of its own, or an output is its force.
    """
    signals = [signal.name for signal in system.constraint_output_signals]
    heads = [[system.k[i]] for i in range(system.num_constraints)]
    samples = Samples(Manifold(system, heads), draw(system, None, 12, 0))
    if names is None:
        names = [combination.name for combination in redundant_constraints(samples)]
    for name in names:
        if name not in signals:
            raise ModelError(f"{system.name}: {unknown_name('constraint', name, signals)}")
    kept = [i for i, name in enumerate(signals) if name not in names]
    if len(kept) == len(signals):
        return system
    _check_same_motion(samples, kept, ", ".join(f"'{name}'" for name in names))
    return replace(
        system,
        g=system.g[:, kept],
        k=system.k[kept],
        m=system.m[:, kept],
        constraint_input_signals=tuple(system.constraint_input_signals[i] for i in kept),
        constraint_output_signals=tuple(system.constraint_output_signals[i] for i in kept),
        implicit=_fewer(system, kept),
    )


def _check_same_motion(samples: Samples, kept: list[int], gone: str) -> None:
    """Refuses to leave out what the remaining constraints do not replace."""
    system = samples.system
    others = [i for i in range(system.num_constraints) if i not in kept]
    if system.m[:, others].nnz():
        raise ModelError(
            f"{system.name}: an output is the force of {gone}, which is not determined where "
            "constraints are redundant; choose other outputs, or leave out other constraints"
        )
    gradients = samples.values(gradient=ca.jacobian(system.k, system.state))
    for (gradient,), fields in zip(gradients, samples.fields, strict=True):
        if _rank(gradient[kept]) < _rank(gradient):
            raise ModelError(
                f"{system.name}: {gone} cannot be left out: the gradients of the constraints that "
                "stay do not hold that of each one that goes"
            )
        if _rank(fields["g"].T[kept]) < _rank(fields["g"].T):
            raise ModelError(
                f"{system.name}: {gone} cannot be left out: the constraint inputs of the same "
                "numbers act in directions in which no other one does"
            )


def _rank(matrix: FloatArray) -> int:
    rows, columns = equilibration(matrix)
    scaled = matrix / rows[:, None] / columns
    return int(np.linalg.matrix_rank(scaled, DEPENDENT)) if matrix.size else 0


def _fewer(
    system: DaeSystem, kept: list[int]
) -> Callable[[ca.SX, ca.SX], tuple[ca.SX, ca.SX]] | None:
    """The shorter form of a system, where it has one, of the inputs and outputs that stay."""
    whole = system.implicit
    if whole is None:
        return None

    def implicit(rate: ca.SX, constraint_input: ca.SX) -> tuple[ca.SX, ca.SX]:
        every = ca.SX(system.num_constraints, 1)
        every[kept] = constraint_input
        rest, constraint_rate = whole(rate, every)
        return rest, constraint_rate[kept]

    return implicit
