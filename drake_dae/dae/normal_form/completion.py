"""The completion of the constraint chains and the output chains: xi = Psi_2(x).      (22)"""

from collections.abc import Iterator, Sequence

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray, show
from drake_dae.dae.states.margins import RankMargin, find_margin
from drake_dae.dae.states.samples import Samples
from drake_dae.dae.structure.structure import Structure
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError
from drake_dae.trace.round_off import unit_rows
from drake_dae.trace.smoothness import find_flaw

TRANSVERSAL = 0.05
"""Single states complete the chains if the sine of their smallest angle is above this."""


Completion = tuple[ca.SX, tuple[Signal, ...], RankMargin]
"""xi, its signals, and the margin of the Jacobian of Phi."""


def check_completion(
    structure: Structure, chains: ca.SX, samples: Samples, xi: ca.SX
) -> Completion:
    """The user's completion, with its signals and its margin."""
    system, count = structure.system, structure.zero_dynamics_dimension
    if not isinstance(xi, ca.SX) or xi.shape != (count, 1):
        got = f"shape {xi.shape}" if isinstance(xi, ca.SX) else type(xi).__name__
        raise ModelError(
            f"{system.name}: the completion must be a CasADi SX column of {count} expressions, "
            f"n - sum r_i - sum mu_i; got {got}"
        )
    allowed = ca.vertcat(system.state, system.parameter_symbol)
    unknown = [s.name() for s in ca.symvar(xi) if not ca.depends_on(allowed, s)]
    if unknown:
        raise ModelError(
            f"{system.name}: the completion xi of the coordinates depends on "
            f"{', '.join(unknown)}, which is neither a state nor a parameter"
        )
    flaw = find_flaw(xi, system.state, system.parameter_symbol)
    if flaw:
        raise ModelError(f"{system.name}: the completion {flaw.describe('the state')}")
    signals = tuple(
        next(
            (
                signal
                for j, signal in enumerate(system.state_signals)
                if ca.is_equal(xi[i], system.state[j])
            ),
            Signal(f"xi{i}"),
        )
        for i in range(count)
    )
    gradient = ca.jacobian(ca.vertcat(chains, xi), system.state)
    margin = find_margin(samples, gradient)
    if not margin.is_singular:
        return xi, signals, margin
    if not count:
        raise ModelError(
            f"{system.name}: the differentials of the chains are dependent to round-off at x = "
            f"{show(margin.state)}: A(x) of Assumption (2) or B(x) of (16) is close to singular "
            "there"
        )
    # A row that vanishes at a state has no direction there; the others are compared by direction.
    worst = -1 if margin.vanishing_row is None else margin.vanishing_row - chains.numel()
    if worst < 0:
        # The distance of each differential from the span of those before it.
        rows = unit_rows(margin.matrix * samples.scale)
        worst = int(np.argmin(np.abs(np.diag(np.linalg.qr(rows.T)[1]))[-count:]))
    raise ModelError(
        f"{system.name}: the completion '{signals[worst].name}' = "
        f"{str(xi[worst])[:60]} is not independent of the chains and of the rest of the "
        f"completion at x = {show(margin.state)}; choose a function whose differential is not in "
        "their span at this state and around it"
    )


def choose_completion(structure: Structure, chains: ca.SX, samples: Samples) -> Completion:
    """Single states whose differentials complete those of the chains, or else linear combinations.

    They complete them if they are regular on the null spaces of the chains' differentials. The
    arguments are those of `check_completion`.
    """
    system, count = structure.system, structure.zero_dynamics_dimension
    if not count:
        return check_completion(structure, chains, samples, ca.SX(0, 1))
    gradients = samples.values(gradient=ca.jacobian(chains, system.state))
    spaces = np.array(
        [np.linalg.svd(unit_rows(g * samples.scale))[2][-count:].T for (g,) in gradients]
    )
    for matrix in _candidates(spaces):
        matrix = matrix / samples.scale
        # Rounded, so that ties go to the first state on every machine.
        largest = np.argmax(np.round(unit_rows(np.abs(matrix)), 6), axis=1)
        leading = matrix[np.arange(count), largest]
        factors = np.vectorize(lambda c: float(f"{c:.3g}"))(matrix / leading[:, None])
        xi = ca.mtimes(ca.sparsify(ca.SX(factors)), system.state)
        margin = find_margin(samples, ca.jacobian(ca.vertcat(chains, xi), system.state))
        if not margin.is_singular:
            return xi, tuple(_combination(row, system.state_signals) for row in factors), margin
    raise ModelError(
        f"{system.name}: no linear combinations of states complete the chains (20) at all states "
        f"around the nominal one; give a completion of {count} expressions"
    )


def _candidates(spaces: FloatArray) -> Iterator[FloatArray]:
    """Combinations of states, shape (d, n), that are regular on all spaces, shape (k, n, d)."""
    count = spaces.shape[2]
    single = _pivots(spaces)
    if np.linalg.svd(spaces[:, single], compute_uv=False).min() > TRANSVERSAL:
        yield np.eye(spaces.shape[1])[single]
    # The space that is nearest to all of them, in the basis that is the identity on its pivots.
    mean = np.linalg.eigh(np.einsum("kid,kjd->ij", spaces, spaces))[1][:, -count:]
    basis = np.linalg.solve(mean[_pivots(mean[None])].T, mean.T)
    yield np.where(np.abs(basis) > 0.02, basis, 0.0)


def _pivots(spaces: FloatArray) -> list[int]:
    """States whose rows are far from dependent in all spaces: one QR with pivoting for all."""
    rest, chosen = spaces.copy(), []
    for _ in range(spaces.shape[2]):
        # Rounded, as above.
        chosen.append(int(np.argmax(np.round(np.linalg.norm(rest, axis=2).min(axis=0), 6))))
        direction = unit_rows(rest[:, chosen[-1]])
        rest -= np.einsum("kid,kd,ke->kie", rest, direction, direction)
    return sorted(chosen)


def _combination(factors: FloatArray, signals: Sequence[Signal]) -> Signal:
    """A signal named like the combination, such as "x0 - 0.5 x1"."""
    terms = [(c, signal) for c, signal in zip(factors, signals, strict=True) if c]
    units = {signal.unit for _, signal in terms}
    sign = {1.0: "", -1.0: "-"}
    name = " + ".join(sign.get(c, f"{c:.3g} ") + signal.name for c, signal in terms)
    return Signal(name.replace("+ -", "- "), units.pop() if len(units) == 1 else "")
