"""Damping of the constraint by the law, for compliant contacts."""

import warnings
from dataclasses import replace

import casadi as ca
import numpy as np
from scipy.linalg import expm

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, check_whole_number
from drake_dae.dae.derivatives import Derivatives
from drake_dae.dae.elimination import eliminate
from drake_dae.dae.structure.structure import Structure
from drake_dae.dae.system.layout import DerivativeLayout
from drake_dae.dae.tracking.gains import FeedbackGains, GainDesign
from drake_dae.dae.tracking.latency import acting_late
from drake_dae.errors import AdviceWarning, GainError, ModelError
from drake_dae.trace.given import result_of

INTERVALS = 200
"""The number of steps of an interval in the search for the best damping, which is refined once."""

STIFFER = 2.0
"""The contact may be stiffer than given by this factor, or softer by any factor."""

STIFFNESSES = np.concatenate([np.geomspace(1e-3, 0.5, 10), np.linspace(0.5, STIFFER, 31)[1:]])
"""The examined stiffnesses, relative to the given one."""


def damped(
    structure: Structure, damping: GainDesign | FeedbackGains | None, latency: float = 0.0
) -> Structure:
    """Returns the structure of a law's model that demands, instead of y_i^(r_i) = 0,

        y_i^(r_i) + c_(r_i - 1) y_i^(r_i - 1) + ... + c_1 y_i' = 0,

    without a term in y_i itself, which would control the position of the surface instead of the
    force. On N* all y_i^(j) vanish, so that nothing changes there: alpha (13) becomes alpha - A^-1
    (sum_j c_j L_f^j k_i), beta (14), the degrees, A and B stay.

    If a force is an output of degree mu >= 1 (flexible joints, motors), the law differentiates
    alpha and takes the added term as constant: a compliant contact does not move as the model
    demands, so that the derivatives of the model would destabilize it (with force poles at -p and a
    contact of frequency w = sqrt(A k), for c > p already at mu = 1). Then for mu = 1 the contact is
    damped for all p; for mu = 2 and c from w to 2 w it is damped from about p = 2.5 w on, best near
    5 w. The force poles must be faster than the contact.
    """
    system = acting_late(structure.system, latency)
    if damping is None and system is structure.system:
        return structure
    layout, residual = (
        DerivativeLayout(structure.constraint_degrees),
        structure.manifold.residual_expression,
    )
    force = ca.SX.zeros(len(structure.constraint_degrees))
    if damping is not None:
        gains = damping_gains(structure, damping)
        rates = residual[np.flatnonzero(layout.orders).tolist(), :]
        force = ca.mtimes(ca.sparsify(ca.DM(gains.matrix)), rates)
    derivatives = Derivatives(system, residual[layout.ends.tolist(), :], force)
    return _along(replace(structure, derivatives=derivatives), derivatives)


def damping_gains(structure: Structure, damping: GainDesign | FeedbackGains) -> FeedbackGains:
    """Returns the coefficients c of `damped`."""
    system = structure.system
    names = tuple(signal.name for signal in system.constraint_output_signals)
    degrees = tuple(degree - 1 for degree in structure.constraint_degrees)
    gains = damping
    if not isinstance(gains, FeedbackGains):
        gains = result_of("constraint_damping", gains, names, degrees, error=GainError)
    if not isinstance(gains, FeedbackGains) or (gains.names, gains.degrees) != (names, degrees):
        raise GainError(
            f"constraint_damping must be a design such as poles(-200.0) for the constraints "
            f"{', '.join(names) or 'none'} with r_i - 1 = {degrees} poles each"
        )
    return gains


def _along(structure: Structure, derivatives: Derivatives) -> Structure:
    """The output chains of known degrees along other derivatives."""
    system, degrees = structure.system, structure.output_degrees
    chains: list[list[ca.SX]] = [[] for _ in degrees]
    highest = ca.SX(len(degrees), 1)
    rows = list(range(len(degrees)))
    moving = system.outputs(derivatives.constraint_input)
    for order in range(max(degrees, default=0) + 1):
        values, _ = derivatives.by_control(moving)
        for row, i in enumerate(rows):
            if degrees[i] == order:
                highest[i] = moving[row]
            else:
                chains[i].append(values[row])
        remaining = [row for row, i in enumerate(rows) if degrees[i] > order]
        rows = [rows[row] for row in remaining]
        if rows:
            moving = derivatives.derivative(moving[remaining])
    drift, control_matrix = derivatives.by_control(highest)
    elimination = eliminate(derivatives)
    return replace(
        structure,
        elimination=replace(elimination, n_star=structure.elimination.n_star),
        output_chains=tuple(tuple(chain) for chain in chains),
        highest_derivatives=highest,
        drift=drift,
        control_matrix=control_matrix,
    )


@checked(ModelError)
def contact_damping(
    stiffness: float, mobility: float, sample_time: float = 0.0, delay: int = 1
) -> float:
    """Returns the damping c for which a contact of the stated stiffness settles fastest.

    On a compliant contact, F = -k phi, a law with `constraint_damping=poles(-c)` leaves

        phi'' + c phi' = A (F - lambda_d),    so    phi'' + c phi' + A k phi = -A lambda_d,

    which is critically damped at c = 2 sqrt(A k). A changing reference force leaves an error of
    about c lambda_d' / (A k).

    A sampled law holds -c phi' for a sample time T, from a measurement `delay` samples before.
    Between samples the contact oscillates freely, so (phi, phi', the held value) follow from the
    previous sample by a matrix. c minimizes its spectral radius. For a slow contact c is 2 w, with
    w = sqrt(A k). Without contact a delay of one sample gives z^2 - z + c T = 0, which does not
    oscillate up to c = 1 / (4 T) and is stable up to c = 1 / T; so c stays of this size. At w T of
    about 1 the held value lags by a quarter of a period and does not damp any more; then c is 0,
    and the contact needs damping of its own or a shorter sample time.

    The result is valid if the contact is stable for all lower stiffnesses and up to twice the given
    one: with one sample of delay up to w T = 0.6, with none up to 1.3, with two up to 0.36, with
    three up to 0.24. Beyond, a warning is issued: a contact that is stiffer by 10 % may diverge
    there, and above w T = pi its oscillation is aliased.

    Args:
        stiffness: k in N/m, positive.
        mobility: A(x) = J M^-1 J^T of the contact in 1/kg, positive: see
            `ConstraintStructure.constraint_matrix`. Take the largest along the motion.
        sample_time: T in s; 0 for a law that runs continuously.
        delay: The delay of the control in samples.

    Returns:
        c in 1/s, from 0 to 2 sqrt(A k).

    Warns:
        AdviceWarning: The contact is outside the range in which the result is valid.

    Raises:
        ModelError: A number is not positive, or is negative.
    """
    best = best_damping(stiffness, mobility, sample_time, delay)
    if sample_time:
        frequency = float(np.sqrt(mobility * stiffness))
        lost = unstable_from(frequency, sample_time, delay, best)
        warn_of(lost, stiffness, frequency * sample_time, f"a damping of {best:.4g} 1/s")
    return best


def best_damping(stiffness: float, mobility: float, sample_time: float, delay: int) -> float:
    """Acts as `contact_damping`, without a warning outside the range of validity."""
    for name, value, least in (
        ("stiffness", stiffness, "positive"),
        ("mobility", mobility, "positive"),
        ("sample_time", sample_time, "0 or more"),
    ):
        if not (value > 0.0 or (value == 0.0 and least != "positive")):
            raise ModelError(f"{name} must be {least}, got {value:g}")
    check_whole_number("delay", delay, 0)
    frequency = float(np.sqrt(mobility * stiffness))
    critical = 2.0 * frequency
    if sample_time == 0.0:
        return critical
    step, low, high = _step(frequency, sample_time), 0.0, critical
    for _ in range(2):
        tried = np.linspace(low, high, INTERVALS + 1)
        best = int(np.argmin([_radius(step, c, delay) for c in tried]))
        low, high = tried[max(best - 1, 0)], tried[min(best + 1, INTERVALS)]
    return float(tried[best])


def unstable_from(
    frequency: float, sample_time: float, delay: int, damping: float, integral: float = 0.0
) -> float | None:
    """Returns the lowest relative stiffness at which a contact is unstable, if there is one."""
    for share in STIFFNESSES.tolist():
        natural = frequency * share**0.5
        added = integral * natural * sample_time
        shown = natural * sample_time < np.pi
        if not (shown and _radius(_step(natural, sample_time), damping, delay, added) < 1.0):
            return share
    return None


def warn_of(lost: float | None, stiffness: float, swing: float, advice: str) -> None:
    """Warns if a recommended gain is outside the range in which it is valid.

    Warns:
        AdviceWarning: The gain is outside its range.
    """
    if lost is None:
        return
    warnings.warn(
        f"{advice} is outside of the range in which the recommendation is valid: a contact of "
        f"{lost * stiffness:.3g} N/m, which is {lost:.3g} times the given {stiffness:.3g} N/m, is "
        f"unstable with it. The contact oscillates by {swing:.3g} rad in a sample: sample more "
        "often, make it softer, or choose the gains yourself",
        AdviceWarning,
        stacklevel=4,
    )


def _step(frequency: float, sample_time: float) -> FloatArray:
    """The matrix of (phi, phi', held value) over a sample, phi in units of 1 / frequency."""
    swing = np.zeros((3, 3))
    swing[0, 1], swing[1, 0], swing[1, 2] = frequency, -frequency, 1.0
    return np.asarray(expm(swing * sample_time)[:2])


def _radius(step: FloatArray, damping: float, delay: int, integral: float = 0.0) -> float:
    """The spectral radius of a contact whose damping is sampled, held and delayed."""
    # (phi, phi', the integral, the held values from next to last).
    matrix = np.zeros((3 + delay, 3 + delay))
    matrix[:2, :2] = step[:, :2]
    matrix[2, 0], matrix[2, 2] = integral, 1.0 if integral else 0.0
    if delay == 0:
        matrix[:2, 1] -= damping * step[:, 2]
        matrix[:2, 2] -= step[:, 2]
    else:
        matrix[:2, 3] = step[:, 2]
        matrix[3:-1, 4:] = np.eye(delay - 1)
        matrix[-1, 1:3] = -damping, -1.0
    return float(np.abs(np.linalg.eigvals(matrix)).max())
