"""The forces of redundant constraints, shared by least squares."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import Booleans, FloatArray, unknown_name
from drake_dae.dae.manifold.manifold import Manifold
from drake_dae.dae.states.samples import Samples
from drake_dae.dae.structure.redundancy import (
    check_same_motion,
    consistent_samples,
    constraints_kept,
    independent_constraints,
    with_constraints,
)
from drake_dae.dae.system.sharing import ForceSharing
from drake_dae.dae.system.system import DaeSystem
from drake_dae.errors import ModelError
from drake_dae.trace.factorization import PositiveDefiniteFactorization
from drake_dae.trace.round_off import without_round_off


@checked(ModelError)
def share_forces(
    system: DaeSystem,
    names: Sequence[str] | None = None,
    *,
    compliances: Mapping[str, float] | None = None,
) -> DaeSystem:
    """Removes redundant constraints and distributes the forces among all by least squares.

    On N* the input of a constraint that is left out acts as a combination of those that stay, E^-1
    g_out = E^-1 g D, so that the motion follows from v = v_stay + D v_out alone, and all v_all =
    (v_stay, v_out) with one v move the system in the same way: the split among redundant
    constraints is not determined by (1)-(3). The reported split has the least sum of c_i v_i^2,

        v_all = T v,   T = C^-1 G^T (G C^-1 G^T)^-1,   G = [1, D],   C = diag(c_1, ..., c_M),

    and does not depend on which constraints are kept. It is physical if the c_i are the compliances
    of the constrained parts, in m/N or rad/(N m): stiff springs in place of the constraints share a
    slowly changing force in this way (Menabrea 1858). Only ratios matter. With all c_i = 1, the
    default, stiffnesses are equal in SI units, which means little if forces and moments are
    redundant together.

    The system has the constraints that stay, and its `sharing` shows the forces of all on the port
    `constraint_force` of a plant. Those that are kept must stay independent along the whole motion,
    otherwise A(x) becomes singular; then keep others.

    Args:
        system: The system (1)-(3).
        names: The constraints to leave out; if None as many as are redundant at all consistent
            states drawn around the nominal one, so that those that stay are well independent.
        compliances: Name of a constraint input -> c_i, for those where it is not 1.

    Returns:
        The system; the same one if nothing is redundant.

    Raises:
        InconsistentStateError: There is no consistent state near the nominal one.
        ModelError: There is no such constraint or constraint input; a compliance is not positive; a
            constraint that is left out is not redundant, or its input acts in an independent
            direction; or an output is not a function of the sum G v_all, and so not determined.
    """
    weights = _weights(system, compliances or {})
    samples = consistent_samples(system)
    remaining = (
        independent_constraints(samples) if names is None else constraints_kept(system, names)
    )
    if len(remaining) == system.num_constraints:
        return system
    left_out = [i for i in range(system.num_constraints) if i not in remaining]
    signals = system.constraint_output_signals
    check_same_motion(samples, remaining, ", ".join(f"'{signals[i].name}'" for i in left_out))
    inertia = PositiveDefiniteFactorization(system.mass_matrix)
    half = inertia.forward(system.g)
    product = ca.sparsify(ca.mtimes(inertia.scaled(half).T, half))
    gather = ca.SX(len(remaining), system.num_constraints)
    gather[:, remaining] = ca.SX.eye(len(remaining))
    gather[:, left_out] = PositiveDefiniteFactorization(product[remaining, remaining]).solve(
        product[remaining, left_out]
    )
    weighted = ca.mtimes(ca.diag(ca.SX(1.0 / weights)), gather.T)
    sum_of = PositiveDefiniteFactorization(ca.sparsify(ca.mtimes(gather, weighted)))
    split = sum_of.solve(ca.densify(weighted.T)).T
    sharing = ForceSharing(
        split=split,
        gather=gather,
        signals=system.constraint_input_signals,
        undetermined=_undetermined(samples, gather, split),
        left_out=system.k[left_out],
        left_out_signals=tuple(signals[i] for i in left_out),
    )
    return replace(with_constraints(system, remaining), sharing=sharing)


def manifold_of_left_out(system: DaeSystem) -> Manifold | None:
    """Returns the states at which the removed redundant constraints hold; None without any.

    It contains N*, and possibly states of another assembly mode.
    """
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


def _weights(system: DaeSystem, compliances: Mapping[str, float]) -> FloatArray:
    """The compliances of all constraint inputs, shape (M,)."""
    names = [signal.name for signal in system.constraint_input_signals]
    weights = np.ones(len(names))
    for name, value in compliances.items():
        if name not in names:
            raise ModelError(f"{system.name}: {unknown_name('constraint force', name, names)}")
        if not value > 0.0:
            raise ModelError(
                f"{system.name}: the compliance of '{name}' must be positive, got {value}"
            )
        weights[names.index(name)] = value
    return weights


def _undetermined(samples: Samples, gather: ca.SX, split: ca.SX) -> tuple[str, ...]:
    """The constraint inputs that are not determined."""
    system = samples.system
    every = np.eye(system.num_constraints)
    free = np.zeros(system.num_constraints, dtype=bool)
    for m, g, t in samples.values(m=system.m, gather=gather, split=split):
        free |= _changes(every, g, t)
        bad = [
            signal.name
            for signal, changes in zip(system.output_signals, _changes(m, g, t), strict=True)
            if changes
        ]
        if bad:
            raise ModelError(
                f"{system.name}: the output {', '.join(bad)} is not determined: the distribution "
                "of forces among redundant constraints does not affect the motion, and no "
                "control affects it. Choose other outputs; sums of the redundant forces are "
                "determined"
            )
    signals = system.constraint_input_signals
    return tuple(signal.name for signal, is_free in zip(signals, free, strict=True) if is_free)


def _changes(rows: FloatArray, gather: FloatArray, split: FloatArray) -> Booleans:
    """The rows S of S v_all that are not determined by G v_all: S is not S T G."""
    sized = np.abs(rows) + np.abs(rows) @ np.abs(split) @ np.abs(gather)
    changed, _ = without_round_off(rows - rows @ split @ gather, sized)
    return np.asarray(changed.any(axis=1))
