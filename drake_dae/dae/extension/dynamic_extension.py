"""Dynamic extension: integrators before controls, where B(x) has no inverse without them.

If B(x) of (16) is singular, one combination of the controls acts on some outputs before the others
do: the drive of a wheeled robot acts on both coordinates of its position before its steering does.
If that combination becomes a state and its derivative the control, all controls act at the same
order. The law (28) of the extended system is then a dynamic state feedback of the original one.

Descusse and Moog, "Decoupling with dynamic compensation for strong invertible affine non-linear
systems", International Journal of Control 42(6), 1985; Isidori, Nonlinear Control Systems, 1995,
section 5.4; Nijmeijer and van der Schaft, Nonlinear Dynamical Control Systems, 1990, chapter 8.
"""

from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, check_whole_number, show
from drake_dae.dae.derivatives import lie_derivative
from drake_dae.dae.extension.extension import Extension, by_control, integrated, refuse_metric
from drake_dae.dae.manifold.manifold import Manifold
from drake_dae.dae.signals import Signal
from drake_dae.dae.states.samples import Samples, spread_of
from drake_dae.dae.structure.relative_degrees import InputActions
from drake_dae.dae.structure.structure import Structure, examine_structure, find_structure
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import AssumptionError, ModelError
from drake_dae.trace.factorization import Factorization
from drake_dae.trace.round_off import positive


@checked(ModelError)
def dynamic_extension(
    system: DaeSystem,
    *,
    nominal_control: Mapping[str, float] | None = None,
    max_integrators: int | None = None,
    spread: ArrayLike | None = None,
) -> Extension:
    """Finds integrators that make B(x) regular, by the dynamic extension algorithm.

    In each round the controls that act in the dependent rows of B(x) get an integrator. If more
    than q controls act in rows of rank q, a regular static feedback u = beta(x) w is applied first,
    after which only q controls act in them; see `Extension.integrators`. Each round reduces the
    dimension of the zero dynamics by the rank deficiency of B(x), so that it ends after few rounds:
    if no zero dynamics remain and B(x) is still singular, the outputs are dependent and there is no
    extension. A violation of Assumption (3) is repaired as well; see `extend`.

    Args:
        system: The system (1)-(3).
        nominal_control: Values of the controls at the nominal state, for the integrators that hold
            them; zero where not given.
        max_integrators: The largest total number of integrators; n if None.
        spread: The standard deviation of the random states, as in `find_structure`. That of a
            control is 0.1 of its nominal value; 0.1 if that is zero.

    Returns:
        The extended system; the original one if its B(x) is regular.

    Raises:
        AssumptionError: No integrators help: the outputs are not independent, B(x) is singular at
            isolated states only, or more than max_integrators are needed.
        ModelError, InconsistentStateError: The system has no structure, see `find_structure`, or it
            has a `control_metric`.
    """
    refuse_metric(system)
    limit = system.num_states if max_integrators is None else max_integrators
    check_whole_number(f"{system.name}: max_integrators", limit, 0)
    nominal = by_control(system, "nominal_control", nominal_control or {})
    chain = _Chain(system, nominal, spread)
    while True:
        try:
            structure, _ = examine_structure(chain.near_nominal(), spread=chain.spread)
        except AssumptionError as error:
            if error.assumption != 3:
                raise
            chain.integrate(_early_controls(chain.system, error))
        else:
            choice = _controls_to_integrate(structure)
            if choice is None:
                break
            chain.integrate(*choice)
        if sum(chain.integrators.values()) > limit:
            raise AssumptionError(
                f"more than max_integrators = {limit} are needed for a regular B(x) of (16), so "
                f"far {_in_words(chain.integrators)}. Allow more, or choose other outputs",
                5,
            )
    return Extension(
        original=system,
        system=chain.system,
        structure=_structure_at_nominal(chain),
        integrators=chain.integrators,
        control_offset=chain.offset,
        control_matrix=chain.matrix,
    )


class _Chain:
    """A system between the original and the extended one, with the integrators added so far."""

    def __init__(self, system: DaeSystem, nominal: FloatArray, spread: ArrayLike | None) -> None:
        self.system = system
        self.spread = spread_of(system, spread)
        self.integrators: dict[str, int] = {}
        self.offset = ca.SX(system.num_controls, 1)
        self.matrix = ca.SX.eye(system.num_controls)
        self._nominal = nominal
        self._names = [signal.name for signal in system.control_signals]
        self._bases = [(signal, 0) for signal in system.control_signals]

    def near_nominal(self) -> DaeSystem:
        """Returns the system with a nominal state at which no sine is accidentally zero.

        Rows of B(x) may vanish accidentally there, as sin(heading) does at heading 0.
        """
        random = np.random.default_rng(0)
        step = 0.1 * self.spread * random.standard_normal(self.system.num_states)
        return replace(
            self.system,
            nominal_state=self.system.nominal_state + step,
            state_scale=self.system.scale,
        )

    def integrate(self, columns: list[int], mixing: ca.SX | None = None) -> None:
        """Puts one integrator before each of some controls."""
        system = self.system
        others = [j for j in range(system.num_controls) if j not in columns]
        nominal = self._nominal[columns]
        if mixing is not None:
            function = system.trace("mixing", {"mixing": mixing}, often=False)
            here = function(system.nominal_state, system.parameter_values)[0]
            nominal = nominal + here.reshape(mixing.shape) @ self._nominal[others]
            for i in columns:
                control = system.control_signals[i]
                self._bases[i] = (Signal(f"{control.name}*", control.unit), 0)
        integrated_signals = [self._signal(i) for i in columns]
        for i in columns:
            self._bases[i] = (self._bases[i][0], self._bases[i][1] + 1)
            name = self._names[i]
            self.integrators[name] = self.integrators.get(name, 0) + 1
        following = [self._signal(i) for i in columns]
        self.system = integrated(system, columns, integrated_signals, following, nominal, mixing)
        # u_i = x_i - sum_j b_ij u_j, with the new state x_i.
        new = self.system.state[system.num_states :]
        self.offset += ca.mtimes(self.matrix[:, columns], new)
        if mixing is not None:
            self.matrix[:, others] -= ca.mtimes(self.matrix[:, columns], mixing)
        self.matrix[:, columns] = 0.0
        self._nominal[columns] = 0.0
        # B(x) is often singular at zero, so a nonzero value is kept away from zero.
        size = np.where(nominal == 0.0, 1.0, np.abs(nominal))
        self.spread = np.concatenate([self.spread, 0.1 * size])

    def _signal(self, column: int) -> Signal:
        base, order = self._bases[column]
        return base.derivative(order)


def _controls_to_integrate(structure: Structure) -> tuple[list[int], ca.SX | None] | None:
    """Returns the controls that act in the dependent rows of B(x), and how to mix them."""
    system = structure.system
    samples = Samples(structure.manifold, structure.states)
    matrices = _control_matrices(structure, samples)
    size = np.abs(matrices).max(axis=0)
    row_size = positive(size.max(axis=1))
    column_size = positive((size / row_size[:, None]).max(axis=0))
    scaled = matrices / row_size[:, None] / column_size
    left, values, _ = np.linalg.svd(scaled)
    ranks = (values > system.least_margin).sum(axis=1)
    rank, p = int(ranks.max()), system.num_controls
    if rank == p:
        return None
    least = system.least_margin
    rows = [i for i in range(p) if any(np.abs(u[i, rank:]).max() > least for u in left)]
    names = ", ".join(system.output_signals[i].name for i in rows)
    if ranks.min() < rank:
        state = samples.states[int(ranks.argmin())]
        raise AssumptionError(
            f"the rank of B(x) of (16) falls from {rank} to {ranks.min()} at x = {show(state)}, so "
            "that the integrators to add differ from state to state. Keep away from this state",
            5,
            state,
        )
    used = ca.vertcat(structure.manifold.residual_expression, structure.chain)
    if samples.dependent(used):
        raise AssumptionError(
            f"no integrators make B(x) of (16) regular: the outputs {names} and their derivatives "
            "depend on each other or on the constraints, so that the system is not right-"
            "invertible. Choose other outputs",
            5,
        )
    q = len(rows) - (p - rank)
    acting = [j for j in range(p) if matrices[:, rows, j].any()]
    if len(acting) == q:
        return acting, None

    def distance(columns: list[int]) -> float:
        values = np.linalg.svd(scaled[:, rows][:, :, columns], compute_uv=False)
        return round(float(values[:, -1].min()), 9)

    candidates: list[list[int]] = [list(columns) for columns in combinations(acting, q)]
    columns = max(candidates, key=distance)
    others = [j for j in range(p) if j not in columns]
    # Least squares over all dependent rows, since q of them may be dependent at other states. It is
    # exact: every column lies in the span of the chosen ones.
    part = structure.control_matrix[rows, :] / row_size[rows]
    chosen = part[:, columns]
    mixing = ca.SX(q, p - q)
    mixed = [i for i, j in enumerate(others) if j in acting]
    mixing[:, mixed] = Factorization(ca.mtimes(chosen.T, chosen)).solve(
        ca.mtimes(chosen.T, part[:, [others[i] for i in mixed]])
    )
    return columns, mixing


def _control_matrices(structure: Structure, samples: Samples) -> FloatArray:
    """B(x) without its round-off, shape (samples, p, p)."""
    actions = InputActions(samples, structure.elimination)
    matrices = actions.numbers(actions.feedthrough)
    dynamic = [i for i, degree in enumerate(structure.output_degrees) if degree]
    if dynamic:
        last = ca.vertcat(*[structure.output_chains[i][-1] for i in dynamic])
        matrices[:, dynamic] = actions.numbers(actions.along(last, "h*"))
    return matrices


def _early_controls(system: DaeSystem, violation: AssumptionError) -> list[int]:
    """Returns the controls that act on a constraint's derivative before its inputs do."""
    x, explicit = system.state, system.explicit
    manifold = Manifold(system, [[explicit.k[i]] for i in range(system.num_constraints)])
    actions = InputActions(Samples(manifold, np.array([violation.state])))
    early: set[int] = set()
    for i in range(system.num_constraints):
        last = explicit.k[i]
        for _ in range(system.num_states):
            by_force, by_control = (actions.numbers(actions.along(last, key))[0] for key in "gh")
            if by_force.any():
                break
            if by_control.any():
                early.update(np.flatnonzero(by_control).tolist())
                break
            last = lie_derivative(last, explicit.f, x)
    return sorted(early)


def _structure_at_nominal(chain: _Chain) -> Structure:
    """The structure of the extended system, which is regular nearly everywhere."""
    try:
        return find_structure(chain.system, spread=chain.spread)
    except AssumptionError as error:
        if error.state is None:
            raise
        remedy = "Keep away from this state"
        if chain.integrators:
            entries = ", ".join(f'"{name}": 1.0' for name in chain.integrators)
            remedy += (
                f", or give another nominal_control, for example nominal_control={{{entries}}}; "
                f"integrators: {_in_words(chain.integrators)}"
            )
        raise AssumptionError(
            f"B(x) of (16) is regular around x = {show(error.state)}, but not there: it is "
            f"singular at isolated states, which more integrators do not change. {remedy}",
            error.assumption,
            error.state,
        ) from error


def _in_words(integrators: Mapping[str, int]) -> str:
    return ", ".join(f"{count} before {name}" for name, count in integrators.items())
