"""Model errors as a disturbance: an exogenous signal of a law, its observation, and filters."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from scipy.linalg import expm, solve_discrete_are

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, positive
from drake_dae.dae.signals import DerivativeLayout, Parameter, Signal, places_of
from drake_dae.dae.structure import Structure
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import ModelError
from drake_dae.trace.factorization import Factorization, PositiveDefiniteFactorization
from drake_dae.trace.functions import TracedFunction

DISTURBANCE = "disturbance"  # The name of the parameter.
_TINY = 1e-200  # The denominator where nothing slides or presses; the quotient is then not used.


@checked(ModelError)
def with_disturbance(
    system: DaeSystem, states: Sequence[str], frictions: Sequence[str] = ()
) -> DaeSystem:
    """Returns the same system with a disturbance d(t) as an exogenous signal:

        E x' = f + S d + g v + h u,

    where S holds the rows of some states: for a robot its velocities, so that d is a generalized
    force. A law for this system compensates d and the named coefficients of friction, which come
    through the port `exogenous` of its controller; see `StateEstimator`. With d = 0 it is the
    law of the original system.

    `frictions` are the names of parameters that are observed as well: coefficients of friction,
    such as "wall.friction", and others with bounds or `ranges` of `Observing`.
    """
    rows = places_of("state", states, system.state_signals, f"{system.name}: ")
    if not rows or len(set(rows)) != len(rows):
        raise ModelError(
            f"{system.name}: with_disturbance needs names of states, each once, got "
            f"{', '.join(states) or 'none'}"
        )
    parameter = Parameter(DISTURBANCE, np.zeros(len(rows)), exogenous=True)
    force = ca.SX(system.num_states, 1)
    force[rows] = parameter.symbol
    return replace(
        system,
        f=system.f + force,
        parameters=(*system.parameters, parameter),
        implicit=system.implicit_with(lambda rate: -force),
        state_scale=system.scale,
    ).with_exogenous(frictions)


def estimated_within(
    parameters: Sequence[Parameter], ranges: Mapping[str, float]
) -> tuple[FloatArray, FloatArray]:
    """The lowest and highest values between which estimation starts: bounds, or a deviation."""
    low, high = [np.zeros(0)], [np.zeros(0)]
    for p in parameters:
        if p.bounds is not None and np.all(p.low < p.high):
            low.append(p.low)
            high.append(p.high)
        elif p.name in ranges:
            least = 1e-3 * p.value if p.positive else np.where(p.nonnegative, 0.0, -np.inf)
            low.append(np.maximum(p.value - ranges[p.name], least))
            high.append(p.value + ranges[p.name])
        else:
            raise ModelError(
                f"'{p.name}' has no bounds. Besides a disturbance and coefficients of friction of "
                "contacts, an estimator estimates parameters with a lowest and a highest value, "
                "which differ (`bounds`), or with a largest deviation (`ranges`)"
            )
    return np.concatenate(low), np.concatenate(high)


@dataclass(frozen=True, eq=False)
class IdentifiedTerms:
    """The parameters theta of a system that an observer estimates, c numbers.

    An error delta = theta* - theta leaves the disturbance d = -G delta, where G is the derivative
    of p' - S^T (E' x + f + g v + h u) by theta; that of a surface a distance phi(x) in contact.
    """

    parameters: tuple[Parameter, ...]
    # (x, u, v, parameters) -> the derivatives by theta of p, of its rate without inputs and of the
    # part from the inputs, (k, c) each; the distances phi that depend on theta, (j,), their
    # derivatives, (j, c), and second derivatives, one below the other, (j c, c).
    slopes: TracedFunction
    pressed: tuple[int, ...]  # The constraint inputs of these distances.
    places: tuple[int, ...]  # The indices in theta that these distances depend on.

    @classmethod
    def of(
        cls,
        system: DaeSystem,
        parameters: tuple[Parameter, ...],
        momentum: dict[str, ca.SX],
        inputs: dict[str, ca.SX],
    ) -> "IdentifiedTerms":
        """Derives the functions from p, its rate without inputs, and the part from the inputs."""
        theta = ca.vertcat(ca.SX(0, 1), *(parameter.symbol for parameter in parameters))
        pressed = tuple(i for i in range(system.k.numel()) if ca.depends_on(system.k[i], theta))
        if pressed and system.sharing is not None:
            raise ModelError(
                f"{system.name}: no surface is estimated where constraints are redundant"
            )
        gaps = system.k[list(pressed), :]
        outputs = {name: ca.jacobian(value, theta) for name, value in momentum.items()}
        bends = [ca.hessian(gap, theta)[0] for gap in ca.vertsplit(gaps)] if pressed else []
        bend = ca.vertcat(ca.SX(0, theta.numel()), *bends)
        outputs |= {"gaps": gaps, "gap slopes": ca.jacobian(gaps, theta), "gap bends": bend}
        dense = {name: ca.densify(value) for name, value in outputs.items()}
        slopes = system.trace("slopes of parameters", dense, inputs, often=False)
        places = tuple(i for i in range(theta.numel()) if ca.depends_on(gaps, theta[i]))
        return cls(parameters, slopes, pressed, places)

    @property
    def signals(self) -> tuple[Signal, ...]:
        """Names and units of theta."""
        return tuple(signal for parameter in self.parameters for signal in parameter.signals)


@dataclass(frozen=True, eq=False)
class Observation:
    """The functions that an observer of d evaluates, for a system made by `with_disturbance`.

    With the momentum p = S^T E x, whose rate is p' = (S^T E)' x + S^T (f + g v + h u) + d, no
    derivative of a measurement is needed. Where a contact slides, friction is S^T dg/dmu v mu.
    Where it sticks, it is a reaction T y, which p cannot distinguish from d: the columns of T are
    the gradients of the sliding velocities, or the derivatives of S^T dg/dmu v with respect to the
    velocities at rest, which span the same.

    The functions take x first and the parameters last:

        momentum(x, u, v):    p, its rate without inputs and d, and S^T (h u + g v), (k,) each;
        friction(x, v):       C = S^T dg/dmu v, (k, c), and the sliding speeds in m/s, (c,);
        directions(x, v):     Q = 1 + S^T g dalpha/dd, where Q d is d with the reaction of the
                              constraints, and T of each contact, of `widths` columns, side by side;
        metric(x, d):         W d with W = Q^T E^-1 Q: d^T W d is the squared acceleration by d;
        wanted(x, R, t):      x with the velocities r' + t r'' of the reference, on the constraints;
                              None if outputs and constraints do not determine the velocities;
        moving(x):            R with the present rates r' of the outputs, and zeros otherwise.
    """

    momentum: TracedFunction
    friction: TracedFunction
    directions: TracedFunction
    metric: TracedFunction
    widths: tuple[int, ...]
    wanted: TracedFunction | None
    moving: TracedFunction
    rows: tuple[int, ...]  # The states whose rates contain d.
    frictions: dict[str, int]  # Coefficients of friction, with the constraint input of each.
    identified: IdentifiedTerms  # The other parameters that are estimated.

    @classmethod
    def of(cls, structure: Structure, layout: DerivativeLayout) -> "Observation":
        """Derives the functions from the structure of a system, for references of a layout."""
        system = structure.system
        named = {p.name: p for p in system.exogenous.moving}
        if DISTURBANCE not in named:
            raise ModelError(
                f"{system.name} has no disturbance to observe; make the law for "
                "with_disturbance(system, states)"
            )
        d = named[DISTURBANCE].symbol
        entry = ca.DM(ca.jacobian(system.f, d).sparsity()).full()
        rows = [int(np.flatnonzero(column)[0]) for column in entry.T]
        # The exogenous coefficients of friction, and the constraint input of each.
        inputs = [signal.name for signal in system.constraint_input_signals]
        pressing = {c.friction: inputs.index(c.force) for c in system.contacts if c.friction}
        frictions = {name: pressing[name] for name in named if name in pressing}
        others = tuple(p for p in named.values() if p.name not in (*frictions, DISTURBANCE))
        x, v = system.state, ca.SX.sym("v", system.num_constraints)
        u = ca.SX.sym("u", system.num_controls)
        mass, action = system.mass_matrix[rows, :], ca.mtimes(system.g, v)
        momentum = ca.mtimes(mass, x)
        still = ca.SX.sym("still", x.numel())
        moved = ca.jtimes(ca.mtimes(mass, still), x, _known_rate(system, mass, rows))
        drift = ca.substitute(system.f[rows], d, 0 * d) + ca.substitute(moved, still, x)
        pushed_by = action[rows] + ca.mtimes(system.h[rows, :], u)
        outputs = {"momentum": momentum, "drift": drift, "inputs": pushed_by}
        signals = {"control": u, "constraint_input": v}
        traced = system.trace("momentum", outputs, signals, often=False)
        identified = IdentifiedTerms.of(system, others, outputs, signals)

        # The force of a friction coefficient of 1; its power is -mu lambda |v_t|.
        columns = [ca.jacobian(action[rows], named[name].symbol) for name in frictions]
        forces = ca.horzcat(ca.SX(len(rows), 0), *columns)
        power = ca.mtimes(forces.T, x[rows])
        speeds = [
            ca.fabs(power[j]) / ca.fmax(ca.fabs(v[i]), _TINY)
            for j, i in enumerate(frictions.values())
        ]
        pressed = {"constraint_input": v}
        frictional = {"forces": forces, "speeds": ca.vertcat(ca.SX(0, 1), *speeds)}
        friction = system.trace("friction", frictional, pressed, often=False)

        pushes, reacts = system.g[rows, :], ca.jacobian(structure.elimination.alpha, d)
        pushed, right = ca.SX.sym("d", len(rows)), ca.SX(x.numel(), 1)
        right[rows] = pushed + ca.mtimes(pushes, ca.mtimes(reacts, pushed))
        moves = PositiveDefiniteFactorization(system.mass_matrix).solve(right)[rows]
        moves += ca.mtimes(reacts.T, ca.mtimes(pushes.T, moves))
        metric = system.trace("metric", {"value": moves}, {"d": pushed}, often=False)
        planes = [
            _plane(system, name, column, rows)
            for name, column in zip(frictions, columns, strict=True)
        ]
        directions_of_forces = {
            "free": ca.SX.eye(len(rows)) + ca.mtimes(pushes, reacts),
            "planes": ca.densify(ca.horzcat(ca.SX(len(rows), 0), *planes)),
        }
        directions = system.trace(
            "directions of friction", directions_of_forces, pressed, often=False
        )
        return cls(
            traced,
            friction,
            directions,
            metric,
            tuple(plane.shape[1] for plane in planes),
            *_wanted(structure, rows, layout),
            tuple(rows),
            frictions,
            identified,
        )


def _plane(system: DaeSystem, name: str, force: ca.SX, rows: Sequence[int]) -> ca.SX:
    """T of a contact, shape (k, j), by its coefficient of friction and the force of one of 1."""
    velocities = system.state[list(rows)]
    for contact in system.contacts:
        if contact.friction == name and contact.sliding is not None:
            slope = ca.sparsify(ca.jacobian(contact.sliding, velocities)).T
            moving = [j for j in range(slope.shape[1]) if slope[:, j].nnz()]
            return ca.densify(slope[:, moving or [0]])
    return ca.substitute(ca.jacobian(force, velocities), velocities, 0 * velocities)


def _wanted(
    structure: Structure, rows: Sequence[int], layout: DerivativeLayout
) -> tuple[TracedFunction | None, TracedFunction]:
    """Returns `wanted` and `moving` of an `Observation`."""
    system = structure.system
    # With flexible joints forces have a relative degree as well.
    steered = [int(i) for i in layout.dynamic if system.m[int(i), :].is_zero()]
    starts = {i: int(layout.lowest[i]) for i in steered if structure.output_degrees[i] > 1}
    rates = {i: structure.output_chains[i][1] for i in starts}
    at_present = ca.SX.zeros(layout.reference_size)
    for i, rate in rates.items():
        at_present[starts[i] + 1] = rate
    moving = system.trace("velocities of outputs", {"R": at_present}, often=False)
    if len(starts) < len(steered):
        return None, moving
    reference, ahead = ca.SX.sym("R", layout.reference_size), ca.SX.sym("t")
    velocity_rows = DerivativeLayout(structure.constraint_degrees).ends.tolist()
    errors = [rates[i] - reference[j + 1] - ahead * reference[j + 2] for i, j in starts.items()]
    errors += [structure.manifold.residual_expression[velocity_rows, :]]
    slope = ca.jacobian(ca.vertcat(*errors), system.state[list(rows), :])
    if slope.shape[0] != slope.shape[1]:
        return None, moving
    factors = Factorization(slope)
    state = ca.SX(system.state)
    state[list(rows), :] -= factors.solve(ca.vertcat(*errors))
    inputs = {"reference": reference, "ahead": ahead}
    wanted = system.trace("wanted velocities", {"state": state}, inputs, factors.pivot, often=False)
    return wanted, moving


def _known_rate(system: DaeSystem, mass: ca.SX, rows: Sequence[int]) -> ca.SX:
    """x' of the states that a mass matrix depends on; inputs and disturbance must not enter it."""
    rate = ca.SX(system.num_states, 1)
    others = system.mass_matrix - ca.SX.eye(system.num_states)
    driven = ca.horzcat(others, system.g, system.h)
    for i in range(system.num_states):
        if not ca.depends_on(mass, system.state[i]):
            continue
        if i in rows or ca.sparsify(driven[i, :]).nnz():
            name = system.state_signals[i].name
            raise ModelError(
                f"{system.name}: the mass that a disturbance accelerates depends on '{name}', "
                "whose rate does not depend only on the state"
            )
        rate[i] = system.f[i]
    return rate


_FLAT = 1e-9
"""Directions count as equal if the ratio of their smallest to largest square is below this."""

Metric = Callable[[ca.SX], ca.SX]
"""Disturbances d, as columns -> W d."""


def shares(
    forces: ca.SX, planes: Sequence[ca.SX], velocity: ca.SX, metric: Metric, d: ca.SX
) -> ca.SX:
    """Returns the part (c~^T W d) / (c~^T W c) of d that each friction force c explains, (c, 1).

    c~ is c without the part that a contact force orthogonal to the sliding explains as well. So a
    payload that pulls the tool across its motion is no friction, although M^-1 couples both.
    Forces and planes T, the reactions of each contact if it sticks, are columns.
    """
    components = list[ca.SX]()
    for force, plane in zip(ca.horzsplit(forces), planes, strict=True):
        # T = J^T of the contact, or J^T J, and c = -J^T v_t / |v_t|: so this is J^T of what is
        # across v_t.
        power = ca.fmin(ca.mtimes(velocity.T, force), -_TINY)
        share = ca.mtimes(velocity.T, plane) / power
        moved, matched = metric(plane), metric(force)
        across, moved_across = plane - ca.mtimes(force, share), moved - ca.mtimes(matched, share)
        pairs = (across, moved_across), (plane, moved)
        sizes = [ca.mmax(ca.sum1(columns * others)) for columns, others in pairs]
        # Round-off where all of the plane is along c.
        is_plane = sizes[0] > _FLAT * sizes[1]
        for direction, unit in _basis(is_plane * across, is_plane * moved_across):
            matched -= unit * ca.dot(direction, matched)
        square = ca.fmax(ca.dot(matched, force), _TINY)
        components.append(ca.dot(matched, d) / square)
    return ca.vertcat(ca.SX(0, 1), *components)


def orthogonal_part(planes: ca.SX, metric: Metric, d: ca.SX) -> ca.SX:
    """Returns the part of d that is orthogonal to all T y in the metric of accelerations."""
    for direction, unit in _basis(planes, metric(planes)):
        d -= ca.mtimes(direction, ca.mtimes(unit.T, d))
    return d


def _basis(planes: ca.SX, moved: ca.SX) -> list[tuple[ca.SX, ca.SX]]:
    """Directions e that span T, orthogonal in the metric W, each with W e / (e^T W e).

    By modified Gram-Schmidt; for one that depends on those before it, the second is zero.
    """
    squares = ca.sum1(planes * moved)
    least = _FLAT * ca.mmax(squares) if squares.numel() else 0
    basis: list[tuple[ca.SX, ca.SX]] = []
    pairs = [list(pair) for pair in zip(ca.horzsplit(planes), ca.horzsplit(moved), strict=True)]
    for i, (direction, image) in enumerate(pairs):
        square = ca.dot(direction, image)
        unit = ca.if_else(square > least, 1, 0) / ca.fmax(square, _TINY) * image
        basis.append((direction, unit))
        for pair in pairs[i + 1 :]:
            part = ca.dot(unit, pair[0])
            pair[:] = pair[0] - direction * part, pair[1] - image * part
    return basis


@dataclass(frozen=True, eq=False)
class Lags:
    """n + 1 first-order lags of rate k in series, for a signal d that is constant between samples:

        s_0' = k (d - s_0),    s_j' = k (s_(j-1) - s_j),    r = s_n = (k / (s + k))^(n+1) d.

    So r has n derivatives, which do not change if the same number is added to all s. For a constant
    d, r = d (1 - e^(-k t) (1 + k t + ... + (k t)^n / n!)), and r follows a ramp with a delay of
    (n + 1) / k.
    The next sample of s is step s + gain d, and slopes s are r', ..., r^(n).
    """

    step: FloatArray
    gain: FloatArray
    slopes: FloatArray

    @classmethod
    def of(cls, rate: float, period: float, degree: int) -> "Lags":
        """Returns the lags of rate k, sampled each `period` seconds, with n = `degree`."""
        size = degree + 1
        both = np.zeros((size + 1, size + 1))
        both[:size, :size] = rates = rate * (np.eye(size, k=-1) - np.eye(size))
        both[0, size] = rate
        step = expm(both * period)
        slopes = [np.linalg.matrix_power(rates, j)[-1] for j in range(1, size)]
        return cls(step[:size, :size], step[:size, size], np.reshape(slopes, (degree, size)))

    def after(self, lags: ca.SX, signal: ca.SX) -> ca.SX:
        """Returns s at the next sample for d of shape (k, 1), one column for each, (k, n + 1)."""
        return ca.mtimes(lags, self.step.T) + ca.mtimes(signal, self.gain[None, :])

    def derivatives(self, lags: ca.SX) -> ca.SX:
        """Returns r', ..., r^(n), one column for each, shape (k, n)."""
        return ca.mtimes(lags, self.slopes.T)


def filter_gain(
    state_rate: float, disturbance_rate: float, period: float, velocity_ratio: float | None = None
) -> FloatArray:
    """Returns K of the stationary Kalman filter of (q, v, a) from samples of q, and of v if known:

        q' = v,    v' = known acceleration + a + white noise,    a' = white noise,

    where the known acceleration is that of the model. With samples T apart,

        prediction:   q = q + T v + T^2 / 2 a,   v = v + T (known acceleration + a),
        correction:   (q, v, a) = (q, v, a) + K (measured - predicted).

    With the noise R = T sigma^2 of positions, that of v' is R w^4 and that of a' is R w^4 k_o^2,
    for a state_rate w and a disturbance_rate k_o; velocity_ratio is sigma_v / sigma.
    Without measured velocities the poles solve s^6 + w^4 s^2 - w^4 k_o^2 = 0, up to terms of the
    order of w T (Kwakernaak and Sivan, Linear Optimal Control Systems, 1972, theorem 4.14): for
    k_o << w a pair at the distance w, for the velocity, and one at -k_o, for the model error a.
    """
    w, slow = positive("state_rate", state_rate), positive("disturbance_rate", disturbance_rate)
    if w * positive("period", period) > 1.0:
        raise ModelError(
            f"a state_rate of {w:g} 1/s is too high for samples {period:g} s apart: at most "
            f"{1.0 / period:g} 1/s"
        )
    # Scaled: q, T v, T^2 a in units of sigma.
    size = period ** np.arange(3)
    step = size[:, None] * transition(period) / size
    noise = np.diag([0.0, (w * period) ** 4, (w * period) ** 4 * (slow * period) ** 2])
    shown = np.eye(3)[:1] if velocity_ratio is None else np.eye(3)[:2]
    error = np.eye(len(shown))
    if velocity_ratio is not None:
        error[1, 1] = (positive("velocity_ratio", velocity_ratio) * period) ** 2
    before = solve_discrete_are(step.T, shown.T, noise, error)
    gain = np.linalg.solve(shown @ before @ shown.T + error, shown @ before).T
    return np.asarray(gain * size[: len(shown)] / size[:, None])


def transition(period: float) -> FloatArray:
    """Returns the transition matrix of (q, v, a) over a sample, shape (3, 3)."""
    return np.array([[1.0, period, period**2 / 2.0], [0.0, 1.0, period], [0.0, 0.0, 1.0]])
