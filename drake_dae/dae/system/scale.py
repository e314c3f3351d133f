"""The natural sizes of the states of a system, from its equations.

No verdict may depend on the choice of units. So random states, searches and tolerances measure a
state relative to a size that changes with its unit.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from math import factorial, log, prod
from typing import NamedTuple

import casadi as ca
import numpy as np

from drake_dae.arrays import Booleans, FloatArray

ORDER = 3
"""Derivatives up to this order are compared. The size of a hanging pendulum appears in the
third."""

ENTRIES = 2000
"""An order with more derivatives than this is left out, as are the orders after it."""

OPERATIONS = 100_000
"""An order whose derivatives may take more operations than this is left out, too."""

SHARE = 0.5
"""The scale of a state as a fraction of the size at which the terms of the equations are equal."""

FAINT = 1e-3
"""The weight of constant terms, which depend on the nominal state: they decide where other terms do
not. The weight of nominal values is its square: they decide where nothing else does."""

NEGLIGIBLE = log(1e-10)
"""The logarithm of a term, relative to the largest of its equation, that may be round-off."""

ROUND_OFF = 1e-13
"""A coefficient below this, relative to the largest of its order and function, looks like round-off
in the units at hand: it is taken only if it turns out not to be negligible."""

SELECTIONS = 10
"""The largest number of selections of relevant terms; fewer if the selection does not change."""

REPETITIONS = 300
"""The largest number of reweighted least-squares iterations; fewer if they reach `CONVERGED`."""

CONVERGED = 1e-8
"""A change of the logarithms below this ends the repetitions."""

# Each function of (1)-(3): the equations that its rows belong to, and what its columns multiply.
_PARTS = (
    ("f", "dynamics", None),
    ("g", "dynamics", "constraint_input"),
    ("h", "dynamics", "control"),
    ("mass_matrix", "dynamics", "state"),
    ("k", "constraint", None),
    ("l", "output", None),
    ("m", "output", "constraint_input"),
)


class _Term(NamedTuple):
    """A term of a Taylor series: its entry (by columns) and the states that it multiplies."""

    entry: int
    states: tuple[int, ...]
    coefficient: float


class _Comparison(NamedTuple):
    """A term of an equation: unknowns @ logarithms of sizes + logarithm is to be near zero."""

    unknowns: FloatArray
    logarithm: float
    equation: int
    weight: float
    is_plain: bool


@np.errstate(all="ignore")  # Terms that are not finite are left out.
def natural_scale(
    functions: Mapping[str, ca.SX],
    state: ca.SX,
    parameters: tuple[ca.SX, FloatArray],
    nominal: FloatArray,
) -> FloatArray:
    """Computes half the state sizes for which the terms of the equations (1)-(3) are equally large.

    The equations are expanded in Taylor series around the nominal state. A term c x_i^a x_j^b has
    the size |c| s_i^a s_j^b, where s are the unknown sizes; a derivative x_i' has the size w s_i
    with a common rate w; inputs and equations have sizes of their own. The logarithms are linear in
    those of the unknowns, so that a fit makes the terms of each equation as alike as they can be.
    The sizes do not depend on the units of states, inputs and equations. Where the equations leave
    a size open, such as the amplitude of a linear system, constant terms and the nominal state
    decide; otherwise it is near 1.

    Args:
        functions: E, f, g, h, k, l and m as expressions; E under "mass_matrix".
        state: The symbols x, shape (n, 1).
        parameters: The symbols of the parameters, and their values.
        nominal: The nominal state, shape (n,).

    Returns:
        The sizes, positive, shape (n,).
    """
    n, rate = nominal.size, nominal.size
    counts = {
        "constraint_input": functions["g"].shape[1],
        "control": functions["h"].shape[1],
        "dynamics": n,
        "constraint": functions["k"].numel(),
        "output": functions["l"].numel(),
    }
    first, end = {"state": 0}, n + 1
    for kind, count in counts.items():
        first[kind], end = end, end + count
    comparisons = []
    for key, kind, factor in _PARTS:
        height = functions[key].shape[0]
        terms = list(_terms(functions[key], state, parameters, nominal))
        largest = [0.0] * (ORDER + 1)
        for term in terms:
            order = len(term.states)
            largest[order] = max(largest[order], abs(term.coefficient))
        for entry, states, coefficient in terms:
            column, row = divmod(entry, height)
            unknowns, equation = np.zeros(end), first[kind] + row
            for i in states:
                unknowns[i] += 1.0
            unknowns[equation] = -1.0
            if factor is not None:
                unknowns[first[factor] + column] += 1.0
            if key == "mass_matrix":
                unknowns[rate] += 1.0
            size = abs(coefficient)
            is_plain = size > ROUND_OFF * largest[len(states)]
            weight = FAINT if factor is None and not states else 1.0
            comparisons.append(_Comparison(unknowns, log(size), equation, weight, is_plain))
    for i in np.flatnonzero(nominal).tolist():
        unknowns = -np.eye(1, end, i)[0]
        comparisons.append(_Comparison(unknowns, log(abs(nominal[i])), i, FAINT**2, True))
    return np.asarray(SHARE * np.exp(np.clip(_alike(comparisons)[:n], -300.0, 300.0)))


def _alike(comparisons: list[_Comparison]) -> FloatArray:
    """Logarithms of sizes that make terms equally large; irrelevant terms are left out.

    The sum of sqrt(1 + residual^2) is minimized, which is robust against a few outliers.
    """
    unknowns, logarithms, equation, weight, is_plain = map(np.array, zip(*comparisons, strict=True))
    relevant: Booleans = is_plain
    solution = np.zeros(unknowns.shape[1])
    for _ in range(SELECTIONS):
        weights = relevant * weight
        for _ in range(REPETITIONS):
            factors, last = np.sqrt(weights), solution
            solution = np.linalg.lstsq(
                factors[:, None] * unknowns, -factors * logarithms, rcond=1e-9
            )[0]
            residuals = unknowns @ solution + logarithms
            weights = relevant * weight / np.sqrt(1.0 + residuals * residuals)
            if np.max(np.abs(solution - last)) < CONVERGED:
                break
        largest = np.zeros(unknowns.shape[1])
        np.maximum.at(largest, equation, residuals)
        significant = residuals > largest[equation] + NEGLIGIBLE
        if np.array_equal(significant, relevant):
            break
        relevant = significant
    return solution


def _terms(
    expression: ca.SX, state: ca.SX, parameters: tuple[ca.SX, FloatArray], nominal: FloatArray
) -> Iterator[_Term]:
    """The terms of the Taylor series of a matrix; those that are zero or not finite are left out.

    The constant term does not contain the linear terms at the nominal state.
    """
    if not expression.nnz():
        return
    symbol, values = parameters
    places: list[tuple[int, tuple[int, ...]]] = [(i, ()) for i in range(expression.numel())]
    derivatives = ca.vec(ca.densify(expression))
    for order in range(ORDER + 1):
        function = ca.Function("terms", [state, symbol], [derivatives])
        numbers = function(nominal, values).full().ravel()
        expensive = function.n_instructions() * nominal.size > OPERATIONS
        jacobian = None if order == ORDER or expensive else ca.jacobian(derivatives, state)
        if order == 0 and jacobian is not None and jacobian.nnz():
            numbers -= _linear_part(jacobian, state, parameters, nominal, numbers)
        for (entry, states), value in zip(places, numbers.tolist(), strict=True):
            if np.isfinite(value) and value != 0.0:
                equal = prod(factorial(count) for count in Counter(states).values())
                yield _Term(entry, states, value / equal)
        if jacobian is None:
            return
        following, chosen = [], []
        triplets = zip(*jacobian.sparsity().get_triplet(), strict=True)
        for number, (row, column) in enumerate(triplets):
            entry, states = places[row]
            if not states or column >= states[-1]:
                following.append((entry, (*states, column)))
                chosen.append(jacobian.nz[number])
        if not chosen or len(chosen) > ENTRIES:
            return
        places, derivatives = following, ca.vertcat(*chosen)


def _linear_part(
    jacobian: ca.SX,
    state: ca.SX,
    parameters: tuple[ca.SX, FloatArray],
    nominal: FloatArray,
    values: FloatArray,
) -> FloatArray:
    """J x at the nominal state, or the values themselves where they differ by round-off alone."""
    products = jacobian * ca.repmat(state.T, jacobian.shape[0], 1)
    outputs = [ca.sum2(products), ca.sum2(ca.fabs(products))]
    function = ca.Function("linear", [state, parameters[0]], [ca.densify(e) for e in outputs])
    part, size = (v.full().ravel() for v in function(nominal, parameters[1]))
    return np.where(np.abs(values - part) <= ROUND_OFF * size, values, part)


def spread_about(state: FloatArray, scale: FloatArray) -> FloatArray:
    """Returns the default standard deviation of random states around a state: 0.1 of the scale.

    It is a hundredth of a value above 10 scales, and a tenth of one below 1e-3 scales that is not
    round-off of a scale.
    """
    size = np.abs(state) / scale
    small = (size < 1e-3) & (size > 1e-12 * max(1.0, size.max()))
    return scale * np.where(size > 10.0, 0.01 * size, np.where(small, 0.1 * size, 0.1))
