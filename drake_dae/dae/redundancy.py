"""Systems without their redundant constraints: whose forces go, or are shared by least squares."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import Booleans, FloatArray
from drake_dae.arrays import positive as positive_number
from drake_dae.dae.assumptions import redundant_constraints
from drake_dae.dae.manifold import Manifold
from drake_dae.dae.samples import Samples, draw
from drake_dae.dae.signals import places_of
from drake_dae.dae.system import DaeSystem, ForceSharing
from drake_dae.errors import ModelError
from drake_dae.trace.factorization import PositiveDefiniteFactorization
from drake_dae.trace.numerics import equilibrated, rank_of, significant, without_round_off

# The next constraint to keep is the first whose independence of those already kept is at least
# this fraction of the best.
PREFERRED = 0.5


@checked(ModelError)
def drop_constraints(system: DaeSystem, names: Sequence[str] | None = None) -> DaeSystem:
    """Returns a system with the same motion in which redundant constraints are removed.

    A constraint goes with the constraint input of the same number. The inputs that remain act in
    all directions in which those that go did; their forces depend on the choice, since only the
    sum g(x) v is determined by (1)-(3).

    Args:
        system: The system (1)-(3).
        names: The constraints to leave out; if None those whose gradients follow from those before
            them, at all consistent states drawn around the nominal one.

    Raises:
        InconsistentStateError: There is no consistent state near the nominal one.
        ModelError: No constraint has that name; or one that is left out is not redundant, its input
            acts in an independent direction, or an output is its force.
    """
    samples = all_constraints_hold(system)
    if names is None:
        names = [combination.name for combination in redundant_constraints(samples)]
    kept, left_out = _split(system, names)
    if not left_out:
        return system
    gone = _check_same_motion(samples, kept, left_out)
    if system.m[:, left_out].nnz():
        raise ModelError(
            f"{system.name}: an output is the force of {gone}, which is not determined where "
            "constraints are redundant; choose other outputs, or leave out other constraints"
        )
    return with_constraints(system, kept)


@checked(ModelError)
def share_forces(
    system: DaeSystem,
    names: Sequence[str] | None = None,
    *,
    compliances: Mapping[str, float] | None = None,
) -> DaeSystem:
    """Removes redundant constraints and distributes the forces among all by least squares.

    On N* the input of a constraint that is left out acts as a combination of those that stay, E^-1
    g_out = E^-1 g D: the motion follows from v = v_stay + D v_out alone. The reported split
    v_all = (v_stay, v_out) has the least sum of c_i v_i^2,

        v_all = T v,   T = C^-1 G^T (G C^-1 G^T)^-1,   G = [1, D],   C = diag(c_1, ..., c_M),

    and does not depend on which constraints are kept. It is physical if the c_i are the compliances
    of the constrained parts, in m/N or rad/(N m): stiff springs in place of the constraints share a
    slowly changing force in this way (Menabrea 1858). Only ratios matter.

    The system has the constraints that stay, and its `sharing` shows the forces of all on the port
    `constraint_force` of a plant. Those that are kept must stay independent along the whole motion,
    otherwise A(x) becomes singular; then keep others.

    Args:
        system: The system (1)-(3).
        names: The constraints to leave out; if None as many as are redundant at all consistent
            states drawn around the nominal one, so that those that stay are well independent.
        compliances: Name of a constraint input -> c_i, for those where it is not 1.

    Raises:
        ModelError: As of `drop_constraints`; or a compliance is not positive, or an output is not a
            function of the sum G v_all, and so not determined.
    """
    weights, own = np.ones(system.num_constraints), compliances or {}
    signals, owner = system.constraint_input_signals, f"{system.name}: "
    for name, i in zip(own, places_of("constraint force", own, signals, owner), strict=True):
        weights[i] = positive_number(f"{owner}the compliance of '{name}'", own[name])
    samples = all_constraints_hold(system)
    kept, left_out = _independent(samples) if names is None else _split(system, names)
    if not left_out:
        return system
    _check_same_motion(samples, kept, left_out)
    inertia = PositiveDefiniteFactorization(system.mass_matrix)
    half = inertia.forward(system.g)
    product = ca.sparsify(ca.mtimes(inertia.scaled(half).T, half))
    gather = ca.SX(len(kept), system.num_constraints)
    gather[:, kept] = ca.SX.eye(len(kept))
    gather[:, left_out] = PositiveDefiniteFactorization(product[kept, kept]).solve(
        product[kept, left_out]
    )
    weighted = ca.mtimes(ca.diag(ca.SX(1.0 / weights)), gather.T)
    sum_of = PositiveDefiniteFactorization(ca.sparsify(ca.mtimes(gather, weighted)))
    split = sum_of.solve(ca.densify(weighted.T)).T
    sharing = ForceSharing(
        split=split,
        signals=system.constraint_input_signals,
        undetermined=_undetermined(samples, gather, split),
        left_out=system.k[left_out],
        left_out_signals=tuple(system.constraint_output_signals[i] for i in left_out),
    )
    return replace(with_constraints(system, kept), sharing=sharing)


def manifold_of_left_out(system: DaeSystem) -> Manifold | None:
    """Returns the states at which the removed redundant constraints hold; None without any."""
    sharing = system.sharing
    if sharing is None:
        return None
    count = len(sharing.left_out_signals)
    alone = replace(
        system,
        k=sharing.left_out,
        g=ca.SX(system.num_states, count),
        m=ca.SX(system.num_outputs, count),
        constraint_input_signals=(),
        constraint_output_signals=sharing.left_out_signals,
        implicit=None,
        sharing=None,
    )
    return Manifold(alone, [[row] for row in ca.vertsplit(sharing.left_out)])


def all_constraints_hold(system: DaeSystem) -> Samples:
    """Returns random states around the nominal state at which all constraints k_i hold."""
    alone = Manifold(system, [[row] for row in ca.vertsplit(system.k)])
    return Samples(alone, draw(system, None, 12, 0))


def _split(system: DaeSystem, names: Sequence[str]) -> tuple[list[int], list[int]]:
    """The indices of the constraints that stay, and of those that are named."""
    signals = system.constraint_output_signals
    left_out = set(places_of("constraint", names, signals, f"{system.name}: "))
    return [i for i in range(len(signals)) if i not in left_out], sorted(left_out)


def _independent(samples: Samples) -> tuple[list[int], list[int]]:
    """The indices of constraints that are well independent at all samples, and of the others."""
    values = samples.values(gradient=ca.jacobian(samples.system.k, samples.system.state))
    scaled = [gradient * samples.system.scale for (gradient,) in values]
    remainders = [equilibrated(gradient) for gradient in scaled]
    kept: list[int] = []
    while len(kept) < min(map(rank_of, scaled)):
        independence = np.min([np.linalg.norm(matrix, axis=1) for matrix in remainders], axis=0)
        independence[kept] = 0.0
        chosen = int(np.argmax(independence >= PREFERRED * independence.max()))
        kept.append(chosen)
        for matrix in remainders:
            direction = matrix[chosen] / np.linalg.norm(matrix[chosen])
            matrix -= np.outer(matrix @ direction, direction)
    return sorted(kept), [i for i in range(samples.system.num_constraints) if i not in kept]


def _check_same_motion(samples: Samples, kept: list[int], left_out: list[int]) -> str:
    """Raises ModelError if the motion changes without some constraints; returns their names."""
    system = samples.system
    gone = ", ".join(f"'{system.constraint_output_signals[i].name}'" for i in left_out)
    moving = ca.vertcat(ca.SX(0, 1), *[p.symbol for p in system.exogenous.moving])
    gradients = samples.values(
        gradient=ca.jacobian(system.k, system.state), moved=ca.jacobian(system.k, moving)
    )
    names = ", ".join(f"'{signal.name}'" for signal in system.exogenous.signals)
    for (by_state, moved), fields in zip(gradients, samples.fields, strict=True):
        gradient = by_state * system.scale
        checks = {
            "its gradients are not combinations of those of the remaining constraints": gradient,
            f"where the exogenous signals {names} move, the constraints left out are no longer "
            "implied by the remaining ones": np.hstack([gradient, moved]),
            "its columns of g are not combinations of the remaining columns": fields["g"].T
            / system.scale,
        }
        for why, rows in checks.items():
            if rank_of(significant(rows)[kept]) < rank_of(rows):
                raise ModelError(f"{system.name}: {gone} cannot be left out: {why}")
    return gone


def with_constraints(system: DaeSystem, kept: list[int]) -> DaeSystem:
    """The system with only some of its constraints and their inputs."""

    def implicit(rate: ca.SX, constraint_input: ca.SX) -> tuple[ca.SX, ca.SX]:
        every = ca.SX(system.num_constraints, 1)
        every[kept] = constraint_input
        rest, constraint_rate = system.implicit(rate, every)  # type: ignore[misc]
        return rest, constraint_rate[kept]

    signals = tuple(system.constraint_input_signals[i] for i in kept)
    names = {signal.name for signal in signals}
    return replace(
        system,
        g=system.g[:, kept],
        k=system.k[kept],
        m=system.m[:, kept],
        contacts=tuple(contact for contact in system.contacts if contact.force in names),
        constraint_input_signals=signals,
        constraint_output_signals=tuple(system.constraint_output_signals[i] for i in kept),
        implicit=implicit if system.implicit else None,
    )


def _undetermined(samples: Samples, gather: ca.SX, split: ca.SX) -> tuple[str, ...]:
    """The constraint inputs that are not determined; raises ModelError if an output is not."""
    system = samples.system

    def changes(rows: FloatArray, gather: FloatArray, split: FloatArray) -> Booleans:
        """The rows S of S v_all that are not determined by G v_all: S is not S T G."""
        sized = np.abs(rows) + np.abs(rows) @ np.abs(split) @ np.abs(gather)
        changed, _ = without_round_off(rows - rows @ split @ gather, sized)
        return np.asarray(changed.any(axis=1))

    free = np.zeros(system.num_constraints, dtype=bool)
    for m, g, t in samples.values(m=system.m, gather=gather, split=split):
        free |= changes(np.eye(system.num_constraints), g, t)
        outputs = zip(system.output_signals, changes(m, g, t), strict=True)
        if bad := [signal.name for signal, is_free in outputs if is_free]:
            raise ModelError(
                f"{system.name}: the output {', '.join(bad)} is not determined: the distribution "
                "of forces among redundant constraints does not affect the motion, and no "
                "control affects it. Choose other outputs; sums of the redundant forces are "
                "determined"
            )
    signals = system.constraint_input_signals
    return tuple(signal.name for signal, is_free in zip(signals, free, strict=True) if is_free)
